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
    """Of a regular (3,3) matrix, by its cofactors."""
    x, y, z = np.asarray(matrix, np.float64)
    cofactors = np.stack([np.cross(y, z), np.cross(z, x), np.cross(x, y)], axis=1)
    return cofactors / (x[0] * cofactors[0, 0] + x[1] * cofactors[1, 0] + x[2] * cofactors[2, 0])


def polar_rotation(matrix: NDArray) -> NDArray[np.float64]:
    """The rotation Q of the polar decomposition Q·P of a (3,3) matrix of positive determinant.

    Newton's iteration, Q ← (Q + Q⁻ᵀ) / 2. Source: Higham, "Computing the polar decomposition, with
    applications", SIAM J. Sci. Stat. Comput. 7 (1986).
    """
    Q = np.asarray(matrix, np.float64)
    for _ in range(50):
        before, Q = Q, (Q + inverse(Q).T) / 2
        if np.abs(Q - before).max() < _CONVERGED:
            break
    return Q
