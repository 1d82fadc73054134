"""PCD, the format of the Point Cloud Library: ASCII, binary and compressed.

Source: the library's description of PCD 0.7; 0.6 and 0.5 differ in lines that bear on nothing here.
"""

from __future__ import annotations

import io
import struct

import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.cloud_formats.arrays import of_fields
from partialbench.dataset.cloud_formats.lzf import decompress
from partialbench.dataset.cloud_formats.points import NORMALS, XYZ, Points
from partialbench.errors import InputError

_TYPES = {"F": "f", "I": "i", "U": "u"}
_WANTED = {*XYZ, *(name for triple in NORMALS for name in triple)}


def read_pcd(content: bytes) -> Points:
    """The points that were measured: those that are not finite mean "no measurement".

    Raises:
        InputError: a header without what it needs, another number of points than it says, an
            encoding that the format does not have.
    """
    header, at = _header(content)
    layout, names = _layout(header)
    rows = _rows(header)
    encoding = header["DATA"][0].lower() if header["DATA"] else ""
    if encoding == "ascii":
        columns = _ascii(content[at:], layout, rows)
    elif encoding == "binary":
        columns = _binary(content[at:], layout, rows)
    elif encoding == "binary_compressed":
        columns = _compressed(content[at:], layout, rows)
    else:
        raise InputError(
            f"the PCD has DATA {encoding}, expected ascii, binary or binary_compressed"
        )
    fields: dict[str, NDArray] = {}
    for name, column in zip(names, columns, strict=True):
        if name.lower() in _WANTED:
            if name in fields:
                raise InputError(f"the PCD has the field {name!r} twice")
            fields[name] = column[:, 0] if column.shape[1] == 1 else column
    found = of_fields(fields or {name: np.zeros(0) for name in names})
    measured = np.isfinite(found.points).all(axis=1)
    normals = None if found.normals is None else found.normals[measured]
    return Points(found.points[measured], normals, found.named)


def _header(content: bytes) -> tuple[dict[str, list[str]], int]:
    header: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in header:
        end = content.find(b"\n", at)
        if end < 0:
            raise InputError("the PCD header has no DATA line")
        key, *values = content[at:end].decode("ascii", "replace").split("#")[0].split() or [""]
        key = "FIELDS" if key.upper() == "COLUMNS" else key.upper()
        if key and key in header:
            raise InputError(f"the PCD header has the line {key} twice")
        header[key] = values
        at = end + 1
        header.pop("", None)
    return header, at


def _layout(header: dict[str, list[str]]) -> tuple[np.dtype, list[str]]:
    """Each field's type under its place in the row, as names such as "_" repeat; and the names."""
    try:
        names, sizes = header["FIELDS"], [int(size) for size in header["SIZE"]]
        counts = [int(count) for count in header.get("COUNT", ["1"] * len(names))]
        fields = [
            (f"{i}", f"<{_TYPES[kind]}{size}", (count,))
            for i, (_, kind, size, count) in enumerate(
                zip(names, header["TYPE"], sizes, counts, strict=True)
            )
        ]
        layout = np.dtype(fields)
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise InputError(f"the PCD header is broken or has no x, y, z ({error})") from error
    if min(counts, default=0) < 1 or not set(XYZ) <= {name.lower() for name in names}:
        raise InputError(
            f"the PCD header is broken or has no x, y, z (FIELDS {' '.join(names)}, COUNT "
            f"{' '.join(map(str, counts))})"
        )
    return layout, names


def _rows(header: dict[str, list[str]]) -> int:
    """POINTS, or WIDTH times HEIGHT, which say the same."""
    try:
        said = {
            name: int(np.prod([int(header[key][0]) for key in keys], dtype=object))
            for name, keys in (("POINTS", ("POINTS",)), ("WIDTH × HEIGHT", ("WIDTH", "HEIGHT")))
            if all(key in header for key in keys)
        }
    except (ValueError, IndexError) as error:
        raise InputError(f"the PCD header is broken ({error})") from error
    if not said or len(set(said.values())) > 1 or min(said.values()) < 0:
        raise InputError(
            f"the PCD header says {said or 'nothing'} of how many points there are; expected "
            f"POINTS = WIDTH · HEIGHT"
        )
    return next(iter(said.values()))


def _ascii(body: bytes, layout: np.dtype, rows: int) -> list[NDArray]:
    lines = [line for line in body.replace(b"\r", b"\n").split(b"\n") if line.strip()]
    if len(lines) != rows:
        raise InputError(f"the PCD header says {rows} points, {len(lines)} follow it")
    if rows == 0:
        return [np.zeros((0, 1)) for _ in layout.names or ()]
    table = np.loadtxt(io.BytesIO(b"\n".join(lines)), ndmin=2, comments=None)
    counts = [layout[name].shape[0] for name in layout.names or ()]
    if table.shape[1] != sum(counts):
        raise InputError(
            f"the PCD has {table.shape[1]} numbers a point, its header says {sum(counts)}"
        )
    return np.split(table, np.cumsum(counts)[:-1], axis=1)


def _binary(body: bytes, layout: np.dtype, rows: int) -> list[NDArray]:
    needed = rows * layout.itemsize
    if len(body) < needed:
        raise InputError(
            f"the PCD was cut short: {rows} points need {needed} bytes, {len(body)} follow the "
            f"header"
        )
    if body[needed:].strip(b"\0\r\n "):
        raise InputError(f"{len(body) - needed} bytes follow the {rows} points of the PCD header")
    records = np.frombuffer(body, layout, rows)
    return [records[name] for name in layout.names or ()]


def _compressed(body: bytes, layout: np.dtype, rows: int) -> list[NDArray]:
    """LZF over the fields one after the other, each of all points."""
    if len(body) < 8:
        raise InputError("the PCD was cut short: no compressed size follows the header")
    packed, size = struct.unpack("<II", body[:8])
    if len(body) - 8 < packed:
        raise InputError(
            f"the PCD was cut short: {packed} compressed bytes are said, {len(body) - 8} follow"
        )
    if size != rows * layout.itemsize:
        raise InputError(
            f"the PCD unpacks to {size} bytes, {rows} points need {rows * layout.itemsize}"
        )
    data = decompress(body[8 : 8 + packed], size)
    columns, at = [], 0
    for name in layout.names or ():
        kind, (count,) = layout[name].base, layout[name].shape
        columns.append(np.frombuffer(data, kind, rows * count, at).reshape(rows, count))
        at += rows * count * kind.itemsize
    return columns
