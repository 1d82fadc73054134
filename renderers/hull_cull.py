"""Dropping points that cannot be hull vertices, before the hull is built."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import ConvexHull, QhullError

_POINTS_PER_CELL = 40
_MIN_CELLS = 8
_DEPTH_MARGIN = 1e-9
_CORNER_MARGIN = 1e-10


def possible_vertices(flipped: NDArray) -> NDArray[np.intp]:
    """Indices of (N,3) points left when those strictly inside hull(flipped ∪ {0}) are dropped.

    Every hull vertex is among them. With h = 1/z over the image plane of a cube's face, a plane in
    space is a plane in (u, v, h), and farther out is lower. The farthest points of the grid cells,
    triangulated, give heights that lie inside the hull; the hull's own lower boundary H is convex
    and not above them. So these heights bound H at a grid triangle's corners, and their linear
    interpolation bounds H between: what lies higher than that, nearer to the viewpoint, is inside.
    The margin of 1e-9 of the depth is far more than rounding in h (1e-15) or in qhull (about 1e-14
    of the largest coordinate).
    """
    keep = np.ones(len(flipped), np.bool_)
    axis = np.abs(flipped).argmax(axis=1)
    face = 2 * axis + (flipped[np.arange(len(flipped)), axis] < 0)
    for f in range(6):
        members = np.flatnonzero(face == f)
        cells = int(np.sqrt(len(members) / _POINTS_PER_CELL))
        if cells < _MIN_CELLS:
            continue
        z, u, v = np.roll(flipped[members], -(f // 2), axis=1).T
        z = np.abs(z)
        x, y = _grid_coordinate(u / z, cells), _grid_coordinate(v / z, cells)
        keep[members] = ~_above(flipped[members], x, y, 1 / z, cells)
    return np.flatnonzero(keep)


def _grid_coordinate(u: NDArray, cells: int) -> NDArray[np.float64]:
    """u mapped linearly to [0, cells)."""
    low, high = u.min(), u.max()
    return (u - low) * (cells * (1 - 1e-12) / (high - low)) if high > low else np.zeros_like(u)


def _above(points: NDArray, x: NDArray, y: NDArray, h: NDArray, cells: int) -> NDArray[np.bool_]:
    """Whether each point's height surely lies above the lower convex hull of all (x, y, h)."""
    column, row = x.astype(np.intp), y.astype(np.intp)
    cell = column * cells + row
    lowest = np.full(cells * cells, np.inf)
    np.minimum.at(lowest, cell, h)
    chosen = np.flatnonzero(h == lowest[cell])
    grid = np.stack(np.meshgrid(*2 * [np.arange(cells + 1.0)], indexing="ij"), axis=-1)
    try:
        # Without the cells whose farthest point is itself inside, the bound is much tighter.
        outer = ConvexHull(np.concatenate([points[chosen], np.zeros((1, 3))])).vertices
        chosen = chosen[outer[outer < len(chosen)]]
        sites = np.stack([x[chosen], y[chosen]], axis=1)
        interpolate = LinearNDInterpolator(sites, np.column_stack([h[chosen], sites]))
    except QhullError:  # the directions lie on a line
        return np.zeros(len(x), np.bool_)
    # NaN outside the triangulation: nothing is known there. In slivers the weights lose digits;
    # the corner that they give back tells how many.
    found = interpolate(grid)
    exact = np.abs(found[..., 1:] - grid).max(axis=-1) < _CORNER_MARGIN
    inside = np.where(exact, found[..., 0], np.nan)
    # Each cell is cut along its diagonal from (0,0) to (1,1).
    fx, fy = x - column, y - row
    far, near = np.maximum(fx, fy), np.minimum(fx, fy)
    side = np.where(fx >= fy, inside[column + 1, row], inside[column, row + 1])
    start, end = inside[column, row], inside[column + 1, row + 1]
    bound = (1 - far) * start + (far - near) * side + near * end
    return h > bound * (1 + _DEPTH_MARGIN)  # False where the bound is NaN
