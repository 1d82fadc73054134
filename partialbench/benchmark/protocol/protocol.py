"""The protocol: what every model is given alike. Frozen, versioned, digested.

Two results may stand in one column only when their protocol digests agree. What a protocol fixes:

- Training objects are split by object, never by view, into train and validation (``split``).
- The weights after the last epoch are evaluated. Validation is logged and selects nothing.
- Every training cloud is a random subset of its row's points, turned by a random rotation and
  jittered, the same for every model: a function of (seed, epoch, batch), whatever the hardware.
  Clouds of the "aligned" setting are not turned, for then they would be "rotated".
- A model keeps its published recipe (``registry.Recipe``), or every model takes the same short one
  (``registry.SHORT_RECIPE``). Either way the number of epochs is cut to the preset's budget of
  clouds seen; the schedule is stretched or shrunk along (``schedule``).
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from dataclasses import dataclass
from typing import Any

from partialbench.errors import InputError
from partialbench.registry import Recipe, close_matches

PROTOCOL_VERSION = 2

_ADDED = {"subset": "stored"}
"""Fields that the first protocols of this version did not have, with what those did: at that value
a field does not enter the digest, so that their columns stand."""


_LEAST = {
    "num_points": 1, "clouds_seen": 1, "epochs": 1, "max_train_clouds": 1, "max_test_clouds": 1,
    "split_seed": 0,
}  # fmt: skip
"""The whole numbers among the fields, and the least that each may be."""
_OPTIONAL = ("epochs", "max_train_clouds", "max_test_clouds")


def is_number(value: Any) -> bool:
    """Whether it is a finite number; True and False are none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


@dataclass(frozen=True)
class Protocol:
    """What is the same for every model of a column.

    Attributes:
        preset: the name it came from; "smoke+" and the like once a field was overridden.
        num_points: points of a cloud, in training and in testing.
        clouds_seen: budget of training clouds, repeats counted. The number of epochs is this over
            the training set's size, at most the recipe's own number, at least one.
        epochs: an exact number of epochs instead, or None.
        max_train_clouds, max_test_clouds: class-balanced subsets of at most so many, or None.
        validation_fraction: share of each class's training objects held out.
        split_seed: chooses which.
        rotation: "so3" (uniform random rotation of every training cloud) or "none".
        jitter_sigma, jitter_clip: Gaussian noise on every training point, object units.
        recipe: "published", each model's own, or "short", ``registry.SHORT_RECIPE`` with what the
            model's card changes about it.
        subset: of which points a training cloud is a random subset: all "stored" ones, the repeats
            that fill a row of few visible points among them, or the "distinct" ones, with repeats
            where there are too few, as in testing.
    """

    preset: str
    num_points: int = 1024
    clouds_seen: int = 2_500_000
    epochs: int | None = None
    max_train_clouds: int | None = None
    max_test_clouds: int | None = None
    validation_fraction: float = 0.1
    split_seed: int = 0
    rotation: str = "so3"
    jitter_sigma: float = 0.01
    jitter_clip: float = 0.05
    recipe: str = "published"
    version: int = PROTOCOL_VERSION
    subset: str = "stored"

    def __post_init__(self) -> None:
        # One kind for each number: 0 and 0.0 are one protocol, and are to have one digest.
        for name, least in _LEAST.items():
            value = getattr(self, name)
            if value is None and name in _OPTIONAL:
                continue
            if not is_number(value) or value != int(value) or value < least:
                kind = "positive whole number" if least else "whole number"
                raise InputError(f"{name} must be a {kind}, got {value!r}")
            object.__setattr__(self, name, int(value))
        for name in ("validation_fraction", "jitter_sigma", "jitter_clip"):
            value = getattr(self, name)
            if not is_number(value):
                raise InputError(f"{name} must be a number, got {value!r}")
            object.__setattr__(self, name, float(value))
        if not 0 <= self.validation_fraction < 1:
            raise InputError(
                f"validation_fraction must be in [0, 1), got {self.validation_fraction!r}"
            )
        if self.rotation not in ("so3", "none"):
            raise InputError(f"rotation must be 'so3' or 'none', got {self.rotation!r}")
        if self.subset not in ("stored", "distinct"):
            raise InputError(f"subset must be 'stored' or 'distinct', got {self.subset!r}")
        if self.recipe not in ("published", "short"):
            raise InputError(f"recipe must be 'published' or 'short', got {self.recipe!r}")
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
        fields = dict(item for item in self.as_dict().items() if item not in _ADDED.items())
        del fields["preset"]
        return hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()

    def num_epochs(self, recipe: Recipe, train_clouds: int) -> int:
        """How often the training set of ``train_clouds`` clouds is seen under this protocol."""
        if self.epochs is not None:
            return self.epochs
        return max(1, min(recipe.epochs, math.ceil(self.clouds_seen / train_clouds)))

    def require_epochs(self, recipe: Recipe, train_clouds: int) -> None:
        """Raises InputError where a recipe with a number of epochs of one's own would get another.

        A row or a trial named after a number that it was not trained with would be a false one.
        """
        epochs = self.num_epochs(recipe, train_clouds)
        if epochs == recipe.epochs:
            return
        if self.epochs is not None:
            raise InputError(
                f"epochs={recipe.epochs} in the recipe would have no effect: the protocol has "
                f"epochs={self.epochs}; give one of the two"
            )
        raise InputError(
            f"epochs={recipe.epochs} in the recipe would be cut to {epochs}: that many epochs of "
            f"{train_clouds:,} clouds are the protocol's clouds_seen={self.clouds_seen}; ask for "
            f"no more, or raise clouds_seen to {recipe.epochs * train_clouds} or more"
        )

    def describe_epochs(self, recipe: Recipe, train_clouds: int) -> str:
        """The number of epochs in words, and what the budget would have asked for if it is another.

        For "mini" with clouds_seen=480000 on 26,574 clouds: "8 epochs of 26,574 clouds, where the
        recipe ends; clouds_seen=480,000 would be 19. epochs=19 makes it so".
        """
        epochs = self.num_epochs(recipe, train_clouds)
        text = f"{epochs:,} epoch{'s' if epochs > 1 else ''} of {train_clouds:,} clouds"
        asked = math.ceil(self.clouds_seen / train_clouds)
        if self.epochs is not None or asked == epochs:
            return text
        return (
            f"{text}, where the recipe ends; clouds_seen={self.clouds_seen:,} would be {asked:,}. "
            f"epochs={asked} makes it so"
        )


