"""The poses that are tried: the 60 bins, or the bins and 300 rotations between them.

As unit quaternions the bins and their negatives are the 120 vertices of the 600-cell; the centres
of its 600 tetrahedra, again in pairs, are the 300 rotations that lie farthest from every bin, 44.5°
from the four nearest. With them no rotation is farther than 28° from a pose that is tried, and the
set is still carried onto itself by every bin: no orientation is favoured.
"""

from __future__ import annotations

import itertools
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from partialbench.errors import InputError
from partialbench.geometry.bins import NUM_BINS, rotation_bins

COUNTS = (NUM_BINS, 360)


@cache
def pose_grid(count: int) -> NDArray[np.float64]:
    """(count,3,3) float64, read-only; the 60 bins come first, in their order.

    Args:
        count: 60 or 360.

    Raises:
        InputError: another count.
    """
    if count not in COUNTS:
        raise InputError(f"poses must be one of {COUNTS}, got {count!r}")
    bins = rotation_bins()
    if count == NUM_BINS:
        return bins
    grid = np.concatenate([bins, Rotation.from_quat(_centres(bins)).as_matrix()])
    grid.setflags(write=False)
    return grid


def _centres(bins: NDArray) -> NDArray[np.float64]:
    """(300,4) unit quaternions xyzw of the cells' centres, one of each ± pair."""
    half = Rotation.from_matrix(bins).as_quat()
    vertices = np.concatenate([half, -half])
    # Neighbours on the 600-cell are 36° apart: 1/2 of the golden ratio.
    near = np.isclose(vertices @ vertices.T, np.cos(np.pi / 5))
    neighbours = [set(np.flatnonzero(row)) for row in near]
    centres: list[NDArray] = []
    for i, j in zip(*np.nonzero(np.triu(near)), strict=True):
        for k, m in itertools.combinations(sorted(neighbours[i] & neighbours[j]), 2):
            if j < k and near[k, m]:
                centre = vertices[[i, j, k, m]].sum(0)
                centres.append(centre / np.linalg.norm(centre))
    both = np.array(centres)
    # A centre and its negative are one rotation: the one whose first nonzero entry is positive.
    leading = both[np.arange(len(both)), (np.abs(both) > 1e-9).argmax(1)]
    return both[leading > 0]


@cache
def share_of_bins(count: int) -> NDArray[np.float64]:
    """(count,60): how the probability of each pose counts for the bins, rows summing to 1.

    A pose belongs to its nearest bin, in equal parts where several are equally near.
    """
    grid, bins = pose_grid(count), rotation_bins()
    similarity = np.einsum("pij,bij->pb", grid, bins)
    nearest = similarity > similarity.max(1, keepdims=True) - 1e-9
    share = nearest / nearest.sum(1, keepdims=True)
    share.setflags(write=False)
    return share
