"""Result records → tables. A pure function of the records: the same folder gives the same bytes.

A column is one pair of training and test data under one protocol, by digest: results that differ in
any of the three never share a column. A row is one model (and variant); its seeds are averaged.
"""

from __future__ import annotations

import csv
import io
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from partialbench.benchmark.results import Result


@dataclass(frozen=True)
class Cell:
    """One row's results in one column.

    Attributes:
        results: one per seed, in seed order.
    """

    results: tuple[Result, ...]

    @property
    def seeds(self) -> int:
        return len(self.results)

    def mean(self, score: str = "accuracy") -> float:
        """Over seeds."""
        return float(np.mean([r.scores[score] for r in self.results]))

    def std(self, score: str = "accuracy") -> float | None:
        """Sample standard deviation over seeds; None for one seed."""
        if self.seeds < 2:
            return None
        return float(np.std([r.scores[score] for r in self.results], ddof=1))


@dataclass
class Column:
    """What may be compared.

    Attributes:
        key: ``Result.column``.
        title: as printed; has digests only where two columns would otherwise read the same.
        reported: key of the paper's own figures for this pair of data sets ("pm40>ps15"), or "".
        cells: row name → cell.
    """

    key: tuple[str, ...]
    title: str
    reported: str
    cells: dict[str, Cell] = field(default_factory=dict)


@dataclass
class Board:
    """Everything the tables show. ``rows``: row name → the newest result with its card."""

    columns: list[Column]
    rows: dict[str, Result]


def make_board(results: Iterable[Result]) -> Board:
    """Groups results by row, column and seed."""
    grouped: dict[tuple[str, ...], dict[str, list[Result]]] = defaultdict(lambda: defaultdict(list))
    rows: dict[str, Result] = {}
    for result in sorted(results, key=lambda r: (r.run_name, r.seed)):
        grouped[result.column][result.row].append(result)
        rows.setdefault(result.row, result)
    columns = []
    for key, cells in grouped.items():
        first = next(iter(cells.values()))[0]
        columns.append(
            Column(
                key,
                _title(first),
                _reported(first),
                {
                    row: Cell(tuple(sorted(found, key=lambda r: r.seed)))
                    for row, found in cells.items()
                },
            )
        )
    columns.sort(key=lambda column: (column.title, column.key))
    _tell_apart(columns)
    return Board(columns, dict(sorted(rows.items())))


def as_markdown(board: Board) -> str:
    """One table for each column, best row first, with the paper's figure where it has one."""
    parts = ["# Leaderboard\n"]
    for column in board.columns:
        first = next(iter(column.cells.values())).results[0]
        train, test = first.train_data, first.test_data
        parts.append(f"## {column.title}\n")
        parts.append(
            f"Trained on {train.clouds:,} clouds of {train.objects:,} objects ({train.id}, "
            f"{train.digest[:12]}), tested on {first.scores['clouds']:,} clouds of "
            f"{first.scores['objects']:,} objects ({test.id}, {test.digest[:12]}); protocol "
            f"{first.protocol['preset']} ({first.protocol_digest[:12]}). Accuracy in %, mean ± "
            f"standard deviation over seeds.\n"
        )
        head = ["model", "input", "accuracy", "over classes", "seeds", "parameters"]
        if column.reported:
            head.append(f"paper, {column.reported.upper().replace('>', ' → ')} (reported)")
        lines = [head, ["---"] * len(head)]
        for name in ranked(column):
            cell, result = column.cells[name], column.cells[name].results[0]
            line = [
                row_title(result),
                result.card["representation"] or "–",
                percent(cell.mean(), cell.std()),
                percent(cell.mean("class_accuracy"), cell.std("class_accuracy")),
                str(cell.seeds),
                f"{result.cost['parameters']:,}",
            ]
            if column.reported:
                paper = result.card["paper_scores"].get(column.reported)
                line.append("–" if paper is None else f"{paper:.1f}")
            lines.append(line)
        parts += ["| " + " | ".join(line) + " |" for line in lines]
        parts.append("")
    return "\n".join(parts)


def as_csv(board: Board) -> str:
    """One line for each row and column, every score as a number."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["model", "variant", "train_data", "train_digest", "test_data", "test_digest", "preset",
         "protocol_digest", "seeds", "accuracy", "accuracy_std", "class_accuracy",
         "restricted_accuracy", "calibration_error", "parameters", "paper_reported"]
    )  # fmt: skip
    for column in board.columns:
        for name in ranked(column):
            cell = column.cells[name]
            first = cell.results[0]
            paper = first.card["paper_scores"].get(column.reported)
            std = cell.std()
            writer.writerow(
                [first.model, first.variant, first.train_data.id, first.train_data.digest,
                 first.test_data.id, first.test_data.digest, first.protocol["preset"],
                 first.protocol_digest, cell.seeds, f"{cell.mean():.6f}",
                 "" if std is None else f"{std:.6f}", f"{cell.mean('class_accuracy'):.6f}",
                 f"{cell.mean('restricted_accuracy'):.6f}",
                 f"{cell.mean('calibration_error'):.6f}", first.cost["parameters"],
                 "" if paper is None else f"{paper / 100:.4f}"]
            )  # fmt: skip
    return text.getvalue()


def ranked(column: Column) -> list[str]:
    """Row names, best accuracy first; equals by name."""
    return sorted(column.cells, key=lambda name: (-column.cells[name].mean(), name))


def row_title(result: Result) -> str:
    """As printed: the card's title and the variant."""
    title = result.card["title"]
    return f"{title} [{result.variant}]" if result.variant else title


def percent(mean: float, std: float | None) -> str:
    """A share as "83.5" or "83.5 ± 0.4"."""
    return f"{100 * mean:.1f}" if std is None else f"{100 * mean:.1f} ± {100 * std:.1f}"


def _title(result: Result) -> str:
    train, test = result.train_data, result.test_data
    sets = train.id if train.id == test.id else f"{train.id} → {test.id}"
    setting = train.setting if train.setting == test.setting else (
        f"{train.setting} → {test.setting}"
    )  # fmt: skip
    return f"{sets}, {setting}, {result.protocol['preset']}"


def _reported(result: Result) -> str:
    """The paper's own name of the pair, by kind of data: its PM40 is our pm40 in every source."""
    data = (result.train_data, result.test_data)
    ids = [d.id.partition("-")[0] for d in data]
    if not set(ids) <= {"pm40", "ps15"} or any(d.setting != "partial" for d in data):
        return ""
    return ids[0] if ids[0] == ids[1] else ">".join(ids)


def _tell_apart(columns: list[Column]) -> None:
    """Adds to equal titles the first digest digits in which they differ."""
    titles = [column.title for column in columns]
    for column in columns:
        if titles.count(column.title) > 1:
            digests = (column.key[2], column.key[5], column.key[6])
            column.title += " (" + " ".join(digest[:6] for digest in digests) + ")"
