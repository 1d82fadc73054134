"""Models, sources and occluders by name: plain tables of "module:object" strings, loaded on use.

``partialbench`` names the other packages only here, as strings, so importing it loads none of them.
"""

from __future__ import annotations

import dataclasses
import difflib
import fnmatch
import importlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from partialbench import extras, user_code
from partialbench import options as option_types
from partialbench.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor, nn


@dataclass(frozen=True)
class Recipe:
    """How a model is published to be trained. What our protocol changes is said on its card.

    Attributes:
        optimizer: "adam", "adamw", "muon" or "sgd".
        lr, weight_decay, momentum, batch_size: as published.
        epochs: as published; None where a milestone says how long ("warm-up-stable-decay").
        schedule: "constant", "step", "cosine", "one-cycle", "plateau", "warm-up-stable-decay";
            ``schedule_options`` as the harness's ``benchmark.protocol.schedule`` takes them.
        label_smoothing: ε, spread over all K classes (torch's sense) or, with
            ``smoothing_over_others``, over the K − 1 others (DGCNN's).
        clip_norm: global gradient norm, or None.
        average: what is tested is the mean of the weights over a milestone's decay, and not those
            at its end; only with "warm-up-stable-decay".
        notes: what the publication does that does not fit a field.
    """

    optimizer: str = "adam"
    lr: float = 1e-3
    weight_decay: float = 0.0
    momentum: float = 0.9
    batch_size: int = 32
    epochs: int | None = 200
    schedule: str = "constant"
    schedule_options: Mapping[str, Any] = field(default_factory=dict)
    label_smoothing: float = 0.0
    smoothing_over_others: bool = False
    clip_norm: float | None = None
    average: bool = False
    notes: str = ""


COMMON_RECIPE: Mapping[str, Any] = {
    "optimizer": "adamw",
    "lr": 1e-3,
    "weight_decay": 0.01,
    "batch_size": 32,
    "epochs": None,
    "schedule": "warm-up-stable-decay",
    "schedule_options": {},
    "label_smoothing": 0.1,
    "smoothing_over_others": False,
}
"""What the common recipe changes about every published one, the same for all.

Published schedules are made for hundreds of epochs and cannot be gone on with. Squeezed into a few,
PointNet's staircase stops learning before it has begun.
"""


@dataclass(frozen=True)
class ModelCard:
    """One literal, frozen entry of the model table.

    Attributes:
        name: as on the command line.
        entry: "module:factory"; called as factory(num_classes, **options) → ``nn.Module``.
        title: as printed in tables.
        paper, reference, reference_licence: publication, owner/repository@commit, its licence.
        inputs: what it is called with beside the points: "normals", as ``forward``'s argument of
            that name; its ``nn.Module`` says so too, by ``needs_normals``.
        representation: what the network sees, as in the paper's table ("pc (1024×3)").
        invariances: claimed of the class logits: "permutation", "rotation" (any), both or none.
        parameters: {num_classes: count}.
        recipe: published training recipe.
        common: what this model changes about ``COMMON_RECIPE``, such as the rate that its trials
            on the validation split chose.
        published: "module:convert" from a published state dict to ours, or "" where there is none.
        published_options: of the factory, to compute as that implementation did where the row
            does not; ``load_published`` sets them.
        paper_scores: the paper's table 1: {"pm40": 68.8, "ps15": …, "pm40>ps15": …, …}.
        choices: what the publication leaves open and how it is settled here.
        deviations: what differs from the publication, and why.
    """

    name: str
    entry: str
    title: str
    paper: str
    reference: str = ""
    reference_licence: str = ""
    representation: str = ""
    inputs: tuple[str, ...] = ()
    invariances: frozenset[str] = frozenset()
    parameters: Mapping[int, int] = field(default_factory=dict)
    recipe: Recipe = field(default_factory=Recipe)
    common: Mapping[str, Any] = field(default_factory=dict)
    published: str = ""
    published_options: Mapping[str, Any] = field(default_factory=dict)
    paper_scores: Mapping[str, float] = field(default_factory=dict)
    choices: tuple[str, ...] = ()
    deviations: tuple[str, ...] = ()


CARD_TABLES: tuple[str, ...] = (
    "baselines.cards:CARDS",
    "baselines.modern_cards:CARDS",
    "baselines.backbone_cards:CARDS",
    "papnet.cards:CARDS",
)

OPEN_SOURCE = "renderers.sources.open:open_source"
"""Opens a source by name, or whatever a path is: an archive, a tree, a folder, an HDF5 file."""

