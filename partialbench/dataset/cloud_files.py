"""Point cloud files of any common format as one (n,3) array."""

from __future__ import annotations

import io
import re
from pathlib import PurePosixPath
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from partialbench.dataset.ply import require_whole
from partialbench.errors import InputError, parsing

FORMATS = (".ply", ".pcd", ".xyz", ".txt", ".npy", ".csv", ".pts")
"""What ``read_cloud`` reads."""

SUFFIXES = FORMATS[:5]
"""What is a cloud in a folder, in the order of preference where an object comes in several.

The other two are as often lists or labels there.
"""

_PCD_TYPES = {"F": "f", "I": "i", "U": "u"}


def read_cloud(content: bytes, name: str, drop_unmeasured: bool = False) -> NDArray[np.float64]:
    """The points of one file, (n,3) float64 in the file's units and frame, n ≥ 1.

    PLY and PCD give their vertices' x, y, z; all else its first three columns. Further fields
    (colours, normals, faces) are left aside. Points that are not finite are dropped from a PCD,
    where they mean "no measurement".

    Args:
        content: the file's bytes.
        name: its name; the suffix says the format.
        drop_unmeasured: drop them from every format, as a capture may have them; without it they
            are an error. Then n may be 0.

    Raises:
        InputError: no format that is read, or the file is broken or has no points.
    """
    suffix = PurePosixPath(name).suffix.lower()
    if suffix not in FORMATS:
        raise InputError(f"{name}: {suffix or 'no'!r} is no cloud suffix of {', '.join(FORMATS)}")
    reader = {".ply": _read_ply, ".pcd": _read_pcd, ".npy": _read_npy}.get(suffix, _read_text)
    with parsing(name, suffix[1:].upper()):
        points = np.asarray(reader(content), np.float64)
    if points.ndim != 2 or points.shape[1] < 3 or len(points) == 0:
        raise InputError(f"{name}: expected an (n,3) cloud with n ≥ 1, got {points.shape}")
    points = points[:, :3]
    finite = np.isfinite(points).all(axis=1)
    if not (drop_unmeasured or finite.all()):
        raise InputError(f"{name}: {(~finite).sum()} of {len(points)} points are not finite")
    return points[finite]


def _read_ply(content: bytes) -> NDArray:
    require_whole(content)
    loaded: Any = trimesh.load(io.BytesIO(content), file_type="ply", process=False)
    return np.asarray(loaded.vertices)


def _read_text(content: bytes) -> NDArray:
    text = content.decode()
    # Commas become spaces, so what stands behind an empty cell would move into it.
    if re.search(r"(^|,)[ \t]*,", text, re.MULTILINE):
        raise InputError("a cell is empty; expected a number between any two commas")
    return np.loadtxt(io.StringIO(text.replace(",", " ")), ndmin=2)


def _read_npy(content: bytes) -> NDArray:
    return np.load(io.BytesIO(content), allow_pickle=False)


def _read_pcd(content: bytes) -> NDArray:
    """Source: the PCD v0.7 format description of the Point Cloud Library."""
    header: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in header:
        end = content.find(b"\n", at)
        if end < 0:
            raise InputError("the PCD header has no DATA line")
        key, *values = content[at:end].decode("ascii", "replace").split("#")[0].split() or [""]
        header[key.upper()] = values
        at = end + 1
    try:
        fields, sizes = header["FIELDS"], [int(size) for size in header["SIZE"]]
        counts = [int(count) for count in header.get("COUNT", ["1"] * len(fields))]
        rows = int(header["POINTS"][0])
        layout = np.dtype(
            [
                (f"{i}", f"<{_PCD_TYPES[kind]}{size}", (count,))
                for i, (kind, size, count) in enumerate(
                    zip(header["TYPE"], sizes, counts, strict=True)
                )
            ]
        )
        columns = [fields.index(axis) for axis in "xyz"]
        encoding = header["DATA"][0].lower()
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise InputError(f"the PCD header is broken or has no x, y, z ({error})") from error
    if encoding == "ascii":
        table = np.loadtxt(io.BytesIO(content[at:]), ndmin=2)
        starts = np.concatenate([[0], np.cumsum(counts)])
        points = table[:, starts[columns]]
    elif encoding == "binary":
        if len(content) - at < rows * layout.itemsize:
            raise InputError(
                f"the PCD was cut short: {rows} points need {rows * layout.itemsize} bytes, "
                f"{len(content) - at} follow the header"
            )
        records = np.frombuffer(content, layout, rows, at)
        points = np.column_stack([records[str(c)][:, 0] for c in columns])
    else:
        raise InputError(
            f"the PCD has DATA {encoding}, expected ascii or binary; convert it with "
            f"'pcl_convert_pcd_ascii_binary IN OUT 1'"
        )
    if len(points) != rows:
        raise InputError(f"the PCD header says {rows} points, {len(points)} follow it")
    return points[np.isfinite(points).all(axis=1)]
