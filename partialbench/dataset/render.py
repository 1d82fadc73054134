"""From the options of ``partialbench render`` to a plan: source, occluder, poses, views."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

from partialbench import given, registry
from partialbench.dataset import manifest as manifests
from partialbench.dataset.build import BuildPlan, Progress, build
from partialbench.dataset.executors import InlineExecutor, dask_cluster, process_pool
from partialbench.dataset.manifest import Manifest
from partialbench.dataset.rows import LEAST_VISIBLE, Job
from partialbench.dataset.settings import SETTINGS
from partialbench.dataset.sources import Occluder, Source
from partialbench.errors import InputError
from partialbench.extras import MissingExtraError

DEFAULT_SOURCE = {"pm40": "parametric", "ps15": "rooms"}
# The paper: ten views of every training object, one of every test object.
PAPER_VIEWS = {"pm40": {"train": 10, "test": 1}, "ps15": {"train": 10, "test": 10}}


def plan_render(
    data_set: str,
    out: Path,
    *,
    source: str | None = None,
    source_options: dict[str, Any] | None = None,
    occluder_options: dict[str, Any] | None = None,
    setting: str = "partial",
    views: int | None = None,
    splits: str | Sequence[str] | None = None,
    objects_per_class: int | None = None,
    points: int = 2048,
    min_visible: int | None = None,
    normals: bool = False,
    seed: int = 0,
    sensor: str | None = None,
    workers: int = 1,
    on_room: Callable[[int, int], None] | None = None,
    on_scene: Callable[[int, int], None] | None = None,
    rows_per_shard: int = 1000,
) -> BuildPlan:
    """The plan of one data folder.

    Args:
        data_set: "pm40" or "ps15".
        source: a registered name or a path; default: the data set's built-in source.
        source_options: passed to the source (``aligned``, ``up``, ``counts``, …).
        occluder_options: passed to the occluder (``resolution``, ``keep_depth``, ``variant``,
            ``radius``, …).
        setting: "partial", "partial-z", "partial-aligned", "rotated", "z-rotated" or "aligned".
        sensor: depth noise, of the rendered images or, for simulated rooms, of the scanner.
        workers: processes for sources that generate or list in parallel.
        on_room: called with (rooms simulated, rooms in all).
        on_scene: called with (scans listed, scans in all).
        min_visible: distinct points a view shows at least; default: 16, of a scan its rule's.
        normals: whether rows have the normals of their points.
        views: viewpoints per training object; test objects get one (PS15: the same number). Refused
            where no split that is rendered has so many.
        splits: default: all the source has.
        objects_per_class: at most so many of each class in each split.
        points: stored per cloud.
        seed: of every random draw.
        rows_per_shard: rows per file; does not change the content.

    Raises:
        InputError: unknown names (with close matches), a path that is no source, or numbers out of
            range.
    """
    # What can be wrong of the numbers is said before a source is listed or simulated.
    asked = Asked(
        setting, views, splits, objects_per_class, points, min_visible, normals, seed, sensor,
        rows_per_shard, given.mapping(occluder_options, "occluder_options"),
    )  # fmt: skip
    opened = open_source(data_set, source, source_options, asked, workers, on_room, on_scene)
    return plan_of(opened, asked, out)


@dataclass
class Asked:
    """How objects are seen and what is stored of them, checked: see ``plan_render``."""

    setting: str = "partial"
    views: int | None = None
    splits: str | Sequence[str] | None = None
    objects_per_class: int | None = None
    points: int = 2048
    min_visible: int | None = None
    normals: bool = False
    seed: int = 0
    sensor: str | None = None
    rows_per_shard: int = 1000
    occluder_options: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("points", "rows_per_shard"):
            setattr(self, name, given.whole_number(getattr(self, name), name, 1))
        self.seed = given.whole_number(self.seed, "seed")
        self.normals = given.truth(self.normals, "normals")
        for name in ("views", "objects_per_class", "min_visible"):
            if (value := getattr(self, name)) is not None:
                setattr(self, name, given.whole_number(value, name, 1))

    @property
    def whole(self) -> bool:
        """Whether complete clouds are asked for."""
        return self.setting in SETTINGS and SETTINGS[self.setting].whole


@dataclass(frozen=True)
class Opened:
    """A source that is listed, and what is made of it.

    Attributes:
        name: as it was asked for: "rooms", "scannet", or a path.
        occluder: the name of what says which points are seen from one side.
        rules: thresholds of scans that were given.
    """

    source: Source
    name: str
    data_set: str
    dataset_id: str
    occluder: str
    rules: dict[str, Any] | None = None


def open_source(
    data_set: str,
    source: str | None,
    source_options: dict[str, Any] | None,
    asked: Asked,
    workers: int = 1,
    on_room: Callable[[int, int], None] | None = None,
    on_scene: Callable[[int, int], None] | None = None,
) -> Opened:
    """Lists a source, or simulates it; of the arguments of ``plan_render``, those that say how."""
    if data_set not in DEFAULT_SOURCE:
        raise InputError(
            f"no data set {data_set!r}{registry.close_matches(data_set, DEFAULT_SOURCE)}"
        )
    of_source = given.mapping(source_options, "source_options")
    if data_set == "ps15" and asked.min_visible is not None:
        # One of the rules by which scans are judged.
        rules, least = of_source.get("rules") or {}, asked.min_visible
        if (ruled := rules.get("min_visible", least)) != least:
            raise InputError(
                f"min_visible is {least} and the rule min_visible is {ruled!r}: they are one "
                f"threshold of scans; give one of them"
            )
        of_source["rules"] = {**rules, "min_visible": least}
    if source is None:
        source = "scannet" if "scannet" in of_source else DEFAULT_SOURCE[data_set]
    # One seed is behind everything that is generated; a scanned room was seen by its own sensor.
    if source == "parametric":
        of_source["seed"] = asked.seed
    elif source == "rooms":
        of_source |= {"seed": asked.seed, "workers": workers}
        of_source |= {"on_progress": on_room, "on_scene": on_scene}
        of_source |= {"sensor": asked.sensor} if asked.sensor else {}
    elif source == "scannet":
        of_source |= {"workers": workers, "on_scene": on_scene}
    shapes: Source = registry.load(registry.OPEN_SOURCE)(source, **of_source)
    dataset_id, occluder = _makes(shapes, source, data_set)
    return Opened(shapes, source, data_set, dataset_id, occluder, of_source.get("rules"))


def plan_of(opened: Opened, asked: Asked, out: Path) -> BuildPlan:
    """What is made of an opened source."""
    chosen = _chosen_splits(asked.splits, opened.source)
    occluder_name, options = opened.occluder, dict(asked.occluder_options)
    if asked.whole:
        occluder_name, options["samples"] = "whole", asked.points
    if occluder_name == "scan-hpr" and opened.rules is not None:
        options["rules"] = opened.rules
    if asked.sensor and opened.name != "rooms":
        options["sensor"] = asked.sensor
    if asked.normals:
        options["normals"] = True
    occluder = _make_occluder(occluder_name, options)
    least = LEAST_VISIBLE if asked.min_visible is None else asked.min_visible
    least = getattr(occluder, "min_visible", least)
    per_split = _views_per_split(opened.data_set, asked.views, chosen)
    most = asked.objects_per_class
    return BuildPlan(
        Job(
            opened.source, occluder, opened.dataset_id, asked.setting, per_split, asked.points,
            asked.seed, least,
        ),
        Path(out),
        chosen,
        None if most is None else dict.fromkeys(chosen, most),
        asked.rows_per_shard,
    )  # fmt: skip


def _makes(shapes: Source, source: str, data_set: str) -> tuple[str, str]:
    """What a source makes: the data set's id, which must be one of ``data_set``, and by which
    occluder."""
    described = shapes.describe()
    dataset_id, occluder = registry.data_set_of(described)
    if not dataset_id.startswith(data_set):
        raise InputError(
            f"source {source!r} ({described['name']}) makes {dataset_id}, not {data_set}: run "
            f"'partialbench render {dataset_id[:4]}'"
        )
    return dataset_id, occluder


def _chosen_splits(asked: str | Sequence[str] | None, shapes: Source) -> tuple[str, ...]:
    chosen = tuple(dict.fromkeys(given.several(asked, "splits") or shapes.splits()))
    if unknown := [s for s in chosen if s not in shapes.splits()]:
        raise InputError(f"the source has no split {unknown[0]!r}; it has {shapes.splits()}")
    return chosen


def _views_per_split(data_set: str, views: int | None, splits: Sequence[str]) -> dict[str, int]:
    if views is None:
        return dict(PAPER_VIEWS[data_set])
    per_split = {"train": views, "test": views if data_set == "ps15" else 1}
    if views not in (per_split[split] for split in splits):
        raise InputError(
            f"views={views} would have no effect: it is the number of viewpoints of a training "
            f"object, a test object of {data_set} has one, and only the split {', '.join(splits)} "
            f"is rendered; leave it out, or render the training split"
        )
    return per_split


def render_dataset(
    source: str | PathLike[str] | None,
    out: Path | str,
    *,
    data_set: str = "pm40",
    workers: int = 1,
    scheduler: str | None = None,
    make_executor: Callable[[], Executor] | None = None,
    on_listing: Callable[[str], None] | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    retry_failed: bool = False,
    **options: Any,
) -> Manifest:
    """Make a data folder, or continue it where it stopped: ``partialbench render``.

    Args:
        source: a name or a path, see ``plan_render``; None for the built-in one.
        out: the data folder.
        workers: processes; one is this process itself. (With more, a script needs the usual
            ``if __name__ == "__main__":``.)
        scheduler: address of a Dask cluster to run on ("tcp://host:8786").
        make_executor: opens another executor to run on.
        on_listing: told in words how the source's files were understood.
        on_progress: called after every object.
        retry_failed: see ``build``.
        options: those of ``plan_render`` (``views``, ``points``, ``sensor``, …).

    Returns:
        The manifest of the complete folder. Inputs that could not be used do not raise: they are in
        ``manifest.failures`` and failures.jsonl.

    Raises:
        InputError: see ``plan_render`` and ``build``; nothing is made then.
        PartialbenchError: the folder holds other data, is in use, or cannot be written.

    ::

        manifest = partialbench.render_dataset("meshes/", "data/mine", views=4, workers=8)
        manifest.rows("train"), manifest.failures
    """
    known = set(inspect.signature(plan_render).parameters)
    for name in options:
        if name not in known:
            raise InputError(
                f"render_dataset has no option {name!r}{registry.close_matches(name, known)}. How "
                f"shapes are read is told by source_options={{…}} (up, counts, …), how they are "
                f"seen by occluder_options={{…}} (resolution, camera, …)"
            )
    place = None if source is None else str(given.path(source, "the source"))
    workers = given.whole_number(workers, "workers", 1)
    out = given.path(out, "the data folder")
    plan = plan_render(data_set, out, source=place, workers=workers, **options)
    return run_plan(
        plan, workers=workers, scheduler=scheduler, make_executor=make_executor,
        on_listing=on_listing, on_progress=on_progress, retry_failed=retry_failed,
    )  # fmt: skip


def run_plan(
    plan: BuildPlan,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    make_executor: Callable[[], Executor] | None = None,
    on_listing: Callable[[str], None] | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    retry_failed: bool = False,
) -> Manifest:
    """Makes what a plan says: the second half of ``render_dataset``, which has the arguments."""
    if on_listing and (words := getattr(plan.job.source, "listing", "")):
        on_listing(words)
    if scheduler is not None:
        cluster = dask_cluster(scheduler)
        workers = cluster.workers
        cluster.shutdown()
        make_executor = partial(dask_cluster, scheduler)
    elif make_executor is None:
        make_executor = InlineExecutor if workers == 1 else partial(process_pool, workers)
    return build(plan, make_executor, workers, on_progress, retry_failed)


def _make_occluder(name: str, options: dict[str, Any]) -> Occluder:
    factory = registry.load(registry.occluder_entry(name))
    known = inspect.signature(factory).parameters
    if foreign := [option for option in options if option not in known]:
        raise InputError(
            f"{foreign[0]}={options[foreign[0]]!r} does not apply: these clouds are made by the "
            f"occluder {name!r}, which takes {', '.join(known)}"
        )
    return factory(**options)


def source_of(
    folder: Path, name_or_path: str | None = None, options: dict[str, Any] | None = None
) -> tuple[Source | None, str]:
    """The source a data folder was made from, for checking its points against surfaces.

    Args:
        name_or_path: where the source is; without it, only the built-in shapes are at hand.
        options: where else to look (``scannet``, ``scan2cad``). How the source was read is taken
            from the manifest.

    Returns:
        The source; or None, and why the folder's rows cannot be held against one.

    Raises:
        InputError: no data folder, or ``name_or_path`` is no source.
    """
    recorded = manifests.load(folder).configuration["source"]
    if name_or_path is None and recorded["name"] != "parametric":
        return None, "no source given (use --source)"
    if name_or_path in (None, "parametric") and recorded["name"] == "parametric":
        try:
            cls = registry.load(registry.SOURCES["parametric"])
            return cls.from_description(recorded), ""
        except (InputError, MissingExtraError) as error:
            return None, str(error)
    opened = registry.load(registry.OPEN_SOURCE)(
        name_or_path, described=recorded, **(options or {})
    )
    # What a later release records besides is no difference.
    described = {key: value for key, value in opened.describe().items() if key in recorded}
    others = manifests.differences(recorded, described)
    if not others:
        return opened, ""
    said = [f"{key}: folder has {there!r}, source has {here!r}" for key, there, here in others[:3]]
    more = f" and {len(others) - 3} more" if len(others) > 3 else ""
    return None, f"the source is not what the folder was made from: {'; '.join(said)}{more}"
