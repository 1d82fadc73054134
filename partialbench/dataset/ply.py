"""What a PLY file's header promises, and what follows it held against that.

The header decides whether a file is a mesh or a cloud, so it is read whole, however long its
comments are, and nothing behind it is.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from partialbench.errors import InputError

FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")
TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
"""A property's type → NumPy's name for it without the byte order."""

# The line end behind the last word belongs to the header; which of the three it is, the first says.
_END = re.compile(rb"(?:^|[\r\n])[ \t]*end_header[ \t]*(\r\n|\r|\n|\Z)")
_FIRST = re.compile(rb"ply[ \t]*(\r\n|\r|\n)")


@dataclass(frozen=True)
class PlyProperty:
    """One property: its name and type, and the type of a list's length ("" where it is no list)."""

    name: str
    dtype: str
    length_dtype: str = ""


@dataclass(frozen=True)
class PlyElement:
    """One kind of row: how many there are, and what each holds."""

    name: str
    count: int
    properties: tuple[PlyProperty, ...]


@dataclass(frozen=True)
class PlyHeader:
    """A whole header.

    Attributes:
        encoding: one of ``FORMATS``.
        elements: in the order of the file.
        size: bytes up to the first of the data.
    """

    encoding: str
    elements: tuple[PlyElement, ...]
    size: int

    def count(self, element: str) -> int:
        """How many rows of an element there are; 0 for one that the file does not have."""
        return sum(e.count for e in self.elements if e.name == element)

    @property
    def is_mesh(self) -> bool:
        """Whether there are faces (or strips of triangles); ``element face 0`` is a cloud's."""
        return self.count("face") > 0 or self.count("tristrips") > 0


def header_is_whole(content: bytes) -> bool:
    """Whether these first bytes of a file reach the header's end; if not, read more and ask again.

    True too for what does not begin as PLY does: no more bytes would mend that.
    """
    return not content.startswith(b"ply"[: len(content)]) or bool(_END.search(content))


def parse_header(content: bytes) -> PlyHeader:
    """The header of a PLY file from its first bytes, or from all of them.

    Lines end with LF, CRLF or CR, as the first one does.

    Raises:
        InputError: it does not begin as PLY does, has no end, or a line of it says nothing.
    """
    first = _FIRST.match(content)
    if first is None:
        start = content[:20].decode("ascii", "backslashreplace")
        raise InputError(f"begins with {start!r}; expected a line that says ply")
    end = _END.search(content)
    if end is None:
        raise InputError("the PLY header has no line end_header")
    # With lines ended by CR, a byte 10 behind the header is the first of the data.
    newline = first[1]
    after = end.start(1) + (len(newline) if end[1].startswith(newline) else len(end[1]))
    encoding = ""
    elements: list[tuple[str, int, list[PlyProperty]]] = []
    for raw in re.split(rb"\r\n|\r|\n", content[: end.start()])[1:]:
        # Split as bytes: in a text, a byte 160 would be a blank.
        words = [word.decode("latin-1") for word in raw.split()]
        match words:
            case [] | ["comment", *_] | ["obj_info", *_]:
                pass
            case ["format", word, "1.0"] if word in FORMATS and not encoding:
                encoding = word
            case ["element", name, count] if count.isascii() and count.isdecimal():
                if any(name == other for other, _, _ in elements):
                    raise InputError(f"the PLY header has the element {name!r} twice")
                elements.append((name, int(count), []))
            case ["property", "list", length, word, name] if (
                elements and word in TYPES and TYPES.get(length, "f")[0] != "f"
            ):
                elements[-1][2].append(PlyProperty(name, TYPES[word], TYPES[length]))
            case ["property", word, name] if elements and word in TYPES:
                elements[-1][2].append(PlyProperty(name, TYPES[word]))
            case _:
                raise InputError(
                    f"the PLY header has the line {' '.join(words)[:60]!r}, which is no PLY"
                )
    if not encoding:
        raise InputError(f"the PLY header has no line format {' or '.join(FORMATS)} 1.0")
    return PlyHeader(
        encoding, tuple(PlyElement(name, count, tuple(p)) for name, count, p in elements), after
    )


def is_mesh(content: bytes) -> bool:
    """Whether a PLY is a mesh, from its first bytes; ``InputError`` where they hold no header."""
    return parse_header(content).is_mesh


def require_whole(content: bytes) -> None:
    """Raise ``InputError`` where an ASCII PLY ends before all that its header counts.

    trimesh checks the length of binary files only and takes a text cut short for a smaller object.
    What has no whole header passes: its parser says what is wrong with it.
    """
    try:
        header = parse_header(content)
    except InputError:
        return
    if header.encoding != "ascii":
        return
    counted = [element for element in header.elements if element.count]
    expected = sum(element.count for element in counted)
    # One line an element, behind the header's last.
    rows = content[header.size :].splitlines()
    said = " and ".join(f"{element.count} {element.name}" for element in counted)
    if len(rows) < expected:
        raise InputError(
            f"the ASCII PLY was cut short: its header says {said} lines, {len(rows)} follow it"
        )
    if expected and not _has_all(rows[expected - 1].split(), counted[-1].properties):
        raise InputError(
            f"the ASCII PLY was cut short: of its {said} lines the last is "
            f"{rows[expected - 1].decode('ascii', 'replace')!r}"
        )


def _has_all(words: list[bytes], properties: tuple[PlyProperty, ...]) -> bool:
    """Whether a line has a word for each property; a list begins with its length."""
    at = 0
    for each in properties:
        if at >= len(words):
            return False
        at += 1 + (int(words[at]) if each.length_dtype and words[at].isdigit() else 0)
    return at <= len(words)
