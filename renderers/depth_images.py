"""What sensor models ask of a depth image: angles of incidence, edges, shadows, displaced rays.

Images are (H,W) z-depth in metres, 0 = no surface; K is (3,3) in pixels.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

EDGE_SHARE = 0.05
"""A depth step is an edge only if it is also larger than this share of the depth: at grazing angles
neighbouring pixels of one surface differ."""


def incidence_angle(z: NDArray, K: NDArray) -> NDArray[np.float64]:
    """Angle between surface normal and viewing ray, (H,W) radians in [0, π/2]; 0 off the surface.

    With q = 1/z, a plane n·P = d is q = n·(x, y, 1)/d over the image plane: linear, so that
    differences of q are exact on planes. Of the two one-sided differences the smaller is taken,
    which does not look across an edge.
    """
    there = z > 0
    q = np.where(there, 1 / np.where(there, z, 1), np.nan)
    a = K[0, 0] * _slope(q, 1)
    b = K[1, 1] * _slope(q, 0)
    rows, columns = np.indices(z.shape)
    x, y = (columns + 0.5 - K[0, 2]) / K[0, 0], (rows + 0.5 - K[1, 2]) / K[1, 1]
    normal = np.sqrt(a**2 + b**2 + (q - a * x - b * y) ** 2)
    cosine = q / (normal * np.sqrt(x**2 + y**2 + 1))
    return np.where(there, np.arccos(np.clip(cosine, 0, 1)), 0)


def _slope(q: NDArray, axis: int) -> NDArray[np.float64]:
    """Per pixel, the one-sided difference of smaller size; 0 where there is none (NaN is empty)."""
    step = np.diff(q, axis=axis)
    edge = np.full_like(q.take([0], axis=axis), np.nan)
    ahead = np.concatenate([step, edge], axis=axis)
    behind = np.concatenate([edge, step], axis=axis)
    nearer = np.where(np.isnan(behind) | (np.abs(ahead) <= np.abs(behind)), ahead, behind)
    return np.nan_to_num(nearer, nan=0.0)


def edges(z: NDArray, edge_m: float) -> NDArray[np.bool_]:
    """Surface pixels beside empty space or a depth step above max(edge_m, 5 % of z).

    The image's border is no edge. The neighbours are the four that share a side.
    """
    limit = np.maximum(edge_m, EDGE_SHARE * z)
    found = np.zeros(z.shape, np.bool_)
    padded = np.pad(z, 1, mode="edge")
    for rows, columns in ((0, 1), (2, 1), (1, 0), (1, 2)):
        neighbour = padded[rows : rows + z.shape[0], columns : columns + z.shape[1]]
        found |= (neighbour == 0) | (np.abs(neighbour - z) > limit)
    return found & (z > 0)


def projector_shadow(z: NDArray, K: NDArray, baseline_m: float) -> NDArray[np.bool_]:
    """Surface pixels that a projector at (baseline_m, 0, 0) in the camera frame does not reach.

    Camera column u at depth z is projector column u − fx·baseline/z. Along a row of a scene seen
    without gaps, what lies to the right must be lit farther right: a pixel is in shadow where some
    pixel to its right has a projector column that is not greater.
    """
    there = z > 0
    u = np.arange(z.shape[1]) + 0.5
    column = np.where(there, u - K[0, 0] * baseline_m / np.where(there, z, 1), np.inf)
    least = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    to_the_right = np.concatenate([least[:, 1:], np.full((len(z), 1), np.inf)], axis=1)
    return there & (column >= to_the_right)


def displaced(z: NDArray, shift_px: NDArray, edge_m: float) -> NDArray[np.float64]:
    """What each pixel sees when its ray is displaced: its own surface, or one across an edge.

    A ray that stays on its surface keeps its depth, however the surface slants: the published axial
    fits were measured on slanted planes and hold what displacement does to depth there. Where it
    crosses an edge it has the depth of what lies there, which frays outlines.

    Args:
        shift_px: (2,H,W), rows then columns; positions outside the image are moved to its border.
        edge_m: depth that far off what the pixel's plane predicts (5 % of it at least) is not on
            its surface.

    Returns:
        (H,W): the pixel's own depth, or that of the pixel its ray falls into, which may be 0.
    """
    limits = np.array(z.shape)[:, None, None] - 1
    here = np.indices(z.shape)
    there = np.rint(np.clip(here + shift_px, 0, limits)).astype(np.intp)
    read = z[there[0], there[1]]
    # 1/z is linear over the image of a plane.
    q = np.where(z > 0, 1 / np.where(z > 0, z, 1), np.nan)
    rows, columns = there - here
    expected = q + _slope(q, 0) * rows + _slope(q, 1) * columns
    ahead = expected > 0  # False where the pixel is empty
    off = np.abs(1 / np.where(ahead, expected, 1) - read)
    same = ahead & (read > 0) & (off <= np.maximum(edge_m, EDGE_SHARE * read))
    return np.where(same, z, read)


def over_neighbours(
    values: NDArray, reduce: Callable[..., NDArray], outside: float
) -> NDArray[np.float64]:
    """A reduction over each pixel's 3×3 neighbourhood, ``outside`` standing beyond the border."""
    padded = np.pad(np.asarray(values, np.float64), 1, constant_values=outside)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    return reduce(windows, axis=(-2, -1))
