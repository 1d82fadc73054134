"""OFF files as they are found: every header keyword, any white space, text and binary.

Source: the Geomview manual, "OFF Files". Own, because no library that was tried reads them all:
trimesh takes two vertices on a line for another body and refuses lower case and binary; meshio
reads plain triangles only. A ModelNet file is scanned by NumPy in one go.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from partialbench.errors import InputError
from renderers.sources.formats.polygons import Polygons
from renderers.sources.formats.text import decimals, shown, unix_lines, whole

_COMMENT = re.compile(rb"#[^\r\n]*")
_KEYWORD = re.compile(rb"\s*(?:((?:ST|[CN4n])*)OFF|((?:st|[cn4])*)off)(?![A-Za-z])")
_COUNTS = re.compile(rb"\s*(\S+)\s+(\S+)(?:[ \t]+(\S+))?")
_BINARY = re.compile(rb"[ \t]*BINARY[ \t]*(?:\r\n|\r|\n)")
_FACE_COLOURS = (0, 1, 3, 4)
"""Numbers behind a face's corners: none, an index into a colour map, RGB, RGBA."""


_PLAIN = (3, 6, 7)
"""Numbers of a vertex of plain OFF: colours are written behind it too."""


@dataclass(frozen=True)
class _Layout:
    """What the keyword says of a vertex: coordinates, a divisor, and how many numbers in all."""

    divided: bool
    widths: tuple[int, ...]


def read_off(content: bytes) -> Polygons:
    """The polygons of an OFF file, as the file has them: nothing merged, nothing dropped.

    Takes ``OFF`` with any of ``ST C N 4 n`` before it in any order, upper or lower case, on a line
    of its own or fused with the counts (``OFF3514 3546 0``), with or without the count of edges;
    comments; LF, CRLF or CR; one vertex or face a line, in which case RGB or RGBA behind plain
    ``OFF`` vertices and a colour behind faces are left out, or any other white space, in which case
    there must be nothing but what the counts promise; binary. The vertices of ``4OFF`` are divided
    by their fourth number, those of ``nOFF`` must have three dimensions. Faces of two corners are
    edges: they are left out, and the notices say so.

    Raises:
        InputError: the file is no OFF, holds less or more than its counts say, has no face, or a
            word that is no number.
    """
    keyword = _KEYWORD.match(content.removeprefix(b"\xef\xbb\xbf"))
    if keyword is not None and (line := _BINARY.match(content, keyword.end())):
        layout, dimensions = _layout(keyword)
        return _read_binary(content[line.end() :], layout, dimensions)
    if b"#" in content:
        content = _COMMENT.sub(b"", content)
    content = unix_lines(content)
    keyword = _KEYWORD.match(content)
    if keyword is None:
        words = content.split(maxsplit=1)
        found = shown(words[:1])[:20] if words else ""
        raise InputError(f"begins with {found!r}; expected OFF and the counts")
    layout, has_dimensions = _layout(keyword)
    body = content[keyword.end() :]
    if has_dimensions:
        first, _, body = body.lstrip().partition(b"\n")
        _require_three(int(whole(first.split()[:1] or [b""], "what should be the dimension")[0]))
    match = _COUNTS.match(body)
    if match is None:
        raise InputError("has no counts behind its keyword; expected those of vertices and faces")
    counts = whole([match[1], match[2]], "one of the counts of vertices and faces")
    vertex_count, face_count = _require_counts(int(counts[0]), int(counts[1]))
    rest = body[match.end() :]
    if layout.widths == _PLAIN and (regular := _read_regular(rest, vertex_count, face_count)):
        return Polygons.of_triangles(*regular)
    return _read_any(rest, vertex_count, face_count, layout, match[3] is None)


def _layout(keyword: re.Match[bytes]) -> tuple[_Layout, bool]:
    """What a matched keyword says, and whether a line with the dimension follows it."""
    # In any order: Geomview writes CNOFF, MeshLab NCOFF.
    flags = re.findall(rb"ST|[CN4n]", keyword[2].upper() if keyword[1] is None else keyword[1])
    if len(set(flags)) < len(flags):
        raise InputError(f"begins with {shown([keyword[0].strip()])!r}, which says a thing twice")
    divided = b"4" in flags
    width = 3 + divided + 3 * (b"N" in flags) + 2 * (b"ST" in flags)
    widths: tuple[int, ...] = (width,)
    if b"C" in flags:
        widths = width + 4, width + 3
    elif width == 3:
        widths = _PLAIN
    return _Layout(divided, widths), b"n" in flags


