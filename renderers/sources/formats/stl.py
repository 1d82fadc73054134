"""STL, ASCII and binary, told apart by the file's length and not by the word it begins with.

Own, because the libraries that were tried (trimesh, numpy-stl, meshio) give no triangles, or fewer,
for a file whose count and length disagree, and say nothing; numpy-stl reads the first of several
solids only.
"""

from __future__ import annotations

import re

import numpy as np

from partialbench.errors import InputError
from renderers.sources.formats.polygons import Polygons
from renderers.sources.formats.text import decimals, shown, unix_lines

_HEADER, _RECORD = 84, 50
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_COMMENT = re.compile(rb"^[ \t]*[;#].*$", re.MULTILINE)
_NO_NUMBER = re.compile(rb"[+-]?1\.#(?:qnan|snan|ind|inf)\w*(?:[+-]\d+)?")
"""How old Windows programs write NaN and infinity, here in small letters."""
_SOLID = re.compile(rb"solid(?!\S)[^\n]*")
"""From the word to the line's end: a solid's name may be anything."""
_FACET = b"facet normal 0 0 0 outer loop vertex 0 0 0 vertex 0 0 0 vertex 0 0 0 endloop endfacet"
_WORDS = _FACET.split()
_KEYWORDS = [k for k, word in enumerate(_WORDS) if word != b"0"]
_COORDINATES = [k for k, word in enumerate(_WORDS) if word == b"0"][3:]
_NORMAL = [2, 3, 4]


def read_stl(content: bytes) -> Polygons:
    """The triangles of an STL file, three vertices each; normals and attributes are left aside.

    Binary if its count gives its length, whatever it begins with: 84 bytes and 50 a triangle.
    ASCII files may hold several solids, whose triangles are joined; each must be ended.

    Raises:
        InputError: count and length disagree, the text was cut short or holds anything but facets.
    """
    length = len(content)
    stated = int.from_bytes(content[80:84], "little") if length >= _HEADER else -1
    if stated >= 0 and length == _HEADER + _RECORD * stated:
        if not stated:
            raise InputError("its header counts 0 triangles")
        triangles = np.frombuffer(content, _TRIANGLE, stated, _HEADER)["corners"]
    elif _looks_like_text(content):
        triangles = _read_ascii(content)
    elif length < _HEADER:
        raise InputError(
            f"has {length} bytes; a binary STL has {_HEADER} before its first triangle, an ASCII "
            f"one begins with the word solid"
        )
    else:
        held, left = divmod(length - _HEADER, _RECORD)
        raise InputError(
            f"the binary STL counts {stated} triangles, which is {_HEADER + _RECORD * stated} "
            f"bytes, but has {length} bytes: {held} triangles"
            + (f" and {left} bytes" if left else "")
            + "; it was cut short, something was added, or the count is wrong"
        )
    corners = np.asarray(triangles, np.float64).reshape(-1, 3)
    return Polygons.of_triangles(corners, np.arange(len(corners)))


def _looks_like_text(content: bytes) -> bool:
    # A binary file's first 80 bytes are free, and often say solid; zeros come soon behind them.
    start = content[:1000]
    return b"\0" not in start and bool(re.search(rb"\b(?:solid|facet)\b", start, re.IGNORECASE))


def _read_ascii(content: bytes) -> np.ndarray:
    text = unix_lines(content).lower()
    if b";" in text or b"#" in text:
        text = _COMMENT.sub(b"", text)
    opened = closed = at = 0
    between = []
    for found in _SOLID.finditer(text):
        start = text.rfind(b"\n", 0, found.start()) + 1
        before = text[start : found.start()].strip()
        opened, closed = opened + (before == b""), closed + (before == b"end")
        between.append(text[at : found.start() - len(before)])
        at = found.end()
    if opened != closed or 2 * opened != len(between):
        raise InputError(
            f"the ASCII STL begins {opened} solids and ends {closed}; it was cut short or is "
            f"damaged"
        )
    words = b"".join([*between, text[at:]]).split()
    size = len(_WORDS)
    if not words:
        raise InputError("the ASCII STL has no facets")
    count, left = divmod(len(words), size)
    if left or any(set(words[k::size]) != {_WORDS[k]} for k in _KEYWORDS):
        raise InputError(_first_wrong(words))
    for k in _NORMAL:
        normals = words[k::size]
        if b"#" in text:
            normals = [b"nan" if _NO_NUMBER.fullmatch(word) else word for word in normals]
        decimals(normals, "a normal's component")  # NaN is often there
    numbers = [decimals(words[k::size], "a coordinate") for k in _COORDINATES]
    return np.stack(numbers, axis=1).reshape(count, 3, 3)


def _first_wrong(words: list[bytes]) -> str:
    """Where words stop being facets of three vertices."""
    size = len(_WORDS)
    for start in range(0, len(words), size):
        facet = words[start : start + size]
        if len(facet) < size or any(facet[k] != _WORDS[k] for k in _KEYWORDS):
            return (
                f"facet {start // size} of the ASCII STL is {shown(facet)!r} …; expected facet "
                f"normal, outer loop, three vertices, endloop, endfacet: cut short or damaged"
            )
    return "the ASCII STL is no sequence of facets"
