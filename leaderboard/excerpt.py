"""Tables of the board in another document: some columns of a section, kept in step with it.

    python -m leaderboard.excerpt README.md docs/board/leaderboard.md

The document marks where, and its own header row says which columns::

    <!-- leaderboard: pm40-clouds, partial, board -->
    | model | accuracy | 95 % interval |
    …
    <!-- end -->

``; without recipe`` after the section's title leaves out the rows that were trained by a recipe of
their own, which their names say in brackets.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from leaderboard.tables.plain import markdown
from partialbench.errors import InputError

WITHOUT_RECIPE = "; without recipe"

_BLOCK = re.compile(r"(<!-- leaderboard: (.*?) -->\n)(.*?)(<!-- end -->)", re.S)
_RECIPE = re.compile(r"\[(?:.*; )?recipe .*\]$")


def fill(document: str, board: str) -> str:
    """The document with every marked table made anew from the board's (both Markdown).

    Raises:
        InputError: the board has no such section, or its table no such column.
    """
    sections = {part.split("\n", 1)[0]: part for part in board.split("\n## ")}

    def table(match: re.Match[str]) -> str:
        begin, title, old, end = match.groups()
        one_recipe = title.endswith(WITHOUT_RECIPE)
        title = title.removesuffix(WITHOUT_RECIPE)
        if markdown(title) not in sections:
            raise InputError(f"the board has no section {title!r}, but {', '.join(sections)}")
        lines = [
            _cells(line) for line in sections[markdown(title)].splitlines() if line.startswith("|")
        ]
        wanted = _cells(old.split("\n", 1)[0])
        missing = [name for name in wanted if name not in lines[0]]
        if missing:
            raise InputError(f"{title}: no column {missing[0]!r}, but {', '.join(lines[0])}")
        if one_recipe:
            model = lines[0].index("model")
            lines = [line for line in lines if not _RECIPE.search(line[model])]
        columns = [lines[0].index(name) for name in wanted]
        chosen = [[cells[c] for c in columns] for cells in lines]
        chosen[1] = ["---"] * len(columns)
        return begin + "".join(f"| {' | '.join(cells)} |\n" for cells in chosen) + end

    return _BLOCK.sub(table, document)


def _cells(line: str) -> list[str]:
    """Cells as they are written; a "|" within one is escaped."""
    return [cell.strip() for cell in re.split(r"(?<!\\)\|", line.strip())[1:-1]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("document", type=Path, help="Markdown with marked tables, changed in place")
    parser.add_argument("board", type=Path, help="the board's leaderboard.md")
    files = parser.parse_args()
    files.document.write_text(fill(files.document.read_text(), files.board.read_text()))


if __name__ == "__main__":
    main()