def _require_three(dimension: int) -> None:
    if dimension != 3:
        raise InputError(f"its vertices have {dimension} dimensions; expected 3")


def _require_counts(vertex_count: int, face_count: int) -> tuple[int, int]:
    if vertex_count < 1 or face_count < 1:
        raise InputError(
            f"has {vertex_count} vertices and {face_count} faces; expected at least one face"
        )
    return vertex_count, face_count


def _read_regular(
    body: bytes, vertex_count: int, face_count: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]] | None:
    """Vertices and faces where all rows are three numbers, then all a 3 and three indices.

    That is every ModelNet file; ``None`` for any other, which the reader of words takes.
    """
    body = body.lstrip()
    newlines = np.flatnonzero(np.frombuffer(body, np.uint8) == ord("\n"))
    if len(newlines) < vertex_count:
        return None
    end = int(newlines[vertex_count - 1])
    try:
        coordinates = np.fromstring(body[:end], np.float64, sep=" ")
        corners = np.fromstring(body[end:], np.int64, sep=" ")
    except ValueError:
        return None
    if len(coordinates) != 3 * vertex_count or len(corners) != 4 * face_count:
        return None
    rows = corners.reshape(face_count, 4)
    # NumPy takes a sign without digits for 0; no index has one.
    if not (rows[:, 0] == 3).all() or max(body.find(b"-", end), body.find(b"+", end)) >= 0:
        return None
    return coordinates.reshape(vertex_count, 3), rows[:, 1:]


def _read_any(
    body: bytes, vertex_count: int, face_count: int, layout: _Layout, edges_to_come: bool
) -> Polygons:
    """By lines where there is about one for each vertex and face, else as one stream of words.

    Either way nothing may be left over, so that no count is taken for less than is there.
    """
    lines = [words for line in body.split(b"\n") if (words := line.split())]
    stated = vertex_count + face_count
    # A count of edges may stand on a line of its own, if not behind the other two.
    has_line = edges_to_come and len(lines) > 1 and len(lines[0]) == 1
    without_edges = lines[1:] if has_line else lines
    if len(without_edges) == stated:
        return _read_lines(without_edges, vertex_count, layout)
    # A file by lines that lost or won a few must not pass for a stream.
    if len(lines) <= 4 or abs(len(lines) - stated) > 2:
        for start in (lines, without_edges):
            for width in layout.widths[:1] if layout.widths == _PLAIN else layout.widths:
                found = _read_stream(start, vertex_count, face_count, width, layout)
                if found is not None:
                    return found
    if len(lines) < stated:
        end = f"vertex {len(lines)} of {vertex_count}"
        if len(lines) >= vertex_count:
            end = f"face {len(lines) - vertex_count} of {face_count}"
        raise InputError(f"the file ends after {end}; it was cut short or its counts are wrong")
    raise InputError(
        f"{len(lines)} lines follow the counts of {vertex_count} vertices and {face_count} "
        f"faces; expected {stated}: the counts are wrong or something was added"
    )


def _read_lines(lines: list[list[bytes]], vertex_count: int, layout: _Layout) -> Polygons:
    """One vertex or face a line, colours behind them left out."""
    rows, faces = lines[:vertex_count], lines[vertex_count:]
    width = len(rows[0]) if len(rows[0]) in layout.widths else layout.widths[0]
    for k, row in enumerate(rows):
        if len(row) != width:
            expected = " or ".join(map(str, layout.widths))
            raise InputError(
                f"vertex {k} is {shown(row)!r}; expected {expected} numbers, as many in each"
            )
    numbers = _numbers(rows, decimals, "vertex", "numbers").reshape(-1, width)
    sizes = _numbers([face[:1] for face in faces], whole, "face", "a count first")
    for k, (face, size) in enumerate(zip(faces, sizes.tolist(), strict=True)):
        if size < 1 or len(face) - 1 - size not in _FACE_COLOURS:
            raise InputError(
                f"face {k} is {shown(face)!r}; expected a count, as many vertex indices, and at "
                f"most a colour behind them"
            )
    pairs = list(zip(faces, sizes.tolist(), strict=True))
    corners = _numbers([f[1 : 1 + n] for f, n in pairs], whole, "face", "vertex indices")
    _numbers([f[1 + n :] for f, n in pairs], decimals, "the colour of face", "numbers")
    return Polygons.of_faces(_divided(numbers, layout), corners, sizes)


