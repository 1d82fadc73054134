"""PLY: the rows of its element ``vertex``, by name. Faces behind them are left aside."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.cloud_formats.arrays import of_fields
from partialbench.dataset.cloud_formats.points import NORMALS, XYZ, Points
from partialbench.dataset.ply import PlyElement, PlyHeader, parse_header, require_whole
from partialbench.errors import InputError


def read_ply(content: bytes) -> Points:
    """The vertices, as many as the header says; ASCII or binary of either byte order.

    Read here and not by trimesh, which counts an ASCII file's lines for its vertices and keeps
    no normals of a cloud.

    Raises:
        InputError: no vertices, no x, y, z, a list among or before them, fewer rows than the header
            says, or more.
    """
    header = parse_header(content)
    require_whole(content)
    if header.count("vertex") == 0:
        raise InputError("the PLY has no vertices")
    at = [element.name for element in header.elements].index("vertex")
    for element in header.elements[: at + 1]:
        if element.count and any(p.length_dtype for p in element.properties):
            raise InputError(
                f"the PLY's element {element.name!r} holds a list, among or before the points; "
                f"expected points of plain properties, first"
            )
    vertex = header.elements[at]
    names = [p.name for p in vertex.properties]
    if len(set(names)) < len(names):
        raise InputError(f"the PLY's vertices have a property twice: {', '.join(names)}")
    if not {*XYZ} <= {name.lower() for name in names}:
        raise InputError(
            f"the PLY's vertices have the properties {', '.join(names)}; expected x, y, z"
        )
    read = _ascii if header.encoding == "ascii" else _binary
    return of_fields(read(content, header, at))


def _ascii(content: bytes, header: PlyHeader, at: int) -> dict[str, NDArray]:
    body = content[header.size :].replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    rows = [row for row in body.split(b"\n") if row.strip()]
    expected = sum(element.count for element in header.elements)
    if len(rows) != expected:
        raise InputError(f"the PLY header says {expected} rows, {len(rows)} follow it")
    vertex = header.elements[at]
    start = sum(element.count for element in header.elements[:at])
    text = b"\n".join(rows[start : start + vertex.count])
    table = np.loadtxt(io.BytesIO(text), ndmin=2, comments=None)
    if table.shape != (vertex.count, len(vertex.properties)):
        raise InputError(
            f"the PLY's vertices have {table.shape[1]} numbers, its header names "
            f"{len(vertex.properties)}"
        )
    wanted = {*XYZ, *(name for triple in NORMALS for name in triple)}
    return {
        p.name: table[:, k] for k, p in enumerate(vertex.properties) if p.name.lower() in wanted
    }


def _binary(content: bytes, header: PlyHeader, at: int) -> dict[str, NDArray]:
    order = "<" if header.encoding == "binary_little_endian" else ">"

    def layout(element: PlyElement) -> np.dtype:
        return np.dtype([(p.name, order + p.dtype) for p in element.properties])

    vertex = header.elements[at]
    start = header.size + sum(
        element.count * layout(element).itemsize
        for element in header.elements[:at]
        if element.count
    )
    size = layout(vertex).itemsize
    if len(content) - start < vertex.count * size:
        raise InputError(
            f"the PLY was cut short: {vertex.count} vertices need {vertex.count * size} bytes, "
            f"{max(0, len(content) - start)} follow"
        )
    behind = [e for e in header.elements[at + 1 :] if e.count]
    if not any(p.length_dtype for e in behind for p in e.properties):
        end = start + vertex.count * size + sum(e.count * layout(e).itemsize for e in behind)
        if len(content) != end and content[end:].strip(b"\r\n\0 "):
            raise InputError(f"{len(content) - end} bytes follow the rows that the PLY header says")
        if len(content) < end:
            raise InputError(f"the PLY was cut short by {end - len(content)} bytes")
    rows = np.frombuffer(content, layout(vertex), vertex.count, start)
    return {name: rows[name] for name in layout(vertex).names or ()}
