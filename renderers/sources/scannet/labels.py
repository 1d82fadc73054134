"""What the label of every vertex means: nyu40's numbers or ScanNet's own.

Releases of ``<scene>_vh_clean_2.labels.ply`` hold either. 2 is a floor in nyu40 and a chair in
ScanNet's ``id`` column, 34 a sink and a night stand: a file read by the wrong numbering gives other
objects, and a floor at the height of the seats. So the numbering is decided for the file as a
whole, by what the scan and its annotation say about the vertices.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from partialbench.errors import InputError

NUMBERINGS = ("nyu40", "scannet")
NYU40_MAX = 40
FLOOR_IDS = (2, 20)
"""nyu40: floor, floor mat."""

FLOOR_CELL_M, FLOOR_BAND_M, FLOOR_UP = 0.25, 0.1, 0.8
"""What faces up and lies within the band above the lowest vertex of its cell of the floor plan is
floor: also on a second level, or on a ramp."""


def to_nyu40(
    labels: NDArray[np.int64], numbering: str, nyu40_of_id: dict[int, int]
) -> tuple[NDArray[np.int64], dict[str, dict[str, int]]]:
    """The labels (n,) as nyu40 ids, 0 where there is none, and counts of what that changed.

    In a file of nyu40 ids, a number above 40 can only be one of ScanNet's: it is mapped, and noted.
    """
    values, inverse = np.unique(labels, return_inverse=True)
    counts = np.bincount(inverse.reshape(-1), minlength=len(values))
    mapped = np.zeros(len(values), np.int64)
    notes: dict[str, dict[str, int]] = {}
    for i, value in enumerate(values.tolist()):
        if numbering == "nyu40" and 0 <= value <= NYU40_MAX:
            mapped[i] = value
            continue
        mapped[i] = nyu40_of_id.get(value, 0)
        if value and value not in nyu40_of_id:
            notes.setdefault("labels_unknown", {})[str(value)] = int(counts[i])
        elif value and numbering == "nyu40":
            notes.setdefault("labels_mapped", {})[str(value)] = int(counts[i])
    return mapped[inverse.reshape(-1)], notes


def decide_numbering(
    labels: NDArray[np.int64],
    vertices: NDArray[np.float64],
    normals: NDArray[np.float64],
    boxes: list[tuple[NDArray[np.int64], frozenset[int]]],
    nyu40_of_id: dict[int, int],
) -> tuple[str, dict[str, Any]]:
    """By which numbering more vertices are what the scan says they are.

    A vertex speaks for a numbering that calls it floor where it faces up and nothing lies below it,
    and against one that does so elsewhere; and for one that gives it a class of the CAD whose box
    it lies in.

    Args:
        labels: (n,) as the file has them.
        vertices, normals: (n,3) scan frame, z up.
        boxes: of every aligned CAD, the vertices (k,) in it and the nyu40 ids it may carry.

    Returns:
        "nyu40" or "scannet", and how many vertices speak for each.

    Raises:
        InputError: both say something about the file's labels and neither more than the other.
    """
    readings = {name: np.asarray(to_nyu40(labels, name, nyu40_of_id)[0]) for name in NUMBERINGS}
    if np.array_equal(readings["nyu40"], readings["scannet"]):
        return "nyu40", {"both": len(labels)}
    low = _lowest(vertices) & (normals[:, 2] > FLOOR_UP)
    votes = {}
    for name, nyu40 in readings.items():
        floor = np.isin(nyu40, FLOOR_IDS)
        votes[name] = int((floor & low).sum()) - int((floor & ~low).sum())
        for inside, ids in boxes:
            votes[name] += int(np.isin(nyu40[inside], list(ids)).sum())
    if votes["nyu40"] == votes["scannet"]:
        if not ((labels > NYU40_MAX) | (labels < 0)).any():
            # Nothing in the scan bears on it (no floor, no aligned object): as published.
            return "nyu40", votes
        raise InputError(
            f"its labels ({', '.join(map(str, np.unique(labels)[:8].tolist()))}, …) may be nyu40's "
            f"numbers or ScanNet's own, and neither the floor nor the aligned objects tell which; "
            f"say it with --labels nyu40 or --labels scannet"
        )
    return max(votes, key=lambda name: votes[name]), votes


def _lowest(vertices: NDArray) -> NDArray[np.bool_]:
    """Whether each vertex (n,3) is within the band above the lowest of its cell."""
    cells = np.floor(vertices[:, :2] / FLOOR_CELL_M).astype(np.int64)
    cell = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
    lowest = np.full(cell.max() + 1, np.inf)
    np.minimum.at(lowest, cell, vertices[:, 2])
    return vertices[:, 2] - lowest[cell] <= FLOOR_BAND_M
