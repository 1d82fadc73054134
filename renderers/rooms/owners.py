"""Which of several surfaces a point lies on, the same answer on every processor.

Embree's distances are right to a few micrometres and differ between processors in their last bits.
They decide where they differ by more than that; the rest is measured in float64 (elementwise, as
``rooms.raster``), triangle by triangle.
"""

from __future__ import annotations

from types import ModuleType

import numpy as np
from numpy.typing import NDArray

UNSURE_M = 2e-4
"""A hundred times what Embree's float32 distances err by in a room."""
_PAIRS = 1 << 18
"""Pairs of a point and a triangle that are measured at once."""


def nearest_surface(
    o3d: ModuleType, points: NDArray, surfaces: list[NDArray[np.float64]], radius_m: float
) -> NDArray[np.int64]:
    """The nearest surface of each point, of equally near ones the first, or −1 beyond the radius.

    Args:
        points: (n,3) metres.
        surfaces: (f,3,3) triangles each, same frame.

    Returns:
        (n,) indices into ``surfaces``.
    """
    points = np.asarray(points, np.float64)
    reach = radius_m + 2 * UNSURE_M
    distance = np.full((len(points), len(surfaces)), np.inf)
    for k, corners in enumerate(surfaces):
        low, high = corners.min(axis=(0, 1)) - reach, corners.max(axis=(0, 1)) + reach
        near = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
        distance[near, k] = _quick_distance(o3d, points[near], corners)
    least = distance.min(axis=1)
    rivals = distance <= least[:, None] + UNSURE_M
    unsure = (np.abs(least - radius_m) < UNSURE_M) | (
        (rivals.sum(axis=1) > 1) & (least < radius_m + UNSURE_M)
    )
    for k, corners in enumerate(surfaces):
        rows = np.flatnonzero(unsure & rivals[:, k])
        distance[rows, k] = triangle_distance(points[rows], corners)
    owner = distance.argmin(axis=1)
    return np.where(distance[np.arange(len(points)), owner] <= radius_m, owner, -1)


def _quick_distance(o3d: ModuleType, points: NDArray, corners: NDArray) -> NDArray[np.float64]:
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(corners.reshape(-1, 3).astype(np.float32)),
        o3d.core.Tensor(np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3)),
    )
    return scene.compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()


def triangle_distance(points: NDArray, corners: NDArray) -> NDArray[np.float64]:
    """Distance (n,) of points (n,3) to the nearest of triangles (f,3,3), every pair measured."""
    turn = max(1, _PAIRS // len(corners))
    parts = [_of_each(points[i : i + turn], corners) for i in range(0, len(points), turn)]
    return np.sqrt(np.concatenate(parts)) if parts else np.zeros(0)


def _of_each(points: NDArray, corners: NDArray) -> NDArray[np.float64]:
    """Squared distances: to the plane over a triangle's inside, elsewhere to its sides."""
    p = points[:, None]
    a, b, c = corners.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    area = _dot(normal, normal)
    inside = area > 0
    squared = np.full((len(points), len(corners)), np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        side, offset = end - start, p - start
        length = _dot(side, side)
        share = np.clip(_dot(offset, side) / np.where(length > 0, length, 1), 0, 1)
        rest = offset - share[..., None] * side
        squared = np.minimum(squared, _dot(rest, rest))
        inside = inside & (_dot(np.cross(normal, side), offset) >= 0)
    height = _dot(p - a, normal)
    over = height * height / np.where(area > 0, area, 1)
    return np.where(inside, np.minimum(squared, over), squared).min(axis=1)


def _dot(a: NDArray, b: NDArray) -> NDArray[np.float64]:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]
