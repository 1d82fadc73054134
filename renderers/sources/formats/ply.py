"""PLY meshes: ASCII and binary, either byte order, lists of any length, any further elements.

Source: G. Turk, "The PLY Polygon File Format" (1994). plyfile read every file that was tried, but
took 160 times as long as NumPy for a binary mesh of triangles and rounds what an ASCII file says
to the header's float32. trimesh and meshio each fail on several of the usual kinds.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.ply import PlyElement, PlyHeader, parse_header
from partialbench.errors import InputError
from renderers.sources.formats.polygons import Polygons
from renderers.sources.formats.strips import of_strip
from renderers.sources.formats.text import decimals, shown, unix_lines, whole

_FACES = ("vertex_indices", "vertex_index")
Columns = dict[str, tuple[NDArray, NDArray[np.int64]]]
"""Property → its values one row after the other, and how many each row has."""


def read_ply(content: bytes) -> Polygons:
    """The polygons of a PLY file; see ``read_with``."""
    return read_with(content, ())[0]


def read_with(content: bytes, names: tuple[str, ...]) -> tuple[Polygons, dict[str, NDArray]]:
    """The polygons of a PLY file, its faces and then its strips of triangles; and, (n,) float64 or
    int64 each, those properties of its vertices that are called so and are one number each.

    In an ASCII file a row stands on a line; blank lines are skipped, and coordinates are as exact
    as they are written. Faces of fewer than three corners are left out, and the notices say so.

    Raises:
        InputError: a broken header, no vertices with x, y, z, no faces, fewer or more data than
            the header counts, a word that is no number.
    """
    header = parse_header(content)
    if not header.is_mesh:
        raise InputError("has no faces; expected a mesh, not points or lines")
    wanted = {"vertex": ("x", "y", "z"), "face": _FACES, "tristrips": _FACES}
    for element in header.elements:
        _require_properties(element, wanted.get(element.name, ()))
    vertex = [p for e in header.elements if e.name == "vertex" for p in e.properties]
    beside = [n for n in names if [p.length_dtype for p in vertex if p.name == n] == [""]]
    body = content[header.size :]
    read = _read_ascii if header.encoding == "ascii" else _read_binary
    columns = read(body, header, {**wanted, "vertex": ("x", "y", "z", *beside)})
    if "vertex" not in columns:
        raise InputError("the PLY header has no element vertex")
    vertices = np.stack([columns["vertex"][axis][0] for axis in "xyz"], axis=1)
    corners, sizes = [], []
    for name, (values, lengths) in columns.get("face", {}).items():
        if name in _FACES:
            corners.append(values)
            sizes.append(lengths)
    for values, lengths in columns.get("tristrips", {}).values():
        for row in np.split(values.astype(np.int64), np.cumsum(lengths)[:-1]):
            # −1 ends a strip and begins the next.
            for strip in np.split(row, np.flatnonzero(row == -1)):
                strip = strip[strip != -1]
                if 0 < len(strip) < 3:
                    raise InputError("a strip of triangles has fewer than three corners")
                triangles = of_strip(strip)
                corners.append(triangles.reshape(-1))
                sizes.append(np.full(len(triangles), 3))
    polygons = Polygons.of_faces(vertices, np.concatenate(corners), np.concatenate(sizes))
    return polygons, {name: columns["vertex"][name][0] for name in beside}


def _require_properties(element: PlyElement, names: tuple[str, ...]) -> None:
    found = [p for p in element.properties if p.name in names]
    lists = names == _FACES
    if names and element.count:
        if len(found) != (1 if lists else 3):
            expected = "one list vertex_indices" if lists else "x, y and z"
            raise InputError(f"the PLY element {element.name} must have {expected} once")
        if any(bool(p.length_dtype) != lists or (lists and p.dtype[0] == "f") for p in found):
            expected = "a list of whole numbers" if lists else "a number, not a list"
            raise InputError(f"the PLY property {found[0].name!r} must be {expected}")
    if element.count and not element.properties:
        raise InputError(f"the PLY element {element.name} has no properties")


def _read_ascii(
    body: bytes, header: PlyHeader, wanted: dict[str, tuple[str, ...]]
) -> dict[str, Columns]:
    lines = [words for line in unix_lines(body).split(b"\n") if (words := line.split())]
    columns = {}
    at = 0
    for element in header.elements:
        rows = lines[at : at + element.count]
        if len(rows) < element.count:
            raise InputError(
                f"the ASCII PLY was cut short: its header says {element.count} {element.name} "
                f"lines, {len(rows)} are there"
            )
        at += element.count
        if rows:
            columns[element.name] = _ascii_columns(rows, element, wanted.get(element.name, ()))
    if at < len(lines):
        raise InputError(
            f"{len(lines) - at} lines follow the {at} that the PLY header counts, the first of "
            f"them {shown(lines[at])!r}: the counts are wrong or something was added"
        )
    return columns


def _ascii_columns(rows: list[list[bytes]], element: PlyElement, names: tuple[str, ...]) -> Columns:
    found: dict[str, list[bytes]] = {p.name: [] for p in element.properties}
    lengths: dict[str, list[int]] = {name: [] for name in found}
    if any(p.length_dtype for p in element.properties):
        for k, row in enumerate(rows):
            at = 0
            for each in element.properties:
                count = 1
                if each.length_dtype:
                    count = int(row[at]) if at < len(row) and row[at].isdigit() else len(row)
                    at += 1
                found[each.name] += row[at : at + count]
                lengths[each.name].append(count)
                at += count
            if at != len(row):
                raise _wrong_row(element, k, row, at)
    else:
        width = len(element.properties)
        for k, row in enumerate(rows):
            if len(row) != width:
                raise _wrong_row(element, k, row, width)
        for k, each in enumerate(element.properties):
            found[each.name] = [row[k] for row in rows]
            lengths[each.name] = [1] * len(rows)
    # What bears on no position must be numbers too: words that are none tell of damage.
    return {
        name: (
            (whole if names == _FACES and name in names else decimals)(
                words, f"a {name} of a {element.name}"
            ),
            np.array(lengths[name], np.int64),
        )
        for name, words in found.items()
    }


def _wrong_row(element: PlyElement, k: int, row: list[bytes], expected: int) -> InputError:
    return InputError(
        f"{element.name} {k} of the ASCII PLY is {shown(row)!r}, which is "
        f"{'less' if expected > len(row) else 'more'} than its properties take; it was cut short "
        f"or is damaged"
    )


def _read_binary(
    body: bytes, header: PlyHeader, wanted: dict[str, tuple[str, ...]]
) -> dict[str, Columns]:
    order = ">" if header.encoding == "binary_big_endian" else "<"
    columns = {}
    at = 0
    for element in header.elements:
        if element.count:
            names = wanted.get(element.name, ())
            columns[element.name], at = _binary_columns(body, at, element, order, names)
    # Some writers end the file with a line end.
    if body[at:].strip(b"\r\n"):
        raise InputError(
            f"{len(body) - at} bytes follow the last row that the PLY header counts: the counts "
            f"are wrong or something was added"
        )
    return columns


def _binary_columns(
    body: bytes, at: int, element: PlyElement, order: str, names: tuple[str, ...]
) -> tuple[Columns, int]:
    """An element's columns and where the next begins."""
    one = PlyElement(element.name, 1, element.properties)
    starts, lengths, first_end = _varied_rows(body, at, one, order)
    stride, end = first_end - at, at + (first_end - at) * element.count
    steady = _all_as_the_first(body, starts[0], lengths[0], stride, element, order)
    if not steady:
        starts, lengths, end = _varied_rows(body, at, element, order)
    columns = {}
    raw = np.frombuffer(body, np.uint8)
    for k, each in enumerate(element.properties):
        if each.name not in names:
            continue
        dtype = np.dtype(order + each.dtype)
        if steady:
            shape = element.count, int(lengths[0, k])
            values = np.ndarray(shape, dtype, body, int(starts[0, k]), (stride, dtype.itemsize))
            count = np.full(shape[0], shape[1])
        else:
            count = lengths[:, k]
            # The bytes of a value are at its row's start and its place in the row.
            within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
            first = np.repeat(starts[:, k], count) + within * dtype.itemsize
            values = raw[first[:, None] + np.arange(dtype.itemsize)].reshape(-1).view(dtype)
        exact = np.float64 if each.dtype[0] == "f" else np.int64
        columns[each.name] = values.reshape(-1).astype(exact), count
    return columns, end


