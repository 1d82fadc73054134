"""OFF files as they are found: every header keyword, any white space, text and binary.

Source: the Geomview manual, "OFF Files". Own, because no library that was tried reads them all:
trimesh takes two vertices on a line for another body and refuses lower case and binary; meshio
reads plain triangles only. A ModelNet file is scanned by NumPy in one go.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from partialbench.errors import InputError
from renderers.sources.formats.polygons import Polygons
from renderers.sources.formats.text import LONE_SIGN, decimals, shown, unix_lines, whole

_COMMENT = re.compile(rb"#[^\r\n]*")
_KEYWORD = re.compile(rb"\s*(?:(ST)?(C)?(N)?(4)?(n)?OFF|((?:st)?c?n?4?off))(?![A-Za-z])")
_COUNTS = re.compile(rb"\s*(\S+)\s+(\S+)(?:[ \t]+(\S+))?")
_BINARY = re.compile(rb"[ \t]*BINARY[ \t]*(?:\r\n|\r|\n)")
_FACE_COLOURS = (0, 1, 3, 4)
"""Numbers behind a face's corners: none, an index into a colour map, RGB, RGBA."""


@dataclass(frozen=True)
class _Layout:
    """What the keyword says of a vertex: coordinates, a divisor, and how many numbers in all."""

    divided: bool
    widths: tuple[int, ...]


def read_off(content: bytes) -> Polygons:
    """The polygons of an OFF file, as the file has them: nothing merged, nothing dropped.

    Takes ``OFF`` with any of ``ST C N 4 n`` before it, upper or lower case, on a line of its own or
    fused with the counts (``OFF3514 3546 0``), with or without the count of edges; comments; LF,
    CRLF or CR; one vertex or face a line, in which case RGB or RGBA behind plain ``OFF`` vertices
    and a colour behind faces are left out, or any other white space, in which case there must be
    nothing but what the counts promise; binary. The vertices of ``4OFF`` are divided by their
    fourth number, those of ``nOFF`` must have three dimensions. Faces of two corners are edges:
    they are left out, and the notices say so.

    Raises:
        InputError: the file is no OFF, holds less or more than its counts say, has no face, or a
            word that is no number.
    """
    keyword = _KEYWORD.match(content.removeprefix(b"\xef\xbb\xbf"))
    if keyword is not None and (start := _BINARY.match(content, keyword.end())):
        layout, dimensions = _layout(keyword)
        return _read_binary(content[start.end() :], layout, dimensions)
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
    if layout.widths == (3, 6, 7) and (found := _read_regular(rest, vertex_count, face_count)):
        return Polygons.of_triangles(*found)
    return _read_any(rest, vertex_count, face_count, layout)


def _layout(keyword: re.Match[bytes]) -> tuple[_Layout, bool]:
    """What a matched keyword says, and whether a line with the dimension follows it."""
    texture, colour, normal, divided, dimension, small = keyword.groups()
    if small is not None:
        return _layout(_KEYWORD.match(small.upper()) or keyword)
    width = 3 + bool(divided) + 3 * bool(normal) + 2 * bool(texture)
    widths = (width + 4, width + 3) if colour else (width,)
    if width == 3 and not colour:
        widths = (3, 6, 7)  # colours are written behind plain OFF's vertices too
    return _Layout(bool(divided), widths), bool(dimension)


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
    if not (rows[:, 0] == 3).all() or LONE_SIGN.search(body, end):
        return None
    return coordinates.reshape(vertex_count, 3), rows[:, 1:]


