"""Names are text: what a table's own format would read as a sign is written so that it does not.

Names of classes, models, options and data come from users. LaTeX has its own in ``latex.escape``,
the page escapes by itself, and in figures no text is read as mathematics (``figures``).
"""

from __future__ import annotations

import re

_MARKDOWN = re.compile(r"[\\|`*$<\[\]]|(?<![^\W_])_|_(?![^\W_])|~~|&(?=#?\w+;)")
"""Signs of GitHub's Markdown; "_" within a word is none, and brackets only where a link follows."""
_FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""With what spreadsheets take a cell for a formula."""


_UNSEEN = re.compile(
    r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)
"""Signs that show nothing and change what is beside them: controls, marks of another direction of
writing, halves of a character."""


def visible(text: str) -> str:
    """With signs that show nothing by their code points: no name poses as another."""
    return _UNSEEN.sub(lambda match: f"[U+{ord(match[0]):04X}]", text)


def markdown(text: str) -> str:
    """As a cell or a heading of a Markdown table, on one line."""
    return _MARKDOWN.sub(_escaped, visible(" ".join(text.split())))


def _escaped(match: re.Match[str]) -> str:
    sign = match[0]
    if sign in "[]" and not re.search(r"\]\s*[\[(:]", match.string):
        return sign
    if sign == "<":
        return "&lt;"
    return "&amp;" if sign == "&" else "".join("\\" + each for each in sign)


def csv_cell(text: str) -> str:
    """As a cell of a CSV file that a spreadsheet shows instead of running."""
    return f"'{visible(text)}" if text.startswith(_FORMULA) else visible(text)
