"""The paper's two tables, laid out from the board: its own figures beside ours.

Source of every figure: Xu et al., "Classification of Single-View Object Point Clouds"
(arXiv:2012.10042v2), tables 1 (on the model cards) and 2.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import NamedTuple

from leaderboard.board import Column, budget_title, ranked
from leaderboard.comparison import Comparison
from leaderboard.words import interval, model_input, percent, reported, reported_name, row_title
from partialbench.benchmark.records.results import Result
from partialbench.benchmark.variant import with_changes

MODEL = "papnet"
DEFAULT_VARIANT = "ground-truth"
BASELINE = "without-pose"
DEFAULT_DELTA_DEG = 45.0
GIVEN_POSE = ("ground-truth", "input-transformation")
"""The variants whose class branch is trained on the labelled pose with noise: δ means something."""


class Ablation(NamedTuple):
    """A row of table 2: as the paper calls it, and its accuracies in %."""

    title: str
    pm40: float
    ps15: float


ABLATIONS: dict[str, Ablation] = {
    "without-pose": Ablation("PAPNet w/o. pose", 81.6, 89.8),
    "cascaded": Ablation("Cascaded PAPNet", 81.7, 88.9),
    "multi-task": Ablation("Multi-task PAPNet", 81.7, 89.0),
    "input-transformation": Ablation("Input Transformation", 82.7, 91.1),
    "predicted-regression": Ablation("Pred Tr. (Reg)", 81.8, 90.2),
    "predicted": Ablation("Pred Tr. (Cls)", 81.9, 90.4),
    "predicted-ensemble": Ablation("Pred Tr. (Cls) + Ensem.", 82.0, 90.8),
    "ground-truth": Ablation("GT Tr. (Cls) + Ensem.", 83.5, 91.5),
}
"""The model's ``variant`` option → its row of table 2, in the paper's order."""

_PAIRS = ("pm40", "ps15", "pm40>ps15", "ps15>pm40")


@dataclass(frozen=True)
class Layout:
    """A table as text.

    Attributes:
        about: what its columns mean, in a sentence or two.
        head: the column names, the first of a row's name.
        rows: as many texts each.
        best: number of the row to set in bold, or None.
    """

    title: str
    about: str
    head: list[str]
    rows: list[list[str]]
    best: int | None = None


def layouts(board: list[Column], comparisons: list[Comparison]) -> list[Layout]:
    """Every table of the paper that the board has something to fill with."""
    return [*_evaluations(board), *_ablations(board, comparisons)]


def variant_of(result: Result) -> str:
    """The ablation a PAPNet record is of."""
    return str(result.options.get("variant", DEFAULT_VARIANT))


def noise_title(result: Result) -> str:
    """A row's name in the figure of k and δ: δ stands apart where it was used in training."""
    if result.model != MODEL or variant_of(result) not in GIVEN_POSE:
        return row_title(result)
    others = _others(result, "delta_deg")
    delta = result.options.get("delta_deg", DEFAULT_DELTA_DEG)
    told = f"{delta:g}" if isinstance(delta, int | float) else str(delta)
    return f"{with_changes(result.card['title'], others)}, δ = {told}°"


def _others(result: Result, option: str) -> str:
    """What was changed about a row besides ``option``, as its variant has it."""
    return " ".join(t for t in result.variant.split(" ") if t.partition("=")[0] != option)


def _evaluations(board: list[Column]) -> list[Layout]:
    """Table 1: methods by pairs of data sets; a table for each protocol and milestone with
    two pairs or more.

    Of columns that differ in digests alone it has the one with most rows.
    """
    fullest: dict[tuple[str, ...], Column] = {}
    for column in board:
        if column.reported:
            pair = (*column.key[:2], *column.key[3:5], *column.key[6:8])
            fullest[pair] = max(fullest.get(pair, column), column, key=lambda c: len(c.cells))
    protocols: dict[tuple[str, ...], list[Column]] = defaultdict(list)
    for column in fullest.values():
        protocols[column.key[6:8]].append(column)
    found = []
    for columns in protocols.values():
        if len(columns) < 2:
            continue
        preset = budget_title(next(iter(columns[0].cells.values())).results[0])
        columns.sort(key=lambda c: (_PAIRS.index(c.reported), c.title))
        names = dict.fromkeys(
            name for column in columns for name in ranked(column)
            if not column.cells[name].results[0].variant
        )  # fmt: skip
        rows = []
        for name in names:
            here = [column.cells.get(name) for column in columns]
            first = next(cell for cell in here if cell is not None).results[0]
            row = [row_title(first), model_input(first)]
            for column, cell in zip(columns, here, strict=True):
                ours = "–" if cell is None else percent(cell.mean(), cell.std())
                row += [ours, reported(column, first)]
            rows.append(row)
        heads = [
            [column.title.partition(", partial, ")[0], reported_name(column)] for column in columns
        ]
        found.append(
            Layout(
                f"Accuracy (%) on every data set and between them, {preset}",
                "After table 1 of the paper, whose own figures, on its data, stand beside ours.",
                ["method", "input", *(text for pair in heads for text in pair)],
                rows,
            )
        )
    return found


def _ablations(board: list[Column], comparisons: list[Comparison]) -> list[Layout]:
    """Table 2 for each column in which two or more of its rows were run alike."""
    found = []
    for column, comparison in zip(board, comparisons, strict=True):
        # Rows that differ in the variant alone: what else they share → variant → row name.
        groups: dict[str, dict[str, str]] = defaultdict(dict)
        for name in ranked(column):
            result = column.cells[name].results[0]
            if result.model == MODEL:
                groups[_others(result, "variant")].setdefault(variant_of(result), name)
        for others, names in groups.items():
            if len(names) < 2:
                continue
            rows = [_ablation(key, names, column, comparison) for key in ABLATIONS]
            best = next(iter(names))  # they came in rank order
            found.append(
                Layout(
                    f"Ablations of {with_changes('PAPNet', others)}: {column.title}",
                    "After table 2 of the paper. Gain: over PAPNet without pose, in points of "
                    "accuracy. Rows that share a group cannot be told apart.",
                    [
                        "method",
                        "accuracy",
                        "95 % interval",
                        "group",
                        "gain",
                        "seeds",
                        *([reported_name(column), "its gain"] if _figure(column) else []),
                    ],
                    rows,
                    list(ABLATIONS).index(best),
                )
            )
    return found


def _ablation(key: str, names: dict[str, str], column: Column, compared: Comparison) -> list[str]:
    row = [ABLATIONS[key].title]
    if key in names:
        cell, baseline = column.cells[names[key]], column.cells.get(names.get(BASELINE, ""))
        row += [
            percent(cell.mean(), cell.std()),
            interval(*compared.intervals[names[key]]),
            " ".join(map(str, compared.groups[names[key]])),
            "–" if baseline is None else f"{100 * (cell.mean() - baseline.mean()):+.1f}",
            str(cell.seeds),
        ]
    else:
        row += ["–"] * 5
    figure = _figure(column)
    if figure:
        paper = getattr(ABLATIONS[key], figure)
        row += [f"{paper:.1f}", f"{paper - getattr(ABLATIONS[BASELINE], figure):+.1f}"]
    return row


def _figure(column: Column) -> str:
    """Which of table 2's two columns this one answers to, or ""."""
    return column.reported if column.reported in ("pm40", "ps15") else ""
