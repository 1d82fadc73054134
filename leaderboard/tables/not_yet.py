"""What campaigns ask for and no record answers yet: rows of a column, and whole columns."""

from __future__ import annotations

import csv
import io
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

from leaderboard.board import Column
from leaderboard.tables.layouts import Layout
from leaderboard.tables.plain import csv_cell, visible
from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.records.declared import Declared
from partialbench.benchmark.variant import with_changes


@dataclass(frozen=True)
class Asked:
    """A row of a column that a campaign asks for.

    Attributes:
        name: the row, title: as printed. seeds: that are asked for. there: that have a record.
        failed, waiting: why, "" for neither.
    """

    name: str
    title: str
    seeds: tuple[int, ...]
    there: tuple[int, ...]
    failed: str
    waiting: str

    @property
    def state(self) -> str:
        """ "not yet", "failed: …" or "waits: …"."""
        if self.failed:
            return f"failed: {visible(self.failed)}"
        return f"waits: {visible(self.waiting)}" if self.waiting else "not yet"


def asked_rows(column: Column, declared: Sequence[Declared]) -> list[Asked]:
    """The rows of this column that are asked for, in the order of their titles."""
    _, _, train, _, _, *rest = column.key[:8]
    seeds: dict[str, list[Declared]] = defaultdict(list)
    for each in declared:
        if _key(each)[:4] == (train, *rest):
            seeds[each.row].append(each)
    found = []
    for name, of_row in seeds.items():
        cell = column.cells.get(name)
        there = {result.seed for result in cell.results} if cell else set()
        lacking = [each for each in of_row if each.seed not in there]
        found.append(
            Asked(
                name,
                visible(with_changes(of_row[0].title, of_row[0].variant)),
                tuple(sorted(each.seed for each in of_row)),
                tuple(sorted(there)),
                _reason(lacking, "failed"),
                _reason(lacking, "waiting"),
            )
        )
    return sorted(found, key=lambda asked: asked.title)


def absent(asked: Sequence[Asked]) -> list[Asked]:
    """Those without any record, what failed first."""
    return sorted(
        (each for each in asked if not each.there), key=lambda each: (not each.failed, each.title)
    )


def _reason(declared: Sequence[Declared], state: str) -> str:
    return next((each.reason or "no reason given" for each in declared if each.state == state), "")


def sentence(asked: Sequence[Asked]) -> str:
    """ "Not yet: A; B. Failed: C (the loss became nan)." of the rows that are not there."""
    missing = absent(asked)
    plain = [each.title for each in missing if each.state == "not yet"]
    parts = [f"Not yet: {'; '.join(plain)}."] if plain else []
    for word, reason in (("Failed", "failed"), ("Waits", "waiting")):
        # What several have in common is said once.
        alike: dict[str, list[str]] = defaultdict(list)
        for each in missing:
            if each.state.startswith(word.lower()):
                alike[visible(getattr(each, reason))].append(each.title)
        parts += [f"{word}: {'; '.join(titles)} ({why})." for why, titles in alike.items()]
    return " ".join(parts)


def progress(board: Sequence[Column], declared: Sequence[Declared]) -> list[Layout]:
    """How many of the asked rows are there, by data and milestone; nothing where none is asked."""
    if not declared:
        return []
    there = _there(board)
    counts: dict[tuple[str, str], dict[int, list[int]]] = defaultdict(
        lambda: defaultdict(lambda: [0, 0])
    )
    for each in declared:
        data = each.train_data if each.train_data == each.test_data else (
            f"{each.train_data} → {each.test_data}"
        )  # fmt: skip
        count = counts[data, each.protocol][each.clouds]
        count[0] += _key(each) in there
        count[1] += 1
    clouds = sorted({each.clouds for each in declared})
    rows = [
        [
            f"{data}, {protocol}",
            *(f"{of[m][0]} of {of[m][1]}" if m in of else "–" for m in clouds),
        ]
        for (data, protocol), of in sorted(counts.items())
    ]
    return [
        Layout(
            "Asked for, and how much of it is there",
            "Trainings (a row's seeds count each) that campaigns declare, by data set and training "
            "clouds seen; not_yet.csv has each that is not there.",
            ["data", *(f"{milestones.name(m)} clouds" for m in clouds)],
            rows,
        )
    ]


def as_csv(board: Sequence[Column], declared: Sequence[Declared]) -> str:
    """One line for each training and test that is asked for and not there."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["model", "variant", "train_data", "test_data", "protocol", "clouds", "seed",
                     "state", "reason"])  # fmt: skip
    there = _there(board)
    for each in declared:
        if _key(each) not in there:
            # A record that is said to be done and is not here is missing here.
            state = "missing" if each.state == "done" else each.state
            writer.writerow(
                [*map(csv_cell, (each.model, each.variant, each.train_data, each.test_data,
                                 each.protocol)),
                 each.clouds, each.seed, state, csv_cell(each.reason)]
            )  # fmt: skip
    return text.getvalue()


def _there(board: Sequence[Column]) -> set[tuple[object, ...]]:
    """What ``_key`` makes of every result of the board."""
    return {
        (column.key[2], *column.key[5:8], name, result.seed)
        for column in board
        for name, cell in column.cells.items()
        for result in cell.results
    }


def _key(each: Declared) -> tuple[object, ...]:
    return (
        each.train_digest, each.test_digest, each.protocol_digest, milestones.name(each.clouds),
        each.row, each.seed,
    )  # fmt: skip
