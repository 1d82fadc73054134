"""Other objects of a source, to stand between a camera and the one it looks at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from partialbench.dataset.sources import ObjectRef, Source
from partialbench.errors import InputError

POOL = 3
"""Other objects that the views of one object choose from: reading a mesh costs more than a view."""
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


def draw_others(source: Source, ref: ObjectRef, rng: np.random.Generator) -> list[Any]:
    """``POOL`` objects of the same split, or as many as can be read.

    Raises:
        InputError: none of those drawn can be read, or there is no other object.
    """
    listed = [other for other in source.objects(ref.split) if other.object_id != ref.object_id]
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
