"""Strips and fans of triangles, which PLY, glTF and COLLADA write, of three corners and more."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def of_strip(indices: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles (n−2,3) of a strip (n,): each further vertex with the two before it, in turn."""
    triangles = np.stack([indices[:-2], indices[1:-1], indices[2:]], axis=1)
    triangles[1::2] = triangles[1::2, ::-1]
    return triangles


def of_fan(indices: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles (n−2,3) of a fan (n,): each edge behind the first vertex with it."""
    first = np.broadcast_to(indices[:1], (max(len(indices) - 2, 0),))
    return np.stack([first, indices[1:-1], indices[2:]], axis=1)