PRESETS: dict[str, Protocol] = {
    # Shows that everything runs: seconds for most models, a minute or two on two cores for those on
    # 64³ grids, which take one to two seconds a training cloud.
    "smoke": Protocol(
        "smoke", num_points=256, clouds_seen=64, max_train_clouds=32, max_test_clouds=16
    ),
    # For a few thousand clouds, as the built-in data sets have: every model, slow or not, sees them
    # eight times. Under "mini" a slow model would see them once or twice and learn nothing.
    "small": Protocol("small", num_points=256, epochs=8, max_test_clouds=2_500, recipe="short"),
    # Real use on two cores: a quarter of an hour to an hour of one core a model. Slow models see
    # the data fewer times (``ModelCard.short``).
    "mini": Protocol(
        "mini", num_points=256, clouds_seen=240_000, max_test_clouds=2_500, recipe="short"
    ),
    # The same number of clouds for every model, and clouds in training as they are in testing: no
    # point twice where there are enough, no noise. The slowest models ask for a GPU.
    "equal": Protocol(
        "equal",
        num_points=256,
        epochs=8,
        max_test_clouds=2_500,
        jitter_sigma=0.0,
        recipe="short",
        subset="distinct",
    ),
    # The paper's scale. 2.5 million clouds are the 250 epochs over ModelNet40's 9,840 training
    # objects behind PointNet's, PointNet++'s and DGCNN's published figures; PAPNet's 20 epochs of
    # PM40 are 2.0 million and stay 20 epochs.
    "paper": Protocol("paper"),
}


def protocol(preset: str, /, **overrides: Any) -> Protocol:
    """A preset, with fields overridden. Overriding makes another protocol with its own digest, but
    where it makes a preset, that one.

    Raises:
        InputError: unknown preset or field (with close matches), or a value out of range.
    """
    if preset not in PRESETS:
        raise InputError(f"no preset named {preset!r}{close_matches(preset, PRESETS)}")
    chosen = PRESETS[preset]
    known = [f.name for f in dataclasses.fields(Protocol) if f.name not in ("preset", "version")]
    for name in overrides:
        if name not in known:
            raise InputError(f"the protocol has no field {name!r}{close_matches(name, known)}")
    changed = dataclasses.replace(chosen, preset=f"{preset}+", **overrides)
    for same in (chosen, *PRESETS.values()):
        if same.digest == changed.digest:
            return same
    return changed


def from_dict(fields: dict[str, Any]) -> Protocol:
    """The protocol that ``as_dict`` wrote."""
    known = {f.name for f in dataclasses.fields(Protocol)}
    fields = _ADDED | fields
    if set(fields) != known:
        raise InputError(
            f"not a protocol of version {PROTOCOL_VERSION}: "
            f"missing {sorted(known - set(fields))}, unknown {sorted(set(fields) - known)}"
        )
    return Protocol(**fields)
