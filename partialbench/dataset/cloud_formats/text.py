"""Tables in text: XYZ, TXT, CSV, PTS in the dialects that people write them in.

Read is what can be read one way only. What cannot (decimal commas, a column that may be a number of
the point, names other than x, y, z) is refused in words.
"""

from __future__ import annotations

import codecs
import re
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.cloud_formats.points import (
    NORMALS,
    WIDEST,
    XYZ,
    Points,
    of_rows,
    of_table,
)
from partialbench.errors import InputError

SUFFIXES = (".txt", ".csv", ".pts", ".xyz")
"""Of the files that are read so."""

NUMBER = re.compile(
    r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|[+-]?(?:nan|inf|infinity)", re.ASCII | re.IGNORECASE
)
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?", re.ASCII)
_ZERO_AHEAD = re.compile(r"(?:^|,)[ \t]*(?:[+-]?0\d+|-0)[ \t]*(?:,|$)", re.ASCII)
# NumPy takes these for white space.
_NO_TEXT = re.compile(r"[\0-\x08\x0b-\x1f\x7f-\xa0\u1680\u2000-\u200f\u2028-\u202f\u205f\u3000]")
_COMMENT = ("#", "//", "%")
_HEADER_LINES = 20
"""So many lines without numbers may stand above the table."""
_AXES = {
    name: axis
    for axis, others in (("x", "0"), ("y", "1"), ("z", "2"))
    for name in (axis, f"pos_{axis}", f"position_{axis}", f"points:{others}", f"points_{others}")
}
_NAMES = {**_AXES, **{name: triple[0][0] + axis for triple in NORMALS for name, axis in
                      zip(triple, XYZ, strict=True)}}  # fmt: skip


class _Line(NamedTuple):
    number: int
    text: str


def read_text(content: bytes) -> Points:
    """A point a line, three numbers or more in it.

    White space, commas or semicolons are between the numbers, one of them throughout; an even
    comment (#, //, %), lines without numbers above the table, a count of the points ahead of it
    and a byte order mark (UTF-8, UTF-16) are understood. Where a header names the columns, the
    names say which are x, y, z; without one they are the first three.

    Raises:
        InputError: with the line, the value and what was expected.
    """
    lines, named = _table_lines(decode(content))
    if not lines:
        raise InputError("has no line of numbers; expected three or more in each")
    lines, count = _without_count(lines)
    separator = _separator(lines)
    header, lines = _header(lines, separator)
    if not lines:
        raise InputError(f"has no point, only {header[-1].text.strip()[:60]!r}")
    if count is not None and count != len(lines):
        raise InputError(f"says {count} points in its first line, {len(lines)} follow it")
    table = _numbers(lines, separator)
    names = _column_names(named, header, table.shape[1], separator)
    if names:
        return _of_names(table, names)
    if table.shape[1] > WIDEST:
        return of_table(table)
    return of_rows(table)


def decode(content: bytes) -> str:
    """The text of a file: UTF-8 or UTF-16, by its mark or its zero bytes; else Latin-1.

    In Latin-1 every byte is a letter: names and comments may then be misspelled, numbers cannot be.
    """
    if content.startswith((codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE)):
        raise InputError("is UTF-32; save it as UTF-8")
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return content.decode("utf-16")
    if b"\0" in content:
        for name, zeros in (("utf-16-le", content[1::2]), ("utf-16-be", content[::2])):
            if zeros.count(0) == len(zeros):
                return content.decode(name)
        raise InputError("has zero bytes: it is no text")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def looks_like_points(start: bytes) -> bool:
    """Whether a file that begins so may be a table of points, by its first line of numbers."""
    try:
        lines, _ = _table_lines(decode(start))
    except (InputError, UnicodeDecodeError):
        return False
    if not start.endswith((b"\n", b"\r")) and len(lines) > 1:
        lines = lines[:-1]  # the start may end within a line
    for line in lines[: _HEADER_LINES + 2]:
        cells = re.split(r"[\s,;]+", line.text.strip(" \t,;"))
        if len(cells) >= 3 and all(map(NUMBER.fullmatch, cells)):
            return True
    return False