def _all_as_the_first(
    body: bytes, starts: NDArray, lengths: NDArray, stride: int, element: PlyElement, order: str
) -> bool:
    """Whether all rows have lists as long as the first's, so that they are equally far apart."""
    first_of_row = int(starts[0]) - np.dtype(element.properties[0].length_dtype or "V0").itemsize
    if stride == 0 or first_of_row + stride * element.count > len(body):
        return False
    for k, each in enumerate(element.properties):
        if each.length_dtype:
            dtype = np.dtype(order + each.length_dtype)
            at = int(starts[k]) - dtype.itemsize
            if (np.ndarray((element.count,), dtype, body, at, (stride,)) != lengths[k]).any():
                return False
    return True


def _varied_rows(
    body: bytes, at: int, element: PlyElement, order: str
) -> tuple[NDArray, NDArray, int]:
    """Where each property's values begin, (n,p), how many they are, (n,p), and the rows' end."""
    byteorder = "big" if order == ">" else "little"
    layout = [
        (np.dtype(each.dtype).itemsize,
         np.dtype(each.length_dtype).itemsize if each.length_dtype else 0,
         each.length_dtype[:1] == "i")
        for each in element.properties
    ]  # fmt: skip
    starts: list[int] = []
    lengths: list[int] = []
    for row in range(element.count):
        for size, length_size, signed in layout:
            count = 1
            if length_size:
                count = int.from_bytes(body[at : at + length_size], byteorder, signed=signed)  # type: ignore[arg-type]
                at += length_size
            starts.append(at)
            lengths.append(count)
            at += size * count
            if count < 0 or at > len(body):
                raise InputError(
                    f"the binary PLY was cut short or is damaged: {element.name} {row} of "
                    f"{element.count} runs past the file's end or has a list of {count} values"
                )
    shape = -1, len(layout)
    return (
        np.array(starts, np.int64).reshape(shape),
        np.array(lengths, np.int64).reshape(shape),
        at,
    )