def _numbers(
    rows: list[list[bytes]], parse: Callable[..., NDArray], what: str, expected: str
) -> NDArray:
    """All words of the rows as numbers; the error names the first row that has another."""
    try:
        return parse([word for row in rows for word in row], "")
    except InputError:
        for k, row in enumerate(rows):
            try:
                parse(row, "")
            except InputError:
                raise InputError(f"{what} {k} is {shown(row)!r}; expected {expected}") from None
        raise


def _divided(numbers: NDArray, layout: _Layout) -> NDArray[np.float64]:
    points = np.asarray(numbers[:, :3], np.float64)
    if not layout.divided:
        return points
    divisor = np.asarray(numbers[:, 3:4], np.float64)
    if not (np.isfinite(divisor) & (divisor != 0)).all():
        raise InputError("the fourth number of a 4OFF vertex is 0 or not finite")
    return points / divisor


def _read_stream(
    lines: list[list[bytes]], vertex_count: int, face_count: int, width: int, layout: _Layout
) -> Polygons | None:
    """Words one behind the other, no colour behind a face; None where they are no such thing."""
    by_line = [len(line) == width for line in lines[:vertex_count]]
    if any(by_line[: vertex_count // 2]) and not all(by_line):
        return None  # vertices a line each, some of them damaged
    words = [word for line in lines for word in line]
    faces = _faces_of_words(words[width * vertex_count :], face_count)
    if faces is None:
        return None
    numbers = decimals(words[: width * vertex_count], "a number of a vertex")
    return Polygons.of_faces(_divided(numbers.reshape(vertex_count, width), layout), *faces)


def _faces_of_words(words: list[bytes], face_count: int) -> tuple[NDArray, NDArray] | None:
    """Corners and sizes of faces one behind the other, without colours; None where words differ."""
    try:
        numbers = whole(words, "")
    except InputError:
        return None
    corners: list[NDArray] = []
    sizes: list[int] = []
    at = 0
    while at < len(numbers) and len(sizes) < face_count:
        size = int(numbers[at])
        if size < 3:
            return None
        corners.append(numbers[at + 1 : at + 1 + size])
        sizes.append(size)
        at += 1 + size
    if at != len(numbers) or len(sizes) < face_count:
        return None
    return np.concatenate(corners), np.array(sizes, np.int64)


def _read_binary(data: bytes, layout: _Layout, has_dimension: bool) -> Polygons:
    """Big-endian: counts, vertices as float32, faces as counts, indices and colours (float32)."""
    words = np.frombuffer(data[: len(data) // 4 * 4], ">i4")
    if len(data) % 4 or len(words) < 3 + has_dimension:
        raise InputError(f"the binary OFF has {len(data)} bytes behind its first line; cut short?")
    if has_dimension:
        _require_three(int(words[0]))
        words = words[1:]
    vertex_count, face_count = _require_counts(int(words[0]), int(words[1]))
    # Binary vertices have what the keyword says: four numbers for a colour, none behind plain OFF.
    width = layout.widths[0]
    if len(words) < 3 + width * vertex_count + 2 * face_count:
        raise InputError(
            f"the binary OFF was cut short: {vertex_count} vertices and {face_count} faces do not "
            f"fit into {len(data)} bytes"
        )
    numbers = words[3 : 3 + width * vertex_count].view(">f4").reshape(vertex_count, width)
    corners, sizes = [], []
    at = 3 + width * vertex_count
    for k in range(face_count):
        size = int(words[at]) if at < len(words) else 0
        colours = int(words[at + 1 + size]) if 0 < size < len(words) - at - 1 else -1
        if colours not in _FACE_COLOURS:
            raise InputError(
                f"face {k} of {face_count} of the binary OFF runs past the file's end or says what "
                f"no face does; it was cut short or is damaged"
            )
        corners.append(words[at + 1 : at + 1 + size])
        sizes.append(size)
        at += 2 + size + colours
    if at != len(words):
        raise InputError(f"the binary OFF has {4 * (len(words) - at)} bytes too many or too few")
    return Polygons.of_faces(
        _divided(numbers, layout),
        np.concatenate(corners).astype(np.int64),
        np.array(sizes, np.int64),
    )
