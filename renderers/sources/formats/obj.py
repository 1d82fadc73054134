"""Wavefront OBJ: vertices and polygons; what else a file holds is left out or refused by name.

Source: "Object Files (.obj)", Wavefront's Advanced Visualizer manual, appendix B1. Own, because no
library that was tried reads these files strictly: trimesh drops lines with a tab and resolves
relative indices at the file's end; meshio ignores relative indices; tinyobjloader knows no
continued line and takes "x" for 0 and "1.5" for vertex 1.
"""

from __future__ import annotations

import re

import numpy as np

from partialbench.errors import InputError
from renderers.sources.formats.polygons import Polygons
from renderers.sources.formats.text import decimals, shown, unix_lines, whole

_COMMENT = re.compile(rb"#[^\n]*")
_CONTINUED = re.compile(rb"^[ \t]*(?:v[tnp]?|fo?|l|p)\b[^\n\\]*(?:\\\n[^\n\\]*)+", re.MULTILINE)
_CORNER = re.compile(rb"([+-]?[0-9]+)(?:/[+-]?[0-9]*){0,2}")
_CORNERS = re.compile(rb"(?:[+-]?[0-9]+(?:/[+-]?[0-9]*){0,2} )*")
_DATA_ONLY = frozenset(
    b"vt vn vp g o s mg usemtl mtllib usemap maplib lod bevel c_interp d_interp shadow_obj "
    b"trace_obj ctech stech".split()
)
"""Keywords that bear on no position."""
_NO_SURFACE = {b"p": "points", b"l": "lines"}
_FREE_FORM = (
    b"curv curv2 surf cstype deg bmat step parm trim hole scrv sp end con res cdc cdp bzp bsp"
)
_REFUSED = {
    **dict.fromkeys(_FREE_FORM.split(), "free-form curves and surfaces"),
    b"call": "a call of another file",
    b"csh": "a command",
}


def read_obj(content: bytes) -> Polygons:
    """The polygons of an OBJ file.

    Blanks and tabs separate alike; a line that ends with a backslash goes on in the next; a
    negative index counts back from the last vertex before its face. Normals, texture coordinates,
    groups and materials are left aside (no .mtl is needed), so is what follows a vertex's three
    coordinates (a weight or a colour). Points and lines are left out, and the notices say so.

    Raises:
        InputError: a keyword that OBJ does not have, a word that is no number, index 0, an index
            past the vertices, a face of fewer than three corners, free-form surfaces, no face.
    """
    text = unix_lines(content)
    if b"\\" in text:
        # Comments first: one that ends with a backslash does not swallow the next line.
        text = _CONTINUED.sub(lambda m: m[0].replace(b"\\\n", b" "), _COMMENT.sub(b"", text))
    coordinates: list[bytes] = []
    besides: list[bytes] = []
    corners: list[bytes] = []
    sizes: list[int] = []
    before: list[int] = []  # vertices when a face stands
    left_out: dict[str, int] = {}
    comments = b"#" in text
    for number, line in enumerate(text.split(b"\n"), 1):
        if comments:
            line = line.partition(b"#")[0]
        words = line.split()
        if not words:
            continue
        keyword = words[0]
        if keyword == b"v":
            if len(words) < 4:
                raise InputError(f"line {number} is {shown(words)!r}; expected three coordinates")
            coordinates += words[1:4]
            if len(words) > 4:
                besides += words[4:]
        elif keyword in (b"f", b"fo"):
            if len(words) < 4:
                raise InputError(f"line {number} is {shown(words)!r}; expected three corners")
            corners += words[1:]
            sizes.append(len(words) - 1)
            before.append(len(coordinates) // 3)
        elif keyword in _NO_SURFACE:
            kind = _NO_SURFACE[keyword]
            left_out[kind] = left_out.get(kind, 0) + 1
        elif keyword in _REFUSED:
            raise InputError(
                f"line {number} is {shown(words)!r}: {_REFUSED[keyword]} of an OBJ are not read; "
                f"export polygons"
            )
        elif keyword not in _DATA_ONLY:
            raise InputError(
                f"line {number} is {shown(words)!r}; OBJ has no keyword {shown([keyword])[:20]!r}"
            )
    if not sizes:
        raise InputError("has no faces; expected a mesh, not points or lines")
    decimals(besides, "a word behind a vertex's coordinates")
    vertices = decimals(coordinates, "a coordinate").reshape(-1, 3)
    notices = tuple(f"{n} {kind} are no surface and were left out" for kind, n in left_out.items())
    counts = np.array(sizes, np.int64)
    indices = _indices(corners, np.repeat(np.array(before, np.int64), counts))
    return Polygons(vertices, indices, counts, notices)


def _indices(corners: list[bytes], before: np.ndarray) -> np.ndarray:
    """From corners such as 7, -1 or 7/2/3 to vertices counted from 0."""
    joined = b" ".join(corners) + b" "
    if b"/" in joined:
        if not _CORNERS.fullmatch(joined):
            wrong = next(word for word in corners if not _CORNER.fullmatch(word))
            raise InputError(
                f"a face has the corner {shown([wrong])!r}; expected vertex/texture/normal indices"
            )
        corners = [word.partition(b"/")[0] for word in corners]
    given = whole(corners, "a corner of a face")
    if (given == 0).any():
        raise InputError("a face names vertex 0; OBJ counts vertices from 1, or back from -1")
    indices = np.where(given > 0, given - 1, before + given)
    if (indices < 0).any():
        k = int(np.flatnonzero(indices < 0)[0])
        raise InputError(
            f"a face names vertex {given[k]}, but only {before[k]} vertices stand before it"
        )
    return indices
