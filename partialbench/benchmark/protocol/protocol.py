"""The protocol: what every model is given alike. Frozen, versioned, digested.

Two results may stand in one column only when their protocol digests and their milestones agree.
What a protocol fixes:

- Training objects are split by object, never by view, into train and validation (``split``).
- The weights at the milestone are evaluated. Validation is logged and selects nothing.
- Every training cloud is a random subset of its row's points, turned by a random rotation,
  stretched and jittered where the protocol asks for it, the same for every model: a function of
  (seed, epoch, batch), whatever the hardware. Clouds of an aligned setting are not turned, for
  then they would be "rotated"; those turned about z are turned about z again.
- Every model takes the common recipe (``registry.COMMON_RECIPE``) and is a trunk with a branch at
  each milestone, or it keeps its published one (``registry.Recipe``) over its whole length.

How many clouds are seen is no field: one training serves every milestone (``milestones``).
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from partialbench.errors import InputError
from partialbench.registry import close_matches

PROTOCOL_VERSION = 3

_LEAST = {
    "num_points": 1, "max_train_clouds": 1, "max_test_clouds": 1, "split_seed": 0, "warm_up": 0,
}  # fmt: skip
"""The whole numbers among the fields, and the least that each may be."""
_OPTIONAL = ("max_train_clouds", "max_test_clouds")


def is_number(value: Any) -> bool:
    """Whether it is a finite number; True and False are none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


@dataclass(frozen=True)
class Protocol:
    """What is the same for every model of a column.

    Attributes:
        preset: the name it came from; "smoke+" and the like once a field was overridden.
        num_points: points of a cloud, in training and in testing.
        max_train_clouds, max_test_clouds: class-balanced subsets of at most so many, or None.
        validation_fraction: share of each class's training objects held out.
        split_seed: chooses which.
        rotation: "so3" (uniform random rotation of every training cloud) or "none".
        stretch: each training cloud is stretched along the axes of its object, which the pose of
            its label gives, by log-uniform factors between 1/stretch and stretch; 1 for not at all.
        jitter_sigma, jitter_clip: Gaussian noise on every training point, object units.
        recipe: "published", each model's own over its whole length, or "common",
            ``registry.COMMON_RECIPE`` with what the model's card changes about it.
        subset: of which points a training cloud is a random subset: the "distinct" ones, with
            repeats where there are too few, as in testing, or all "stored" ones, the repeats that
            fill a row of few visible points among them.
        warm_up: clouds over which the rate of the common recipe rises; 0 for a published one.
    """

    preset: str
    num_points: int = 1024
    max_train_clouds: int | None = None
    max_test_clouds: int | None = None
    validation_fraction: float = 0.1
    split_seed: int = 0
    rotation: str = "so3"
    stretch: float = 1.0
    jitter_sigma: float = 0.0
    jitter_clip: float = 0.05
    recipe: str = "common"
    subset: str = "distinct"
    warm_up: int = 0
    version: int = PROTOCOL_VERSION

    def __post_init__(self) -> None:
        if not isinstance(self.preset, str) or not self.preset:
            raise InputError(f"preset must be a name, got {self.preset!r}")
        # One kind for each number: 0 and 0.0 are one protocol, and are to have one digest.
        for name, least in _LEAST.items():
            value = getattr(self, name)
            if value is None and name in _OPTIONAL:
                continue
            if not is_number(value) or value != int(value) or value < least:
                kind = "positive whole number" if least else "whole number"
                raise InputError(f"{name} must be a {kind}, got {value!r}")
            object.__setattr__(self, name, int(value))
        for name in ("validation_fraction", "stretch", "jitter_sigma", "jitter_clip"):
            value = getattr(self, name)
            if not is_number(value):
                raise InputError(f"{name} must be a number, got {value!r}")
            object.__setattr__(self, name, float(value))
        if self.rotation is None:  # as a command line reads rotation=none
            object.__setattr__(self, "rotation", "none")
        if not 0 <= self.validation_fraction < 1:
            raise InputError(
                f"validation_fraction must be in [0, 1), got {self.validation_fraction!r}"
            )
        if self.rotation not in ("so3", "none"):
            raise InputError(f"rotation must be 'so3' or 'none', got {self.rotation!r}")
        if self.subset not in ("stored", "distinct"):
            raise InputError(f"subset must be 'stored' or 'distinct', got {self.subset!r}")
        if self.recipe not in ("published", "common"):
            raise InputError(f"recipe must be 'published' or 'common', got {self.recipe!r}")
        if self.recipe == "published" and self.warm_up:
            raise InputError(
                f"warm_up={self.warm_up} would have no effect on published recipes, which have "
                f"schedules of their own; give warm_up=0"
            )
        if self.stretch < 1:
            raise InputError(f"stretch must be 1 (none) or more, got {self.stretch}")
        if self.jitter_sigma < 0 or self.jitter_clip < 0:
            raise InputError(
                f"jitter must not be negative, got sigma {self.jitter_sigma}, "
                f"clip {self.jitter_clip}"
            )

    def as_dict(self) -> dict[str, Any]:
        """Plain JSON data."""
        return dataclasses.asdict(self)

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of every field but the preset's name: what is done, not its name."""
        fields = self.as_dict()
        del fields["preset"]
        return hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()


