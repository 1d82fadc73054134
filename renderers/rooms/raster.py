"""Depth of triangles at pixel centres, the same bits on every processor.

A ray caster such as Embree starts from the processor's own approximate reciprocals, and at an edge
two processors may name two triangles. Here every pixel is decided by float64 products, sums and one
quotient, each rounded as IEEE 754 says: a pixel's ray d meets the triangle abc where d·(a×b),
d·(b×c) and d·(c×a) have one sign. An edge's two triangles compute the same number with opposite
signs, so that no ray slips between them; of all triangles that a ray meets the nearest counts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_LARGE_PX = 400
"""A triangle with so many pixels in its bounds is worth a turn of a Python loop of its own."""
_NEAREST = 1e-4
"""No surface nearer than this is looked for, in the corners' unit."""
_MARGIN_PX = 1e-3
"""A triangle's pixels are bounded this much wider, for the rounding of its corners' projection."""


def depth_image(
    corners: NDArray[np.float64], focal_px: float, width: int, height: int
) -> NDArray[np.float64]:
    """z-depth at the centre of every pixel of a pinhole whose axis meets the image's middle.

    Args:
        corners: (f,3,3) triangles in the camera frame; both of their sides are seen, and what lies
            behind the camera is not.

    Returns:
        (height,width) float64, 0 where a ray meets nothing.
    """
    nearest = np.full((height, width), np.inf)
    x = (np.arange(width) + 0.5 - width / 2) / focal_px
    y = (np.arange(height) + 0.5 - height / 2) / focal_px
    a, b, c = corners.transpose(1, 0, 2)
    # Planes through the eye and each side. A side that two triangles share gives opposite numbers,
    # bit by bit: they are differences of the same two products.
    sides = np.stack([_cross(a, b), _cross(b, c), _cross(c, a)], axis=1)
    volumes = _dot(a, sides[:, 1])
    low, high = _pixel_bounds(corners, focal_px, (width, height))
    pixels = np.maximum(high - low, 0).prod(axis=1)

    for triangle in np.flatnonzero(pixels > _LARGE_PX):
        (left, top), (right, bottom) = low[triangle], high[triangle]
        z = _depth(sides[triangle], volumes[triangle], x[left:right], y[top:bottom, None])
        part = nearest[top:bottom, left:right]
        np.minimum(part, z, out=part)

    small = np.flatnonzero((pixels > 0) & (pixels <= _LARGE_PX))
    of = np.repeat(small, pixels[small])
    within = np.arange(len(of)) - np.repeat(np.cumsum(pixels[small]) - pixels[small], pixels[small])
    across = high[of, 0] - low[of, 0]
    column, row = low[of, 0] + within % across, low[of, 1] + within // across
    by_part = np.ascontiguousarray(sides.transpose(1, 2, 0))
    z = _depth(by_part[..., of], volumes[of], x[column], y[row])
    np.minimum.at(nearest, (row, column), z)
    return np.where(np.isfinite(nearest), nearest, 0)


def _depth(sides: NDArray, volume: NDArray, x: NDArray, y: NDArray) -> NDArray[np.float64]:
    """Depth along the rays (x, y, 1), infinite where they miss: sides (3,3,…) by side and axis."""
    e0, e1, e2 = (s[0] * x + s[1] * y + s[2] for s in sides)
    met = ((e0 >= 0) & (e1 >= 0) & (e2 >= 0)) | ((e0 <= 0) & (e1 <= 0) & (e2 <= 0))
    total = e0 + e1 + e2
    # A triangle seen along its plane shows nothing; behind the camera the quotient is negative.
    met &= total != 0
    z = np.divide(volume, total, out=np.full(met.shape, np.inf), where=met)
    return np.where(z > 0, z, np.inf)


def _pixel_bounds(
    corners: NDArray, focal_px: float, size: tuple[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(f,2) first column and row whose centres may see a triangle, and those past the last."""
    limits = np.array(size)
    low, high = np.tile(limits, (len(corners), 1)), np.zeros((len(corners), 2), np.int64)
    for part in (corners, _where_sides_meet_the_camera(corners)):
        z = part[..., 2, None]
        ahead = z >= _NEAREST
        at = focal_px * part[..., :2] / np.where(ahead, z, 1) + limits / 2
        first = np.where(ahead, at, np.inf).min(axis=1) - 0.5 - _MARGIN_PX
        last = np.where(ahead, at, -np.inf).max(axis=1) - 0.5 + _MARGIN_PX
        low = np.minimum(low, np.clip(np.ceil(first), 0, limits).astype(np.int64))
        high = np.maximum(high, np.clip(np.floor(last) + 1, 0, limits).astype(np.int64))
    return low, high


def _where_sides_meet_the_camera(corners: NDArray) -> NDArray[np.float64]:
    """(f,3,3) where each side crosses the plane z = ``_NEAREST``; behind it where it does not."""
    ahead, behind = corners, np.roll(corners, -1, axis=1)
    step = behind - ahead
    crosses = (ahead[..., 2] >= _NEAREST) != (behind[..., 2] >= _NEAREST)
    share = (_NEAREST - ahead[..., 2]) / np.where(crosses, step[..., 2], 1)
    met = ahead + share[..., None] * step
    met[..., 2] = np.where(crosses, _NEAREST, -1)
    return met


def _cross(a: NDArray, b: NDArray) -> NDArray[np.float64]:
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)


def _dot(a: NDArray, b: NDArray) -> NDArray[np.float64]:
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]