def _read_any(body: bytes, vertex_count: int, face_count: int, layout: _Layout) -> Polygons:
    """By lines where there is one for each vertex and face, else as one stream of words.

    Either way nothing may be left over, so that no count is taken for less than is there.
    """
    lines = [words for line in body.split(b"\n") if (words := line.split())]
    stated = vertex_count + face_count
    if len(lines) == stated + 1 and len(lines[0]) == 1:
        lines = lines[1:]  # the count of edges, on a line of its own
    if len(lines) == stated:
        width = len(lines[0])
        if width in layout.widths and all(len(w) == width for w in lines[:vertex_count]):
            faces = [_face_of_line(k, w) for k, w in enumerate(lines[vertex_count:])]
            words = [word for line in lines[:vertex_count] for word in line]
            return _assemble(_positions(words, vertex_count, width, layout), faces)
    words = [word for line in lines for word in line]
    exact = layout.widths[:1] if layout.widths == (3, 6, 7) else layout.widths
    reasons = []
    # A count of edges behind a line end looks like a coordinate: the one reading fits, or no other.
    for skipped in (0, 1):
        for width in exact:
            try:
                faces = _faces_of_words(words[skipped + width * vertex_count :], face_count)
            except InputError as error:
                reasons.append(str(error))
                continue
            taken = words[skipped : skipped + width * vertex_count]
            return _assemble(_positions(taken, vertex_count, width, layout), faces)
    if len(lines) < stated:
        found = f"vertex {len(lines)} of {vertex_count}"
        if len(lines) >= vertex_count:
            found = f"face {len(lines) - vertex_count} of {face_count}"
        raise InputError(
            f"the file ends after {found}, a line each; it was cut short or its counts are wrong"
        )
    if len(lines) > stated:
        raise InputError(
            f"{len(lines)} lines follow the counts of {vertex_count} vertices and {face_count} "
            f"faces; expected {stated}: the counts are wrong or something was added"
        )
    for k, line in enumerate(lines[:vertex_count]):
        if len(line) not in layout.widths or len(line) != len(lines[0]):
            expected = " or ".join(map(str, layout.widths))
            raise InputError(
                f"vertex {k} is {shown(line)!r}; expected {expected} numbers, as many in each"
            )
    raise InputError(reasons[0])


def _positions(
    words: list[bytes], count: int, width: int, layout: _Layout
) -> NDArray[np.float64]:
    numbers = decimals(words, "a word of the vertices").reshape(count, width)
    return _divided(numbers, layout)


def _divided(numbers: NDArray, layout: _Layout) -> NDArray[np.float64]:
    points = np.asarray(numbers[:, :3], np.float64)
    if not layout.divided:
        return points
    divisor = np.asarray(numbers[:, 3:4], np.float64)
    if not (np.isfinite(divisor) & (divisor != 0)).all():
        raise InputError("the fourth number of a 4OFF vertex is 0 or not finite")
    return points / divisor


def _face_of_line(k: int, words: list[bytes]) -> list[bytes]:
    count = int(whole(words[:1], f"the count of face {k}")[0])
    extra = len(words) - 1 - count
    if count < 1 or extra not in _FACE_COLOURS:
        raise InputError(
            f"face {k} is {shown(words)!r}; expected a count, as many vertex indices, and a colour "
            f"of {', '.join(map(str, _FACE_COLOURS))} numbers"
        )
    decimals(words[1 + count :], f"a colour of face {k}")
    return words[1 : 1 + count]


def _faces_of_words(words: list[bytes], face_count: int) -> list[list[bytes]]:
    """Faces one behind the other, without colours."""
    faces = []
    at = 0
    for k in range(face_count):
        if at >= len(words):
            raise InputError(f"the file ends after face {k} of {face_count}; it was cut short")
        count = int(whole(words[at : at + 1], f"the count of face {k}")[0])
        if count < 1 or at + 1 + count > len(words):
            raise InputError(
                f"face {k} is {shown(words[at : at + 8])!r}; expected a count and as many vertex "
                f"indices"
            )
        faces.append(words[at + 1 : at + 1 + count])
        at += 1 + count
    if at != len(words):
        raise InputError(f"{len(words) - at} words follow the last of {face_count} faces")
    return faces


def _assemble(vertices: NDArray[np.float64], faces: list[list[bytes]]) -> Polygons:
    sizes = np.array([len(face) for face in faces], np.int64)
    words = [word for face in faces for word in face]
    return Polygons.of_faces(vertices, whole(words, "a vertex index"), sizes)


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