SOURCES: dict[str, str] = {
    "parametric": "renderers.shapes.source:ParametricShapes",
    "folder": "renderers.sources.folder:MeshFolder",
    "clouds": "renderers.sources.clouds:CompleteClouds",
    "scannet": "renderers.sources.scannet.source:ScanNetInstances",
    "rooms": "renderers.rooms.source:SimulatedRooms",
}

DATASET_IDS: dict[str, tuple[str, str]] = {
    "parametric": ("pm40-parametric", "mitsuba"),
    "modelnet40": ("pm40", "mitsuba"),
    "folder": ("pm40-custom", "mitsuba"),
    "clouds": ("pm40-clouds", "hpr"),
    "custom-clouds": ("pm40-custom-clouds", "hpr"),
    "scannet": ("ps15", "scan-hpr"),
    "rooms": ("ps15-rooms", "scan-hpr"),
}
"""Source name → (data set id, occluder). Different ids never share a table's column."""


def data_set_of(described: Mapping[str, Any]) -> tuple[str, str]:
    """(data set id, occluder) of what a source says of itself.

    Scans seen from where a person could stand are another data set than scans seen as in the paper.
    """
    dataset_id, occluder = DATASET_IDS[described["name"]]
    standing = described.get("viewpoints") == "standing"
    return (f"{dataset_id}-standing" if standing else dataset_id), occluder


OCCLUDERS: dict[str, str] = {
    "mitsuba": "renderers.mitsuba_depth:MitsubaOccluder",
    "hpr": "renderers.hpr:HprOccluder",
    "scan-hpr": "renderers.sources.scannet.occluder:ScanHprOccluder",
    "whole": "renderers.whole:WholeOccluder",
}


READ_SHAPE = "renderers.sources.single:read_shape"
"""One mesh or cloud, a file or in memory, in the unit ball."""

MAKE_SENSOR = "renderers.sensors:make_sensor"
"""A depth sensor by name and strength."""

PICK_VARIANT = "renderers.variants:pick_variant"
"""Tries a Mitsuba variant."""

LEADERBOARD = "leaderboard.build:build_leaderboard"
BOARD_FILES = "leaderboard.build:board_files"
WRITE_BOARD = "leaderboard.output:write_board"
SHAPE_EXPORT = "renderers.shapes.export:export_tree"
RELEASES: dict[str, str] = {
    "papnet": "renderers.release:import_release",
    "scanobjectnn": "renderers.scanobjectnn:import_scanobjectnn",
}
"""Layouts of published arrays that ``partialbench import`` reads."""


def load(entry: str) -> Any:
    """The object behind a table's "module:object". Errors name the part that failed."""
    module_name, _, attribute = entry.partition(":")
    if not module_name or not attribute:
        raise InputError(f"{entry!r} is not of the form module:object, e.g. my_model:make")
    user_code.ours_first()
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name and (module_name + ".").startswith(error.name + "."):
            raise InputError(
                f"no module named {error.name!r} (from {entry!r}); "
                f"run from the folder that holds it, or install it"
            ) from error
        if missing := extras.explained(error):
            raise missing from error
        raise
    try:
        return getattr(module, attribute)
    except AttributeError:
        near = close_matches(attribute, [n for n in dir(module) if not n.startswith("_")])
        raise InputError(f"module {module_name!r} has no {attribute!r}{near}") from None


def close_matches(name: Any, known: Iterable[str]) -> str:
    """ "; did you mean a, b?", or "; known: …" when nothing is close."""
    known = sorted(known)
    near = difflib.get_close_matches(str(name), known, n=3, cutoff=0.5)
    if near:
        return f"; did you mean {', '.join(near)}?"
    return f"; known: {', '.join(known)}" if known else ""


def unique(cards: Iterable[ModelCard]) -> dict[str, ModelCard]:
    """Cards by name; a repeated name raises ``ValueError``."""
    table: dict[str, ModelCard] = {}
    for card in cards:
        if card.name in table:
            raise ValueError(
                f"model name {card.name!r} is registered twice: {table[card.name].entry} "
                f"and {card.entry}; rename one"
            )
        table[card.name] = card
    return table


def card_data(card: ModelCard) -> dict[str, Any]:
    """A card as JSON data."""
    data = dataclasses.asdict(card)
    return {**data, "invariances": sorted(card.invariances)}


def cards() -> dict[str, ModelCard]:
    """Every registered model's card by name, in table order. Loads no torch."""
    return unique(card for table in CARD_TABLES for card in load(table))


def card(name: str) -> ModelCard:
    """The card of one model; an unknown name raises ``InputError`` with close matches."""
    table = cards()
    if name not in table:
        raise InputError(f"no model named {name!r}{close_matches(name, table)}")
    return table[name]


