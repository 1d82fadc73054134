"""Trained models on clouds made to differ from those trained on: fewer points, a noisy sensor.

A curve is one row of the board under one condition, from the records that ``partialbench eval
--checkpoint … --test-points`` or ``--test-data`` (a folder rendered with ``--sensor``) wrote beside
the row's own. The weights are the same throughout: nothing is trained for a condition, and of a
row's seeds those count that were tested under each of its conditions.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from leaderboard.board import Column, ranked
from leaderboard.comparison import share_correct
from leaderboard.tables.layouts import Layout
from leaderboard.words import interval, percent, row_title
from partialbench.benchmark.records.results import Result
from partialbench.benchmark.testing.uncertainty import bootstrap_intervals
from partialbench.errors import InputError


class Point(NamedTuple):
    """One row under one condition, its seeds averaged.

    Attributes:
        x: points of a cloud, or the sensor's strength.
        low, high: 95 % interval of the accuracy, bootstrap over objects; NaN for a single object.
        pose_deg: median pose error, degrees; None for a model without pose.
    """

    x: float
    seeds: int
    accuracy: float
    low: float
    high: float
    pose_deg: float | None


@dataclass(frozen=True)
class Family:
    """The curves of one column along one condition.

    Attributes:
        condition: "points", or a sensor's name.
        curves: row name → its points by rising x; two at least.
    """

    column: Column
    condition: str
    curves: dict[str, list[Point]]

    @property
    def axis(self) -> str:
        """What x is, as printed."""
        if self.condition == "points":
            return "points of a cloud"
        return f"strength of {self.condition}"


def find_families(board: list[Column], records: Iterable[Result], folder: Path) -> list[Family]:
    """Every curve of two points or more, the row's own result being one of them.

    Args:
        records: all of the folder's; those without a condition are on the board already.

    Raises:
        InputError: seeds of one row under one condition were tested on different clouds.
    """
    probes: dict[tuple[object, ...], list[Result]] = defaultdict(list)
    for result in records:
        # Two at once lie on no curve; ``given`` has poses, ``damages`` has damages.
        if len(result.conditions) == 1 and result.conditions.keys() <= {"points", "sensor"}:
            probes[_trained_on(result)].append(result)
    families = []
    for column in board:
        own = next(iter(column.cells.values())).results[0]
        here = [probe for probe in probes.get(_trained_on(own), []) if _belongs(probe, own)]
        for condition in sorted({_condition(result) for result in here}):
            curves = {}
            for name in ranked(column):
                at: dict[float, list[Result]] = defaultdict(list)
                at[_start(condition, own)] += column.cells[name].results
                for result in here:
                    if result.row == name and _condition(result) == condition:
                        at[_place(result)].append(result)
                seeds = set.intersection(*({r.seed for r in found} for found in at.values()))
                if len(at) > 1 and seeds:
                    curves[name] = [
                        _point(x, [r for r in at[x] if r.seed in seeds], folder) for x in sorted(at)
                    ]
            if curves:
                families.append(Family(column, condition, curves))
    return families


def as_layout(family: Family) -> Layout:
    """The accuracies of a family as a table."""
    places = sorted({point.x for points in family.curves.values() for point in points})
    rows = []
    for name, points in family.curves.items():
        there = {p.x: f"{percent(p.accuracy, None)} ({interval(p.low, p.high)})" for p in points}
        title = row_title(family.column.cells[name].results[0])
        rows.append([title, *(there.get(x, "–") for x in places)])
    return Layout(
        f"Accuracy (%) against the {family.axis}: {family.column.title}",
        "The same weights throughout: of a row's seeds, those tested at each of its places. In "
        "brackets the 95 % interval over test objects.",
        ["model", *(f"{x:g}" for x in places)],
        rows,
    )


def _trained_on(result: Result) -> tuple[object, ...]:
    """What a probe shares with the column it belongs to: all but the test split's content."""
    train, test = result.train_data, result.test_data
    return (
        train.id, train.setting, train.digest, test.id, test.setting, result.protocol_digest,
        result.clouds,
    )  # fmt: skip


def _belongs(probe: Result, own: Result) -> bool:
    """Whether the row's own result is where the probe's curve starts."""
    if "points" in probe.conditions:
        return probe.test_data.digest == own.test_data.digest
    return not own.train_data.sensor


def _condition(result: Result) -> str:
    ((kind, value),) = result.conditions.items()
    return kind if kind == "points" else value.partition(":")[0]


def _place(result: Result) -> float:
    """Where on its curve a probe lies."""
    ((kind, value),) = result.conditions.items()
    return float(value if kind == "points" else value.partition(":")[2] or 0)


def _start(condition: str, own: Result) -> float:
    """Where the row's own result lies on a curve."""
    return float(own.protocol["num_points"]) if condition == "points" else 0.0


def _point(x: float, seeds: list[Result], folder: Path) -> Point:
    digests = {result.test_data.digest for result in seeds}
    if len(digests) > 1:
        raise InputError(
            f"{seeds[0].row} was tested on {len(digests)} data sets under the same condition "
            f"({_condition(seeds[0])} {x:g}): {', '.join(d[:12] for d in sorted(digests))}; keep "
            f"the records of one"
        )
    object_ids, values = share_correct(seeds, folder)
    ((low, high),) = bootstrap_intervals(values[:, None], object_ids)
    poses = [seed.scores["pose"] for seed in seeds]
    pose_deg = float(np.mean([pose["median_deg"] for pose in poses])) if all(poses) else None
    return Point(x, len(seeds), float(values.mean()), float(low), float(high), pose_deg)
