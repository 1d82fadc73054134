"""Shapes that were never modelled: clouds stretched along the axes of their objects.

A pose label says where the object's axes are, so a cloud can be made longer, wider or flatter as
the object would be. An affine map takes lines of sight to lines of sight: what was seen stays what
is seen, of the stretched object, from the camera's image under the map. Rotations drawn on all of
SO(3) leave no preferred camera, so the cloud is as good as a rendered one; and the object's axes
stay where they were, so the pose label holds. An object that a turn about z of less than a half
takes to itself would lose that symmetry, and its label with it, if x and y were stretched apart:
they share their factor there.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from partialbench.geometry.symmetry import GROUPS


def stretched(
    points: NDArray[np.float32],
    rotations: NDArray[np.float64],
    symmetries: NDArray[np.str_],
    most: float,
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """The clouds, each stretched along its object's three axes.

    Args:
        points: (B,N,3) camera frame. The map is about the camera, not about the object; clouds are
            centred by the models.
        rotations: (B,3,3) object → camera.
        symmetries: (B,) group names.
        most: each axis is drawn log-uniformly between 1/most and most.

    Returns:
        (B,N,3) float32.
    """
    factors = np.exp(rng.uniform(-1, 1, (len(points), 3)) * math.log(most))
    shared = np.isin(symmetries, [name for name in GROUPS if not _allows(name)])
    factors[shared, 1] = factors[shared, 0]
    # p = R·q with q in the object's frame.
    maps = (rotations * factors[:, None]) @ rotations.swapaxes(1, 2)
    return points @ maps.astype(np.float32)


def _allows(name: str) -> bool:
    """Whether every stretching along the axes keeps the symmetry: its elements are diagonal."""
    group = GROUPS[name]
    off_diagonal = group.elements[:, ~np.eye(3, dtype=bool)]
    return not group.continuous and bool((np.abs(off_diagonal) < 1e-9).all())