def list_models(pattern: str = "*", pretrained: bool = False) -> list[str]:
    """The names of the registered models, in the order of the table. Loads no torch.

    Args:
        pattern: as a shell has it: "pointnet*".
        pretrained: only those whose weights come with this release.

    >>> list_models("papnet*")
    ['papnet', 'papnet-steered', 'papnet-steered-nopose']
    """
    from partialbench import given
    from partialbench.benchmark.records import weights  # pydantic, not by every --help

    if not isinstance(pattern, str):
        raise InputError(f"a pattern of names is a text such as 'pointnet*', got {pattern!r}")
    pretrained = given.truth(pretrained, "pretrained")
    packed = weights.names()
    return [
        name
        for name in cards()
        if fnmatch.fnmatchcase(name, pattern) and (name in packed or not pretrained)
    ]


def create(name: str, num_classes: int, /, **options: Any) -> nn.Module:
    """A freshly initialised model.

    Args:
        name: a registered name, or a user's "module:factory".
        num_classes: K ≥ 2.
        options: passed to the factory (PAPNet's ablations, for instance), see ``options.typed``.

    Returns:
        A module that takes (B,N,3) camera-frame clouds and returns a ``Prediction``; a user's own
        factory may return a module with bare (B,K) logits.
    """
    from partialbench import given  # with NumPy and SciPy, which the command line's help can spare

    num_classes = given.whole_number(num_classes, "num_classes")
    if num_classes < 2:
        raise InputError(f"a classifier needs two classes or more, got {num_classes}")
    factory = factory_of(name)
    chosen = option_types.typed(name, factory, options)
    return factory(num_classes, **option_types.as_called(factory, chosen))


def factory_of(name: str) -> Callable[..., nn.Module]:
    """What makes a model of that name: a registered one, or a user's "module:factory"."""
    own = user_code.is_own(name)
    factory = user_code.load(name) if own else load(card(name).entry)
    if not callable(factory):
        raise InputError(
            f"{name} is a {type(factory).__name__}; expected something to call as "
            f"factory(num_classes) that returns the model"
        )
    return factory


def options_of(name: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Options as they are stored: of the types that the factory's parameters have."""
    return option_types.typed(name, factory_of(name), given)


def load_published(name: str, state: Mapping[str, Any], num_classes: int) -> nn.Module:
    """A model in evaluation mode with the weights of its published implementation.

    It computes what that implementation did, by the card's ``published_options``, of clouds that
    are centred and scaled first, as its data is before it comes to the network.

    Args:
        state: published parameter names → arrays (numpy or torch, of any precision), or a
            checkpoint that has them in one of ``PUBLISHED_UNDER``. Counters of batches may be
            missing.

    Raises:
        InputError: naming the entry that is unknown, missing, no array or of another shape.
    """
    entry = card(name)
    if not entry.published:
        raise InputError(f"{name!r} has no published weights we can convert (reference: "
                         f"{entry.reference or 'none'})")  # fmt: skip
    weights = _published_weights(state)
    model = create(name, num_classes, **entry.published_options)
    model.load_state_dict(load(entry.published)(weights, model))
    return model.eval()


PUBLISHED_UNDER = ("model_state_dict", "state_dict", "model_state", "model", "net")
"""Where training scripts keep the weights in a checkpoint that has more."""


def _published_weights(state: Any) -> dict[str, Tensor]:
    """The weights of a published checkpoint by name, without ``nn.DataParallel``'s prefix."""
    import torch

    if not isinstance(state, Mapping):
        raise InputError(
            f"published weights are a mapping of names to arrays, got a {type(state).__name__}; "
            f"of a file it is what torch.load returns, of a module its state_dict()"
        )
    for key in PUBLISHED_UNDER:
        if isinstance(state.get(key), Mapping):
            return _published_weights(state[key])
    weights = {}
    for name, value in state.items():
        try:
            weights[str(name).removeprefix("module.")] = torch.as_tensor(value)
        except (TypeError, ValueError, RuntimeError):
            raise InputError(
                f"the published {name!r} is a {type(value).__name__}, expected an array; the "
                f"weights of a checkpoint are looked for in {', '.join(PUBLISHED_UNDER)}"
            ) from None
    return weights


def occluder_entry(name: str) -> str:
    """The "module:object" of a named occluder."""
    if name not in OCCLUDERS:
        raise InputError(f"no occluder named {name!r}{close_matches(name, OCCLUDERS)}")
    return OCCLUDERS[name]
