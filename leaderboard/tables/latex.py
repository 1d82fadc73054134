"""The board as a LaTeX document that compiles alone, its tables in the paper's style."""

from __future__ import annotations

from leaderboard.board import Column, ranked
from leaderboard.comparison import Comparison
from leaderboard.tables.layouts import Layout
from leaderboard.words import (
    describe,
    duplicates,
    interval,
    model_input,
    percent,
    reported,
    reported_head,
    row_title,
    without_duplicates,
)

_PREAMBLE = r"""
\documentclass{article}
\usepackage[T1]{fontenc}
\usepackage[utf8]{inputenc}
\usepackage[margin=2.5cm]{geometry}
\usepackage{booktabs,graphicx}
\begin{document}
""".strip()
_PAGE = 4
"""Tables before a page break: LaTeX holds only so many floats at once."""


def as_latex(board: list[Column], comparisons: list[Comparison], layouts: list[Layout]) -> str:
    """One booktabs table for each column, then the paper's own tables; pdflatex is enough."""
    tables = [
        *(_column(column, found) for column, found in zip(board, comparisons, strict=True)),
        *(_table(f"{x.title}. {x.about}", x.head, x.rows, (x.best, 1)) for x in layouts),
    ]
    parts = [_PREAMBLE]
    for number, table in enumerate(tables, 1):
        parts.append(table)
        if number % _PAGE == 0:
            parts.append(r"\clearpage")
    return "\n".join([*parts, r"\end{document}", ""])


def _column(column: Column, comparison: Comparison) -> str:
    head = ["Methods", "Input (Size)", "Accuracy (%)", "95 % interval", "Group"]
    repeated = duplicates(column) > 0
    if repeated:
        head.append("Without duplicates")
    if column.reported:
        head.append(reported_head(column))
    rows = []
    for name in ranked(column):
        cell, result = column.cells[name], column.cells[name].results[0]
        rows.append(
            [
                row_title(result),
                model_input(result),
                percent(cell.mean(), cell.std()),
                interval(*comparison.intervals[name]),
                " ".join(map(str, comparison.groups[name])),
                *([without_duplicates(cell)] if repeated else []),
                *([reported(column, result)] if column.reported else []),
            ]
        )
    return _table(f"{column.title}. {describe(column)}", head, rows, (0, 2))


def _table(
    caption: str, head: list[str], rows: list[list[str]], bold: tuple[int | None, int]
) -> str:
    """Plain texts as a table no wider than the column, one entry (row, column) in bold."""
    lines = [[escape(text) for text in row] for row in rows]
    for line in lines:
        # After a row's end LaTeX would take these for an argument of it.
        if line[0][:1] in ("[", "*"):
            line[0] = "{}" + line[0]
    if bold[0] is not None:
        lines[bold[0]][bold[1]] = rf"\textbf{{{lines[bold[0]][bold[1]]}}}"
    return "\n".join(
        [
            r"\begin{table}[t]",
            rf"\caption{{{escape(caption)}}}",
            r"\centering",
            # Narrowed to fit, never widened.
            r"\resizebox{\ifdim\width>\columnwidth\columnwidth\else\width\fi}{!}{",
            rf"\begin{{tabular}}{{l{'c' * (len(head) - 1)}}}",
            r"\toprule",
            " & ".join(escape(text) for text in head) + r" \\",
            r"\midrule",
            *(" & ".join(line) + r" \\" for line in lines),
            r"\bottomrule",
            r"\end{tabular}}",
            r"\end{table}",
        ]
    )


_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
    "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "<": r"\textless{}", ">": r"\textgreater{}", "\"": "''", "×": r"$\times$",
    "→": r"$\rightarrow$", "–": "--", "±": r"$\pm$", "²": r"$^2$", "³": r"$^3$", "δ": r"$\delta$",
    "ρ": r"$\rho$", "τ": r"$\tau$", "°": r"$^\circ$", "−": r"$-$", "…": r"\dots{}",
}  # fmt: skip


def escape(text: str) -> str:
    """Text with what LaTeX would misread replaced; what it has no letter for, by its code point."""
    return "".join(map(_escaped, text))


def _escaped(character: str) -> str:
    if character in _LATEX:
        return _LATEX[character]
    # T1 has the letters of European languages.
    known = character.isprintable() and ord(character) < 0x180
    return character if known else f"[U+{ord(character):04X}]"
