"""Point cloud files of any common format as one (n,3) array, and their normals."""

from __future__ import annotations

from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.cloud_formats.arrays import read_npy, read_npz
from partialbench.dataset.cloud_formats.pcd import read_pcd
from partialbench.dataset.cloud_formats.ply import read_ply
from partialbench.dataset.cloud_formats.points import Points, unit_normals
from partialbench.dataset.cloud_formats.text import read_text
from partialbench.errors import InputError, parsing

_READERS = {".ply": read_ply, ".pcd": read_pcd, ".npy": read_npy, ".npz": read_npz}

FORMATS = (".ply", ".pcd", ".xyz", ".pts", ".txt", ".csv", ".npy", ".npz")
"""What is read, in the order of preference where an object comes in several."""


def read_cloud(content: bytes, name: str) -> NDArray[np.float64]:
    """The points of one file, (n,3) float64 in the file's units and frame, n ≥ 1.

    PLY and PCD give their vertices' x, y, z, as do text with a header and arrays with fields; all
    else its first three columns. Points that are not finite are dropped from a PCD, where they mean
    "no measurement".

    Args:
        content: the file's bytes.
        name: its name; the suffix says the format.

    Raises:
        InputError: no format that is read, or the file is broken, has no points or some that are
            not finite, or may be read in two ways.
    """
    return read_oriented(content, name)[0]


def parse_cloud(content: bytes, name: str) -> Points:
    """What a file's reader makes of it: its points, finite or not, and what it says of them.

    Raises:
        InputError: as ``read_cloud``, but for points that are not finite.
    """
    suffix = PurePosixPath(name).suffix.lower()
    if suffix not in FORMATS:
        raise InputError(f"{name}: {suffix or 'no'!r} is no cloud suffix of {', '.join(FORMATS)}")
    with parsing(name, suffix[1:].upper()):
        return _READERS.get(suffix, read_text)(content)


def read_oriented(
    content: bytes, name: str
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """``read_cloud``, and the unit normals (n,3) float64 that the file has of all its points.

    Those are what the file calls normals, or columns 4 to 6 where every row has the length 1. None
    where there are none, or where one of them has no direction.
    """
    found = parse_cloud(content, name)
    points, normals = found.points, unit_normals(found)
    finite = np.isfinite(points).all(axis=1)
    if len(points) == 0 or not finite.all():
        wrong = f"{(~finite).sum()} of {len(points)} points are not finite"
        raise InputError(f"{name}: {wrong if len(points) else 'no point was measured'}")
    return points, normals
