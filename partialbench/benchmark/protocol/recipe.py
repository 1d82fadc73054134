"""What our protocol changes about a published recipe, in fields and in words."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from partialbench.benchmark.protocol.protocol import Protocol, is_number
from partialbench.benchmark.protocol.schedule import check as check_schedule
from partialbench.errors import InputError
from partialbench.registry import SHORT_RECIPE, ModelCard, Recipe, close_matches

OPTIMIZERS = ("adam", "adamw", "muon", "sgd")


def label_smoothing(recipe: Recipe, num_classes: int) -> float:
    """The recipe's smoothing in torch's sense: ε over the others is ε·K/(K − 1) over all."""
    if recipe.smoothing_over_others:
        return recipe.label_smoothing * num_classes / (num_classes - 1)
    return recipe.label_smoothing


def of_protocol(card: ModelCard, protocol: Protocol) -> Recipe:
    """The recipe with which a protocol trains a model: the published one or the short one."""
    if protocol.recipe == "published":
        return card.recipe
    return override(card.recipe, {**SHORT_RECIPE, **card.short})


def override(recipe: Recipe, changes: Mapping[str, Any]) -> Recipe:
    """The recipe with fields changed.

    Raises:
        InputError: an unknown field, or a value with which it cannot train.
    """
    known = [f.name for f in dataclasses.fields(Recipe)]
    for name in changes:
        if name not in known:
            raise InputError(f"a recipe has no field {name!r}{close_matches(name, known)}")
    changed = dataclasses.replace(
        recipe, **{name: _checked(name, value) for name, value in changes.items()}
    )
    if changes:
        check_schedule(changed)
    return changed


def changes(own: Recipe, wanted: Mapping[str, Any]) -> dict[str, Any]:
    """What of ``wanted`` differs from a model's own recipe: the rest makes no other row."""
    fields = as_dict(override(own, wanted))
    before = as_dict(own)
    return {name: fields[name] for name in wanted if fields[name] != before[name]}


_NUMBERS: dict[str, tuple[str, Callable[[float], bool]]] = {
    "lr": ("a number, not negative", lambda v: v >= 0),
    "weight_decay": ("a number, not negative", lambda v: v >= 0),
    "momentum": ("a number in [0, 1)", lambda v: 0 <= v < 1),
    "label_smoothing": ("a number in [0, 1)", lambda v: 0 <= v < 1),
    "clip_norm": ("a positive number or null", lambda v: v > 0),
    "batch_size": ("a whole number, 2 or more", lambda v: v >= 2 and v == int(v)),
    "epochs": ("a positive whole number", lambda v: v >= 1 and v == int(v)),
}


def _checked(name: str, value: Any) -> Any:
    """The value of a recipe's field as what it should be; a number may come as another kind."""
    if name in _NUMBERS:
        expected, fits = _NUMBERS[name]
        if value is None and name == "clip_norm":
            return None
        if not is_number(value) or not fits(value):
            raise InputError(f"{name} of a recipe must be {expected}, got {value!r}")
        return int(value) if name in ("batch_size", "epochs") else float(value)
    if name == "optimizer" and value not in OPTIMIZERS:
        raise InputError(f"no optimizer named {value!r}{close_matches(str(value), OPTIMIZERS)}")
    kinds = {"schedule_options": Mapping, "smoothing_over_others": bool}
    kind = kinds.get(name, str)
    if not isinstance(value, kind):
        raise InputError(
            f"{name} of a recipe must be of type {kind.__name__.lower()}, got {value!r}"
        )
    return value


def as_dict(recipe: Recipe) -> dict[str, Any]:
    """Plain JSON data."""
    fields = dataclasses.asdict(recipe)
    fields["schedule_options"] = {
        k: dict(v) if isinstance(v, Mapping) else list(v) if isinstance(v, tuple) else v
        for k, v in recipe.schedule_options.items()
    }
    return fields


def deviations(published: Recipe, used: Recipe, protocol: Protocol, train_clouds: int) -> list[str]:
    """What this run changes about the published recipe, one sentence a change."""
    before, after = as_dict(published), as_dict(used)
    # How many epochs there are the protocol says too, and it has the last word.
    changes = [
        f"{name} {after[name]!r} instead of {before[name]!r}"
        for name in before
        if after[name] != before[name] and name != "epochs"
    ]
    epochs = protocol.num_epochs(used, train_clouds)
    if epochs != published.epochs:
        changes.append(
            f"{epochs} epochs of {train_clouds:,} clouds instead of {published.epochs} epochs; the "
            f"schedule is scaled to that length"
        )
    if used.batch_size > train_clouds:
        changes.append(f"batches of {train_clouds} clouds, all there are, not {used.batch_size}")
    turn = "random rotation" if protocol.rotation == "so3" else "no rotation"
    jitter = (
        f"jitter {protocol.jitter_sigma:g} clipped at {protocol.jitter_clip:g}"
        if protocol.jitter_sigma else "no jitter"
    )  # fmt: skip
    changes.append(
        f"the protocol's augmentation instead of the published one: {turn}, {jitter}, a random "
        f"{protocol.num_points} of the {protocol.subset} points"
    )
    return changes
