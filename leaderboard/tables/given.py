"""Trained models that are told the pose: what a true one, a noisy one or a wrong one is worth.

After the paper's upper bound, ground-truth pose at test. Made from the records that ``partialbench
eval --test-pose`` wrote beside the row's own: the same weights on the same clouds. Of a row's seeds
those count that were tested under each of its poses.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from leaderboard.board import Column
from leaderboard.comparison import share_correct
from leaderboard.tables.conditions import rows_under
from leaderboard.tables.layouts import Layout
from leaderboard.words import difference, row_title
from partialbench.benchmark.records.results import Result
from partialbench.benchmark.testing.given_pose import PER_CLASS, RANDOM, delta_deg
from partialbench.benchmark.testing.uncertainty import bootstrap_intervals

OWN, TRUE = "own", "0"

Bounded = tuple[float, float, float]
"""A mean over test clouds and the bounds of its 95 % interval, by bootstrap over objects."""


class Told(NamedTuple):
    """One row under each pose, its seeds averaged.

    Attributes:
        accuracy: by pose: ``OWN`` first, then by the noise in degrees, then ``RANDOM``.
        gain: of the true pose over the model's own, paired; None without the true pose.
    """

    seeds: int
    accuracy: dict[str, Bounded]
    gain: Bounded | None


@dataclass(frozen=True)
class GivenPoses:
    """The rows of one column that were told a pose, best first."""

    column: Column
    rows: dict[str, Told]

    @property
    def poses(self) -> list[str]:
        """Every pose that some row was told, in the order of ``Told.accuracy``."""
        return sorted({pose for told in self.rows.values() for pose in told.accuracy}, key=_order)


def find_given_poses(
    board: list[Column], records: Iterable[Result], folder: Path
) -> list[GivenPoses]:
    """Of each column that has such records, what they say.

    Args:
        records: all of the folder's.
    """
    return [
        GivenPoses(column, {name: _told(tested, folder) for name, tested in rows.items()})
        for column, rows in rows_under(board, records, "pose", OWN)
    ]


def as_layout(given: GivenPoses) -> Layout:
    """The accuracies as a table, with what the true pose gains."""
    rows = []
    for name, told in given.rows.items():
        shares = {pose: difference(accuracy) for pose, accuracy in told.accuracy.items()}
        rows.append(
            [
                row_title(given.column.cells[name].results[0]),
                *(shares.get(pose, "–") for pose in given.poses),
                "–" if told.gain is None else difference(told.gain),
            ]
        )
    return Layout(
        f"Accuracy (%) under a given pose: {given.column.title}",
        "The same weights with the pose they find themselves, and told the labelled one, that with "
        "noise from U(−δ, δ) on every Euler angle (± δ), or one at random; by class: as each "
        "class's own symmetry maps it, so that it cannot tell the class; in brackets the 95 % "
        "interval over test objects. Gain: of the true pose over the model's own, paired.",
        ["model", *map(heading, given.poses), "gain"],
        rows,
    )


def _told(tested: dict[str, list[Result]], folder: Path) -> Told:
    """Args: tested: pose → its records, of the same seeds for each."""
    right, object_ids = {}, np.array([])
    for pose in sorted(tested, key=_order):
        object_ids, right[pose] = share_correct(tested[pose], folder)
    accuracy = {pose: _bounded(share, object_ids) for pose, share in right.items()}
    gain = _bounded(right[TRUE] - right[OWN], object_ids) if TRUE in right else None
    return Told(len(tested[OWN]), accuracy, gain)


def _bounded(values: NDArray, object_ids: NDArray) -> Bounded:
    ((low, high),) = bootstrap_intervals(values[:, None], object_ids)
    return float(values.mean()), float(low), float(high)


def _order(pose: str) -> tuple[int, float]:
    if pose == OWN:
        return 0, 0.0
    if pose == RANDOM:
        return 3, 0.0
    return (2 if pose.startswith(PER_CLASS) else 1), delta_deg(pose)


def heading(pose: str) -> str:
    """What a pose is called at the head of a column."""
    titles = {OWN: "own pose", TRUE: "true pose", RANDOM: "random pose"}
    if pose.startswith(PER_CLASS):
        return f"{heading(pose.removeprefix(PER_CLASS))}, by class"
    return titles.get(pose, f"± {pose}°")
