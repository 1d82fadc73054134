"""Rotations as (…,3,3) matrices acting on column vectors: sampling, angles, noise, validity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation


def haar_rotations(rng: np.random.Generator, size: int) -> NDArray[np.float64]:
    """Rotations uniform on SO(3) (the Haar measure), (size,3,3) float64.

    A unit quaternion from four independent normals is uniform on S³, hence its rotation on SO(3).
    Drawing Euler angles uniformly, as several published scripts do, is not: it crowds the poles.
    """
    return Rotation.from_quat(rng.standard_normal((size, 4))).as_matrix()


def geodesic_angle(a: NDArray, b: NDArray) -> NDArray[np.float64]:
    """The angle of a·bᵀ in radians, in [0, π], for broadcastable (…,3,3) rotations.

    Computed as atan2(sin, cos) of the relative rotation, which keeps full precision near 0 and π
    where acos of the trace loses half of the digits (or returns NaN just outside [−1, 1]).
    """
    relative = np.asarray(a, np.float64) @ np.swapaxes(np.asarray(b, np.float64), -1, -2)
    cosine_twice = np.trace(relative, axis1=-2, axis2=-1) - 1
    skew = relative - np.swapaxes(relative, -1, -2)
    sine_twice = np.linalg.norm(skew, axis=(-2, -1)) / np.sqrt(2)
    return np.arctan2(sine_twice, cosine_twice)


def axis_rotation(axis: str, angle: NDArray | float) -> NDArray[np.float64]:
    """Right-handed rotation by ``angle`` radians about "x", "y" or "z"; (…,3,3)."""
    angle = np.asarray(angle, np.float64)
    return Rotation.from_euler(axis, angle.reshape(-1, 1)).as_matrix().reshape(*angle.shape, 3, 3)


def euler_noise(
    rng: np.random.Generator, size: int, delta: float = np.pi / 4
) -> NDArray[np.float64]:
    """The pose noise of the paper: Rz(c)·Ry(b)·Rx(a), each angle ~ U(−delta, delta) radians.

    It is multiplied from the left onto R (it disturbs the camera side). Returns (size,3,3) float64.
    Source: paper, footnote on U(−δ, δ); factor order from TerenceHsu666/PAPNet@878adcc.
    """
    angles = rng.uniform(-delta, delta, (size, 3))
    return Rotation.from_euler("xyz", angles).as_matrix()


def is_rotation(matrix: NDArray, tolerance: float = 1e-6) -> NDArray[np.bool_]:
    """Whether each (…,3,3) matrix is in SO(3): finite, M·Mᵀ = I within tolerance, det > 0."""
    matrix = np.asarray(matrix, np.float64)
    finite = np.isfinite(matrix).all(axis=(-2, -1))
    safe = np.where(finite[..., None, None], matrix, 0.0)
    error = np.abs(safe @ np.swapaxes(safe, -1, -2) - np.eye(3)).max(axis=(-2, -1))
    return finite & (error <= tolerance) & (np.linalg.det(safe) > 0)
