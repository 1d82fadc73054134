"""Algebra of three-vectors and 3×3 matrices with the same last bit on every processor.

A BLAS picks its kernels by processor, and each sums in an order of its own; so do the sines of a C
library and of NumPy. Poses are stored in full precision and enter a shard's digest, so they are
made with these: elementwise products, added in the order of their index.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_CONVERGED = 1e-15
# π/2 in two parts: whole multiples of the first, up to 2²⁰, have no rounding error.
_QUARTER, _QUARTER_REST = float.fromhex("0x1.921fb544p+0"), float.fromhex("0x1.0b4611a626331p-34")
_AXES = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}


def product(a: NDArray, b: NDArray) -> NDArray[np.float64]:
    """(i,j)·(j,k) → (i,k) float64; rows of points (n,3) may be ``a``."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    total = a[:, :1] * b[0]
    for j in range(1, len(b)):
        total = total + a[:, j, None] * b[j]
    return total


def apply(matrix: NDArray, vector: NDArray) -> NDArray[np.float64]:
    """(3,3) applied to a column (3,)."""
    return product(np.asarray(vector)[None], np.asarray(matrix).T)[0]


def inverse(matrix: NDArray) -> NDArray[np.float64]:
    """Of regular (…,3,3) matrices, by their cofactors."""
    x, y, z = np.moveaxis(np.asarray(matrix, np.float64), -2, 0)
    cofactors = np.stack([np.cross(y, z), np.cross(z, x), np.cross(x, y)], axis=-1)
    first = cofactors[..., 0]
    determinant = x[..., 0] * first[..., 0] + x[..., 1] * first[..., 1] + x[..., 2] * first[..., 2]
    return cofactors / determinant[..., None, None]


def polar_rotation(matrix: NDArray) -> NDArray[np.float64]:
    """The rotations Q of the polar decompositions Q·P of (…,3,3) matrices of positive determinant.

    Newton's iteration, Q ← (Q + Q⁻ᵀ) / 2. Source: Higham, "Computing the polar decomposition, with
    applications", SIAM J. Sci. Stat. Comput. 7 (1986).
    """
    Q = np.asarray(matrix, np.float64)
    for _ in range(50):
        before, Q = Q, (Q + np.swapaxes(inverse(Q), -1, -2)) / 2
        if np.abs(Q - before).max(initial=0) < _CONVERGED:
            break
    return Q


def cosine_sine(angle: NDArray | float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """cos and sin of angles (…) in radians, |angle| below 10⁶: within 3·10⁻¹⁶.

    The angle is reduced to [−π/4, π/4] by whole quarter turns, where both are power series.
    """
    angle = np.asarray(angle, np.float64)
    quarters = np.rint(angle / _QUARTER)
    rest = (angle - quarters * _QUARTER) - quarters * _QUARTER_REST
    square = rest * rest
    cosine, sine = np.ones_like(rest), np.ones_like(rest)
    for n in range(16, 0, -2):
        cosine = 1 - square * cosine / (n * (n - 1))
        sine = 1 - square * sine / (n * (n + 1))
    sine = sine * rest
    turn = quarters.astype(np.int64) % 4
    pair = np.where(turn % 2 == 0, cosine, sine), np.where(turn % 2 == 0, sine, cosine)
    return np.where((turn == 1) | (turn == 2), -pair[0], pair[0]), np.where(
        turn >= 2, -pair[1], pair[1]
    )


def axis_rotation(axis: str, angle: float) -> NDArray[np.float64]:
    """(3,3) right-handed rotation by ``angle`` radians about "x", "y" or "z"."""
    cosine, sine = cosine_sine(angle)
    i, j = _AXES[axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = cosine
    matrix[i, j], matrix[j, i] = -sine, sine
    return matrix