def _table_lines(text: str) -> tuple[list[_Line], list[_Line]]:
    """The lines with something in them; and the comments above the first of them."""
    lines: list[_Line] = []
    comments: list[_Line] = []
    raw = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    for number, line in enumerate(raw, 1):
        bare = line.strip(" \t")
        if bare.startswith(_COMMENT):
            if not lines:
                comments.append(_Line(number, bare.lstrip("#/% \t")))
            continue
        if "#" in bare:  # a comment behind numbers, not a sign within one
            bare = re.split(r"[ \t]#", bare, maxsplit=1)[0].rstrip(" \t")
        if bare:
            lines.append(_Line(number, bare))
    return lines, comments


def _without_count(lines: list[_Line]) -> tuple[list[_Line], int | None]:
    """The lines behind a count of the points (PTS), or behind it and a line of prose (XYZ)."""
    first = lines[0].text
    if not (first.isascii() and first.isdecimal() and len(lines) > 1):
        return lines, None
    count, rest = int(first), lines[1:]
    # The second line of an XYZ file is free text; it may be empty, and is then not among these.
    if len(rest) == count + 1 and not (_is_row(rest[0].text) or _axes(rest[0].text)):
        rest = rest[1:]
    return rest, count


def _is_row(text: str) -> bool:
    cells = re.split(r"[\s,;]+", text.strip(" \t,;"))
    return len(cells) >= 3 and all(map(NUMBER.fullmatch, cells))


def _separator(lines: list[_Line]) -> str:
    """ ";", ",", or "" for white space: what stands between the cells of every line."""
    # Of a header's prose the commas say nothing.
    rows = [line for line in lines if re.match(r"[+-]?[.\d]|[+-]?(?:nan|inf)", line.text, re.I)]
    body = rows or lines
    for sign in ";", ",":
        with_it = sum(sign in line.text for line in body)
        if with_it == 0:
            continue
        if with_it < len(body):
            odd = next(line for line in body if (sign in line.text) != (sign in body[0].text))
            raise InputError(
                f"line {odd.number} is {odd.text[:60]!r}, another has {sign!r}: expected one "
                f"separator throughout"
            )
        for line in body:
            _refuse_decimal_commas(line, sign)
        return sign
    return ""


def _refuse_decimal_commas(line: _Line, separator: str) -> None:
    cells = re.split(r"[;\s]+", line.text.strip(" \t;"))
    decimals = len(cells) > 1 and any(map(_DECIMAL_COMMA.fullmatch, cells))
    # "0,05,0,97": a whole number is not written with a zero ahead, the places behind a comma are.
    if decimals or (separator == "," and _ZERO_AHEAD.search(line.text)):
        raise InputError(
            f"line {line.number} is {line.text[:60]!r}: a comma may be a decimal point or stand "
            f"between two numbers; write decimal points"
        )


def _cells(text: str, separator: str) -> list[str]:
    if not separator:
        return text.split()
    cells = [cell.strip() for cell in text.split(separator)]
    # A separator behind the last number closes the line.
    return cells[:-1] if len(cells) > 1 and not cells[-1] else cells


def _header(lines: list[_Line], separator: str) -> tuple[list[_Line], list[_Line]]:
    """Lines above the table that are no numbers at all, and the table."""
    at = 0
    while at < min(len(lines), _HEADER_LINES):
        cells = _cells(lines[at].text, separator)
        numbers = [cell for cell in cells if NUMBER.fullmatch(cell)]
        # A header may call a column "inf"; a row of nothing but those is one.
        if len(numbers) == len(cells) or any(re.search(r"\d", cell) for cell in numbers):
            break
        at += 1
    return lines[:at], lines[at:]


def _numbers(lines: list[_Line], separator: str) -> NDArray[np.float64]:
    """The table, (n,c) float64."""
    closed = bool(separator) and all(line.text.endswith(separator) for line in lines)
    texts = [line.text[:-1] if closed else line.text for line in lines]
    if odd := _NO_TEXT.search("\n".join(texts)):
        raise InputError(f"has the sign {odd[0]!r} among its numbers: it is damaged, or no text")
    try:
        return np.loadtxt(texts, ndmin=2, delimiter=separator or None, comments=None)
    except ValueError:
        _say_what_is_wrong(lines, separator)
        raise


