"""Other objects of a source, to stand between a camera and the one it looks at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from partialbench.dataset.sources import ObjectRef, Source
from partialbench.errors import InputError

POOL = 3
"""Other objects that the views of one object choose from: reading a mesh costs more than a view."""
MOST_OCCLUDED = 0.9
_TRIES = 20


@dataclass
class Others:
    """What an occluder is given besides the object.

    Attributes:
        shapes: as the source loads them.
        rngs: one per view, for where they stand.
    """

    shapes: list[Any]
    rngs: list[np.random.Generator]


def require_share(share: float) -> None:
    """Raises ``InputError`` for a share of an object that occluders cannot be asked to hide."""
    number = isinstance(share, int | float | np.number) and not isinstance(share, bool)
    if not number or not 0 <= share <= MOST_OCCLUDED:
        raise InputError(f"occluders must hide a share of 0 to {MOST_OCCLUDED}, got {share!r}")


def draw_others(source: Source, ref: ObjectRef, rng: np.random.Generator) -> list[Any]:
    """``POOL`` other objects, or as many as can be read: of its split, or what its source puts
    beside it.

    Raises:
        InputError: none of those drawn can be read, or there is no other object.
    """
    beside = getattr(source, "beside", None)
    near = beside(ref) if beside else source.objects(ref.split)
    listed = [other for other in near if other.object_id != ref.object_id]
    if not listed:
        raise InputError(
            f"{ref.object_id} is the only object of the split {ref.split!r}: nothing can stand "
            f"before it; render without --occluders"
        )
    shapes = []
    for _ in range(_TRIES):
        try:
            shapes.append(source.load(listed[int(rng.integers(len(listed)))]))
        except (InputError, OSError, ValueError):  # its own row tells of it
            continue
        if len(shapes) == POOL:
            break
    if not shapes:
        raise InputError(f"none of {_TRIES} other objects that were to stand before it can be read")
    return shapes
