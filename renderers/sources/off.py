"""A fast reader of OFF files as they are found: fused headers, CRLF, comments, n-gons, colours."""

from __future__ import annotations

import re
from itertools import pairwise
from os import PathLike
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from partialbench.errors import InputError

_COMMENT = re.compile(rb"#[^\r\n]*")
_HEADER = re.compile(rb"\s*(\S*?OFF)\s*(\S+)\s+(\S+)(?:[ \t]+(\S+))?")


def read_off(source: bytes | str | PathLike[str], name: str = "") -> trimesh.Trimesh:
    """A mesh from an OFF file, as the file has it: nothing merged, nothing dropped.

    Takes ``OFF`` on a line of its own or fused with the counts (``OFF3514 3546 0``), with or
    without the count of edges; LF, CRLF or CR; comments; polygons of three and more corners (cut
    into fans); colours after a face's or a vertex's numbers, which are left out.

    Args:
        source: the file's content or its path.
        name: what errors call the file; the path where it was given one.

    Returns:
        Vertices (V,3) float64 in the file's units, faces (F,3) int64.

    Raises:
        InputError: the file is empty, cut short, not OFF, without faces, has a face of fewer than
            three corners or one that names a vertex the file does not have, or has a coordinate
            that is no finite number.
    """
    if isinstance(source, bytes):
        content, name = source, name or "OFF data"
    else:
        name = name or str(source)
        try:
            content = Path(source).read_bytes()
        except OSError as error:
            raise InputError(f"{name}: cannot be read ({error.strerror})") from error
    if not content.strip():
        raise InputError(f"{name}: the file is empty; expected an OFF mesh")
    if b"#" in content:
        content = _COMMENT.sub(b"", content)
    if b"\r" in content:
        content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    vertex_count, face_count, body = _header(content, name)
    parsed = _read_regular(body, vertex_count, face_count)
    vertices, faces = parsed or _read_by_line(body, vertex_count, face_count, name)
    check(vertices, faces, name)
    return trimesh.Trimesh(vertices, faces, process=False, validate=False)


def _header(content: bytes, name: str) -> tuple[int, int, bytes]:
    """The counts of vertices and faces, and what follows them."""
    match = _HEADER.match(content)
    if match is None or match[1] != b"OFF":
        first = content.split(maxsplit=1)[0][:20].decode("ascii", "replace")
        raise InputError(f"{name}: begins with {first!r}; expected OFF and the counts")
    try:
        vertex_count, face_count = int(match[2]), int(match[3])
    except ValueError:
        counts = b" ".join(match.group(2, 3)).decode("ascii", "replace")
        raise InputError(f"{name}: the counts are {counts!r}; expected whole numbers") from None
    if vertex_count < 1 or face_count < 1:
        raise InputError(
            f"{name}: has {vertex_count} vertices and {face_count} faces; expected at least one "
            f"face"
        )
    return vertex_count, face_count, content[match.end() :]


def _read_regular(
    body: bytes, vertex_count: int, face_count: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]] | None:
    """Vertices and faces where all rows are three numbers, then all a 3 and three indices.

    That is every ModelNet file; ``None`` for any other, which the reader by line takes.
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
    if not (rows[:, 0] == 3).all():
        return None
    return coordinates.reshape(vertex_count, 3), rows[:, 1:]


def _read_by_line(
    body: bytes, vertex_count: int, face_count: int, name: str
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """One vertex or face per line that is not blank, what follows its own numbers left out."""
    rows = [row for line in body.split(b"\n") if (row := line.split())]
    if len(rows) < vertex_count + face_count:
        found = f"vertex {len(rows)} of {vertex_count}"
        if len(rows) >= vertex_count:
            found = f"face {len(rows) - vertex_count} of {face_count}"
        raise InputError(f"{name}: the file ends after {found}; it was cut short")
    vertices = np.zeros((vertex_count, 3))
    for k, row in enumerate(rows[:vertex_count]):
        try:
            x, y, z = (float(token) for token in row[:3])
        except ValueError:
            raise InputError(
                f"{name}: vertex {k} is {_text(row)!r}; expected three numbers"
            ) from None
        vertices[k] = x, y, z
    triangles: list[tuple[int, int, int]] = []
    for k, row in enumerate(rows[vertex_count : vertex_count + face_count]):
        try:
            count = int(row[0])
            corners = [int(token) for token in row[1 : 1 + count]]
        except ValueError:
            count, corners = 0, []
        if count < 3 or len(corners) != count:
            raise InputError(
                f"{name}: face {k} is {_text(row)!r}; expected a count of at least 3 and as many "
                f"vertex indices"
            )
        triangles += [(corners[0], b, c) for b, c in pairwise(corners[1:])]
    try:
        return vertices, np.array(triangles, np.int64)
    except OverflowError:
        raise InputError(f"{name}: a vertex index does not fit 64 bits") from None


def check(vertices: NDArray[np.float64], faces: NDArray[np.int64], name: str) -> None:
    """Raise ``InputError`` for a vertex that is no point or a face that names none."""
    finite = np.isfinite(vertices)
    if not finite.all():
        k = int(np.flatnonzero(~finite.all(axis=1))[0])
        raise InputError(f"{name}: vertex {k} is {vertices[k].tolist()}; expected finite numbers")
    outside = (faces < 0) | (faces >= len(vertices))
    if outside.any():
        raise InputError(
            f"{name}: a face names vertex {faces[outside][0]}; the file's vertices are 0 to "
            f"{len(vertices) - 1}"
        )


def _text(row: list[bytes]) -> str:
    return b" ".join(row[:8]).decode("ascii", "replace")
