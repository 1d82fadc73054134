"""Surface samples by area, and the segments that tell which of them a viewpoint sees."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

EPSILON = 1e-4
"""How far in front of a sample its segment ends, in object units (the radius is 1).

It keeps a sample from being hidden by the face it lies on. What lies closer behind a surface than
this counts as seen: a back-to-back double face is one sheet.
"""

# Powers of 1/ρ, ρ the real root of x³ = x + 1: the additive recurrence whose points fill the plane
# most evenly (M. Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018).
_PLASTIC = 1.324717957244746
_STEPS = np.array([1 / _PLASTIC, 1 / _PLASTIC**2])


def surface_samples(
    vertices: NDArray[np.float32], faces: NDArray[np.uint32], size: int
) -> NDArray[np.float32]:
    """Points spread evenly over a surface by area: (size,3) float32 in the mesh's frame.

    The i-th of ``size`` equal steps along the running area picks the face, a low-discrepancy
    sequence the place on it, so the points depend on the mesh alone and a share estimated from them
    errs less than one from as many random points. Every face counts, also those back to back.

    Raises:
        ValueError: when the surface has no area.
    """
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    u, v = b - a, c - a
    # The cross product written out: numpy's spends most of its time on generality.
    double_area = np.sqrt(
        (u[:, 1] * v[:, 2] - u[:, 2] * v[:, 1]) ** 2
        + (u[:, 2] * v[:, 0] - u[:, 0] * v[:, 2]) ** 2
        + (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) ** 2
    )
    running = np.cumsum(double_area)
    if not running[-1] > 0:
        raise ValueError(f"the surface has no area: {len(faces)} faces, all of area 0")
    steps = (np.arange(size) + 0.5) / size * running[-1]
    chosen = np.searchsorted(running, steps, side="right")
    p, q = ((np.arange(1, size + 1)[:, None] * _STEPS + 0.5) % 1).T
    # Fold the unit square onto the triangle below its diagonal: uniform stays uniform.
    folded = p + q > 1
    p, q = np.where(folded, 1 - p, p)[:, None], np.where(folded, 1 - q, q)[:, None]
    return (a[chosen] + p * u[chosen] + q * v[chosen]).astype(np.float32)


def sight_lines(
    samples: NDArray[np.float32], eye: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Segments from an eye to just before each sample.

    Args:
        samples: (S,3).
        eye: (3,), in the same frame.

    Returns:
        directions (S,3) from the eye to the samples, not normalised, and ends (S,): a sample is
        seen when nothing lies at eye + s·direction for 0 < s < end.
    """
    directions = samples - eye.astype(np.float32)
    length = np.sqrt(np.einsum("ij,ij->i", directions, directions))
    return directions, 1 - np.float32(EPSILON) / np.maximum(length, np.float32(EPSILON))


def inside_image(camera_points: NDArray, K: NDArray, width: int, height: int) -> NDArray[np.bool_]:
    """Which (n,3) camera-frame points project into the image: (n,) bool."""
    x, y, z = camera_points.T
    z = np.where(z > 0, z, np.nan)
    u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
    return (u >= 0) & (u < width) & (v >= 0) & (v < height)
