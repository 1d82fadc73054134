"""Whether a camera in a scanned room has a free line of sight to an object.

The scan's surface is kept as the set of small cubes (voxels) that it passes through. A line is free
when none of the cubes on its way, up to just before the object's point, holds surface of anything
but the object. Elementwise float64 alone decides, so the answer is the same on every processor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

VOXEL_M = 0.05
SPACING_M = 0.025
"""Samples of a face, and steps along a line, lie no farther apart than this: half a voxel."""
BEFORE_M = 0.075
"""A line ends so far before its point: what the object stands on or leans against hides nothing."""
LINES = 64
"""Points of an object to which lines are drawn."""
_MAX_STEPS = 400
"""A face is sampled at this many steps a side at most: 10 m of it densely."""


@dataclass(frozen=True)
class Surface:
    """A scan's surface by voxel.

    Attributes:
        low: (3,) int64 least voxel.
        size: (3,) int64 voxels along each axis.
        keys: (k,) int64 voxels with surface, ascending, as positions in the box of ``size``.
        counts: (k,) samples in each.
        sample_key, sample_face: (s,) voxel and face of every sample, by face.
    """

    low: NDArray[np.int64]
    size: NDArray[np.int64]
    keys: NDArray[np.int64]
    counts: NDArray[np.int64]
    sample_key: NDArray[np.int64]
    sample_face: NDArray[np.int64]

    def without(self, vertices: NDArray[np.int64], faces: NDArray[np.int64]) -> Blockers:
        """What may stand before an object: the surface less the faces at its vertices.

        Args:
            vertices: the object's, indices.
            faces: (f,3) of the scan.
        """
        own_vertex = np.zeros(int(faces.max()) + 1, np.bool_)
        own_vertex[vertices[vertices < len(own_vertex)]] = True
        own = np.any(own_vertex[faces], axis=1)
        of_object = np.searchsorted(self.keys, self.sample_key[own[self.sample_face]])
        left = self.counts - np.bincount(of_object, minlength=len(self.keys))
        return Blockers(self.low, self.size, self.keys[left > 0])


@dataclass(frozen=True)
class Blockers:
    """The voxels that hold surface of something else than the object; as in `Surface`."""

    low: NDArray[np.int64]
    size: NDArray[np.int64]
    keys: NDArray[np.int64]

    def free_share(self, eye: NDArray, targets: NDArray) -> float:
        """The share of lines from the eye (3,) to targets (n,3), scan frame, that are free."""
        way = targets - eye
        length = np.sqrt(way[:, 0] ** 2 + way[:, 1] ** 2 + way[:, 2] ** 2)
        steps = max(1, math.ceil(float(length.max()) / SPACING_M))
        along = np.arange(steps) * SPACING_M
        on_line = along < (length - BEFORE_M)[:, None]
        share = along / np.maximum(length, 1e-9)[:, None]
        cells = np.floor((eye + share[..., None] * way[:, None]) / VOXEL_M).astype(np.int64)
        cells -= self.low
        on_line &= ((cells >= 0) & (cells < self.size)).all(axis=2)
        key = _key(cells, self.size)
        if len(self.keys) == 0:
            return 1.0
        at = np.minimum(np.searchsorted(self.keys, key), len(self.keys) - 1)
        return float(1 - (on_line & (self.keys[at] == key)).any(axis=1).mean())


def surface_of(vertices: NDArray, faces: NDArray[np.int64]) -> Surface:
    """The voxels of a mesh: vertices (n,3) metres, faces (f,3), f ≥ 1."""
    corners = np.asarray(vertices, np.float64)[faces]
    sides = corners - np.roll(corners, 1, axis=1)
    longest = np.sqrt((sides * sides).sum(axis=2).max(axis=1))
    steps = np.clip(np.ceil(longest / SPACING_M), 1, _MAX_STEPS).astype(np.int64)
    cells, owners = [], []
    for n in np.unique(steps).tolist():
        chosen = np.flatnonzero(steps == n)
        i, j = np.triu_indices(n + 1)
        weights = np.stack([i, j - i, n - j]) / n  # every point of a triangular lattice
        a, b, c = corners[chosen].transpose(1, 0, 2)
        points = (
            a[:, None] * weights[0][:, None]
            + b[:, None] * weights[1][:, None]
            + c[:, None] * weights[2][:, None]
        )
        cells.append(np.floor(points.reshape(-1, 3) / VOXEL_M).astype(np.int64))
        owners.append(np.repeat(chosen, len(i)))
    cell, owner = np.concatenate(cells), np.concatenate(owners)
    low = cell.min(axis=0)
    size = cell.max(axis=0) - low + 1
    key = _key(cell - low, size)
    keys, counts = np.unique(key, return_counts=True)
    return Surface(low, size, keys, counts, key, owner)


def _key(cells: NDArray, size: NDArray) -> NDArray[np.int64]:
    return (cells[..., 0] * size[1] + cells[..., 1]) * size[2] + cells[..., 2]


def spread(points: NDArray, count: int = LINES) -> NDArray:
    """``count`` of the (n,3) points, evenly by their order; all where there are fewer."""
    return points[np.linspace(0, len(points) - 1, min(count, len(points))).astype(np.int64)]
