"""What a column's rows were also tested under: one condition, beside the row's own test."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator

from leaderboard.board import Column, ranked
from partialbench.benchmark.records.results import Result

Tested = dict[str, list[Result]]
"""What a row was tested under → a result for each seed, the same seeds for all."""


def rows_under(
    board: list[Column], records: Iterable[Result], condition: str, own: str
) -> Iterator[tuple[Column, dict[str, Tested]]]:
    """Each column that has rows tested under a condition, and these rows, best first.

    Args:
        records: all of the folder's.
        condition: "pose" or "damage", a key of ``Result.conditions``.
        own: what the row's test under no condition is called; it comes first.
    """
    probes: dict[tuple[str, ...], list[Result]] = defaultdict(list)
    for result in records:
        if set(result.conditions) == {condition}:  # two conditions at once compare with no row
            probes[result.column[:-1]].append(result)
    for column in board:
        rows: dict[str, Tested] = {}
        for name in ranked(column):
            tested = {own: list(column.cells[name].results)}
            for probe in probes.get(column.key, []):
                if probe.row == name:
                    tested.setdefault(probe.conditions[condition], []).append(probe)
            seeds = set.intersection(*({r.seed for r in each} for each in tested.values()))
            if len(tested) > 1 and seeds:
                rows[name] = {k: [r for r in tested[k] if r.seed in seeds] for k in tested}
        if rows:
            yield column, rows
