"""Whether the depth images of a shard are those that its points were seen in.

The row digest does not cover them, and nothing else would tell the image of one row from that of
the next: each point must lie in its image, at the pixel it projects to, with that pixel's depth.
"""

from __future__ import annotations

from collections.abc import Iterator

import h5py
import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.shards import Columns

TOLERANCE = 1e-5
"""Of a point's depth: both are stored in float32, of which this is a hundred roundings."""


def image_problems(images: h5py.Dataset, columns: Columns) -> list[str]:
    """What is wrong with a shard's depth images.

    Args:
        images: (M,H,W) float32 z-depth, 0 = no surface.
        columns: the other fields of the same M rows.

    Returns:
        a sentence for each kind of fault: how many rows have it, and the first.
    """
    found: dict[str, list[int]] = {}
    # One at a time: together they may fill a memory.
    for row in range(len(images)):
        for fault in _faults(images[row], columns, row):
            found.setdefault(fault, []).append(row)
    return [
        f"{fault} in {len(rows)} row(s), the first is row {rows[0]}"
        for fault, rows in found.items()
    ]


def _faults(image: NDArray[np.float32], columns: Columns, row: int) -> Iterator[str]:
    if not (np.isfinite(image) & (image >= 0)).all():
        yield "depth is not finite and ≥ 0"
        return
    if np.count_nonzero(image) != columns["n_visible"][row]:
        yield "depth shows another number of pixels than n_visible"
    points, K = columns["points"][row].astype(np.float64), columns["K"][row]
    if not (
        np.isfinite(points).all() and (points[:, 2] > 0).all() and (K[[0, 1], [0, 1]] > 0).all()
    ):
        yield "depth is stored of points that no image can be of (K or z not positive)"
        return
    pixels = points[:, :2] / points[:, 2:] * K[[0, 1], [0, 1]] + K[[0, 1], 2]
    column, line = np.floor(pixels).astype(np.int64).T
    height, width = image.shape
    inside = (column >= 0) & (column < width) & (line >= 0) & (line < height)
    shown = np.zeros(len(points))
    shown[inside] = image[line[inside], column[inside]]
    if (np.abs(shown - points[:, 2]) > TOLERANCE * points[:, 2]).any():
        yield "points are not those of the depth image: it has another depth where they project to"
