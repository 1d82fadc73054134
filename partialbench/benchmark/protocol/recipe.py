"""What our protocol changes about a published recipe, in fields and in words."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.protocol.protocol import Protocol, is_number
from partialbench.benchmark.protocol.schedule import GROWN
from partialbench.benchmark.protocol.schedule import check as check_schedule
from partialbench.errors import InputError
from partialbench.registry import COMMON_RECIPE, ModelCard, Recipe, close_matches

OPTIMIZERS = ("adam", "adamw", "muon", "sgd")

LATER: Mapping[str, Any] = {"average": False}
"""Fields that recipes were given after records of them were written. With these values they are not
written, so that a recipe is still the one that an earlier record names."""


def label_smoothing(recipe: Recipe, num_classes: int) -> float:
    """The recipe's smoothing in torch's sense: ε over the others is ε·K/(K − 1) over all."""
    if recipe.smoothing_over_others:
        return recipe.label_smoothing * num_classes / (num_classes - 1)
    return recipe.label_smoothing


def of_protocol(card: ModelCard, protocol: Protocol) -> Recipe:
    """The recipe with which a protocol trains a model: the published one or the common one."""
    if protocol.recipe == "published":
        return card.recipe
    return override(card.recipe, {**COMMON_RECIPE, **card.common})


def require_fits(recipe: Recipe, protocol: Protocol) -> None:
    """Raises InputError where a recipe's schedule is not of the protocol's kind."""
    if (recipe.schedule == GROWN) == (protocol.recipe == "common"):
        return
    raise InputError(
        f"the schedule {recipe.schedule!r} does not go with the protocol's recipe="
        f"{protocol.recipe!r}: "
        + (
            f"rows of a table share {GROWN!r}; --preset paper has the published schedules"
            if protocol.recipe == "common"
            else "published recipes keep theirs"
        )
    )


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
    fields = {**LATER, **as_dict(override(own, wanted))}
    before = {**LATER, **as_dict(own)}
    return {name: fields[name] for name in wanted if fields[name] != before[name]}


_NUMBERS: dict[str, tuple[str, Callable[[float], bool]]] = {
    "lr": ("a number, not negative", lambda v: v >= 0),
    "weight_decay": ("a number, not negative", lambda v: v >= 0),
    "momentum": ("a number in [0, 1)", lambda v: 0 <= v < 1),
    "label_smoothing": ("a number in [0, 1)", lambda v: 0 <= v < 1),
    "clip_norm": ("a positive number or null", lambda v: v > 0),
    "batch_size": ("a whole number, 2 or more", lambda v: v >= 2 and v == int(v)),
    "epochs": ("a positive whole number or null", lambda v: v >= 1 and v == int(v)),
}


def _checked(name: str, value: Any) -> Any:
    """The value of a recipe's field as what it should be; a number may come as another kind."""
    if name in _NUMBERS:
        expected, fits = _NUMBERS[name]
        if value is None and name in ("clip_norm", "epochs"):
            return None
        if not is_number(value) or not fits(value):
            raise InputError(f"{name} of a recipe must be {expected}, got {value!r}")
        return int(value) if name in ("batch_size", "epochs") else float(value)
    if name == "optimizer" and value not in OPTIMIZERS:
        raise InputError(f"no optimizer named {value!r}{close_matches(str(value), OPTIMIZERS)}")
    kinds = {"schedule_options": Mapping, "smoothing_over_others": bool, "average": bool}
    kind = kinds.get(name, str)
    if not isinstance(value, kind):
        raise InputError(
            f"{name} of a recipe must be of type {kind.__name__.lower()}, got {value!r}"
        )
    return value


def as_dict(recipe: Recipe) -> dict[str, Any]:
    """Plain JSON data, without the fields of ``LATER`` that have its values."""
    fields = {
        name: value for name, value in dataclasses.asdict(recipe).items()
        if name not in LATER or value != LATER[name]
    }  # fmt: skip
    fields["schedule_options"] = {
        k: dict(v) if isinstance(v, Mapping) else list(v) if isinstance(v, tuple) else v
        for k, v in recipe.schedule_options.items()
    }
    return fields


def of_training(fields: Mapping[str, Any]) -> dict[str, Any]:
    """What a training depends on, of a recipe as plain data: all but the notes, which are prose.

    A sentence that is put in other words makes no other training.
    """
    return {name: value for name, value in fields.items() if name != "notes"}


def deviations(
    published: Recipe, used: Recipe, protocol: Protocol, train_clouds: int, clouds: int
) -> list[str]:
    """What this run changes about the published recipe, one sentence a change.

    Args:
        clouds: the milestone.
    """
    before, after = ({**LATER, **as_dict(recipe)} for recipe in (published, used))
    # How long a training is the milestone says too, and it has the last word.
    changes = [
        f"{name} {after[name]!r} instead of {before[name]!r}"
        for name in before
        if after[name] != before[name] and name != "epochs"
    ]
    plan = milestones.plan(protocol, used, clouds, train_clouds)
    if plan.epochs is None:
        changes.append(
            f"{milestones.describe(plan, used, train_clouds)}, instead of {published.epochs} "
            f"epochs: warm-up over {protocol.warm_up:,} clouds, a constant rate, and a decay to "
            f"zero over the last fifth"
        )
    elif plan.epochs != published.epochs:
        changes.append(
            f"{plan.epochs} epochs of {train_clouds:,} clouds instead of {published.epochs} "
            f"epochs; the schedule is scaled to that length"
        )
    if used.batch_size > train_clouds:
        changes.append(f"batches of {train_clouds} clouds, all there are, not {used.batch_size}")
    turn = "random rotation" if protocol.rotation == "so3" else "no rotation"
    stretch = (
        f"stretched by up to {protocol.stretch:g} along the object's axes"
        if protocol.stretch > 1 else "no stretching"
    )  # fmt: skip
    jitter = (
        f"jitter {protocol.jitter_sigma:g} clipped at {protocol.jitter_clip:g}"
        if protocol.jitter_sigma else "no jitter"
    )  # fmt: skip
    changes.append(
        f"the protocol's augmentation instead of the published one: {turn}, {stretch}, {jitter}, a "
        f"random "
        f"{protocol.num_points} of the {protocol.subset} points"
    )
    return changes
