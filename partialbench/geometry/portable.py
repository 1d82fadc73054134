"""Algebra of three-vectors and 3×3 matrices with the same last bit on every processor.

A BLAS picks its kernels by processor, and each sums in an order of its own. Poses are stored in
full precision and enter a shard's digest, so they are made with these: elementwise products, added
in the order of their index.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_CONVERGED = 1e-15


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