def _say_what_is_wrong(lines: list[_Line], separator: str) -> None:
    columns = len(_cells(lines[0].text, separator))
    for line in lines:
        cells = _cells(line.text, separator)
        for cell in cells:
            if not cell:
                raise InputError(
                    f"line {line.number}: a cell is empty; expected a number between any two "
                    f"separators ({separator})"
                )
            if not NUMBER.fullmatch(cell):
                symbol = cell.isalpha() and cell is cells[0] and len(cell) <= 2
                chemical = " (symbols of atoms: a molecule is no surface)" if symbol else ""
                raise InputError(
                    f"line {line.number} is {line.text[:60]!r}: {cell[:20]!r} is no number"
                    f"{chemical}; expected numbers between {separator or 'blanks'!r}"
                )
        if len(cells) != columns:
            raise InputError(
                f"line {line.number} has {len(cells)} numbers, line {lines[0].number} has {columns}"
            )


def _names_in(text: str) -> list[str]:
    """The words of a header in small letters, without quotes and units: "X [m]" is x.

    A column without a name, as pandas writes the numbers of rows (",x,y,z"), keeps its place.
    """
    bare = re.sub(r"\s*[(\[][^)\]]*[)\]]", "", text).strip()
    words = re.split(r"\s*[,;]\s*|\s+", bare)
    return [word.strip("\"'").lower() for word in (words if words[-1] else words[:-1])]


def _axes(text: str) -> list[str]:
    """Which axis each word of a header names, "" for other words; [] if one of x, y, z lacks."""
    axes = [_AXES.get(name, "") for name in _names_in(text)]
    return axes if all(axis in axes for axis in XYZ) else []


def _column_names(
    comments: list[_Line], header: list[_Line], columns: int, separator: str
) -> list[str]:
    """The names that the nearest header or comment above the table gives its columns; else [].

    Raises:
        InputError: a header that names other columns than the table has, or no x, y and z.
    """
    for line in reversed([*comments, *header]):
        axes = _axes(line.text)
        if len(axes) == columns:
            if any(axes.count(axis) > 1 for axis in XYZ):
                raise InputError(f"line {line.number} names two columns the same: {line.text!r}")
            return [_NAMES.get(name, name) for name in _names_in(line.text)]
        wrong = axes[:3] != list(XYZ) if line in header else not _may_be_prose(line, columns)
        if axes and wrong:
            raise InputError(
                f"line {line.number} names {len(axes)} columns ({line.text.strip()[:60]}), the "
                f"table has {columns}"
            )
    for line in (header or comments)[-1:]:
        cells = _cells(line.text, separator)
        # In a comment, or where they are not as many, words between blanks may be prose.
        names = len(cells) == columns and line in header
        listed = (
            separator in line.text and all(map(str.isidentifier, cells)) if separator else False
        )
        if (names or listed) and not _axes(line.text):
            raise InputError(
                f"line {line.number} names the columns {', '.join(cells)[:80]}; expected x, y and "
                f"z among them, a name for each of the {columns} columns"
            )
    return []


def _may_be_prose(comment: _Line, columns: int) -> bool:
    """Whether a comment that has the words x, y and z may say something else than the columns.

    It does not where they stand together in another order, or have other columns' names ahead.
    """
    axes = _axes(comment.text)
    at = next((i for i in range(len(axes) - 2) if {*axes[i : i + 3]} == {*XYZ}), None)
    if at is None:
        return True  # "x right, y down, z forward"
    ahead = at > 0 and columns > 3 and not _names_in(comment.text)[at - 1].endswith(":")
    return axes[at : at + 3] == list(XYZ) and not ahead


def _of_names(table: NDArray[np.float64], names: list[str]) -> Points:
    points = table[:, [names.index(axis) for axis in XYZ]]
    triple = [f"n{axis}" for axis in XYZ]
    if all(names.count(name) == 1 for name in triple):
        return Points(points, table[:, [names.index(name) for name in triple]], named=True)
    return Points(points)