FIELDS = tuple(
    field.name for field in dataclasses.fields(Protocol) if field.name not in ("preset", "version")
)
"""What may be overridden."""

PRESETS: dict[str, Protocol] = {
    # Shows that everything runs: seconds for most models, a minute or two on two cores for those on
    # 64³ grids, which take one to two seconds a training cloud.
    "smoke": Protocol("smoke", num_points=256, max_train_clouds=32, max_test_clouds=16),
    # The table's: one recipe, clouds in training as they are in testing, compared at milestones.
    "board": Protocol("board", num_points=256, max_test_clouds=2_500, warm_up=6_400),
    # The paper's scale, each model by its published recipe.
    "paper": Protocol("paper", recipe="published", subset="stored", jitter_sigma=0.01),
}

DEFAULT_PRESET = "board"

DEFAULT_CLOUDS: Mapping[str, tuple[int, ...]] = {
    "smoke": (64,),
    "board": (100_000,),
    # 2.5 million clouds are the 250 epochs over ModelNet40's 9,840 training objects behind
    # PointNet's, PointNet++'s and DGCNN's published figures; PAPNet's 20 epochs of PM40 are 2.0
    # million and stay 20 epochs.
    "paper": (2_500_000,),
}
"""The milestones of a preset where none are asked for."""


def default_clouds(protocol: Protocol) -> tuple[int, ...]:
    """The milestones of the preset that a protocol came from."""
    return DEFAULT_CLOUDS[protocol.preset.removesuffix("+")]


def protocol(preset: str, /, **overrides: Any) -> Protocol:
    """A preset, with fields overridden. Overriding makes another protocol with its own digest, but
    where it makes a preset, that one.

    Raises:
        InputError: unknown preset or field (with close matches), or a value out of range.
    """
    if not isinstance(preset, str) or preset not in PRESETS:
        raise InputError(f"no preset named {preset!r}{close_matches(preset, PRESETS)}")
    chosen = PRESETS[preset]
    for name in overrides:
        if name not in FIELDS:
            raise InputError(f"the protocol has no field {name!r}{close_matches(name, FIELDS)}")
    changed = dataclasses.replace(chosen, preset=f"{preset}+", **overrides)
    for same in (chosen, *PRESETS.values()):
        if same.digest == changed.digest:
            return same
    return changed


def from_dict(fields: dict[str, Any]) -> Protocol:
    """The protocol that ``as_dict`` wrote."""
    known = {f.name for f in dataclasses.fields(Protocol)}
    if set(fields) != known or fields["version"] != PROTOCOL_VERSION:
        raise InputError(
            f"not a protocol of version {PROTOCOL_VERSION}: "
            f"missing {sorted(known - set(fields))}, unknown {sorted(set(fields) - known)}"
        )
    return Protocol(**fields)
