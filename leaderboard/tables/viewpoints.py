"""Accuracy and pose error over what a view shows: visible fraction, distance, elevation.

The visible fraction is part of every record's truth. Where the camera was is not: distance and
elevation need the data folder that a column was tested on.
"""

from __future__ import annotations

import csv
import io
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from leaderboard.board import Column, ranked
from leaderboard.comparison import counted
from leaderboard.tables.plain import csv_cell
from partialbench.benchmark.records.predictions import Predictions
from partialbench.benchmark.testing.metrics import VISIBILITY_EDGES, best_pose_errors_deg
from partialbench.benchmark.testing.uncertainty import median_interval, share_intervals

FRACTION, DISTANCE, ELEVATION = "visible fraction", "distance", "elevation"
EDGES: dict[str, tuple[float, ...]] = {
    FRACTION: VISIBILITY_EDGES,
    DISTANCE: (2, 2.75, 3.5, 4.25, 5, 6),
    ELEVATION: (-90, -60, -30, 0, 30, 60, 90),
}
"""Quantity → the bounds of its bins: a share; object units, an object's radius being 1; degrees of
the camera above the object's horizon."""
LEAST = 20
"""Clouds that a bin needs to be told of."""


class TestSet(Protocol):
    """The data a column was tested on; ``dataset.loader.ShardDataset`` is one."""

    digest: str
    rotations: NDArray[np.float64]
    translations: NDArray[np.float64]


class Place(NamedTuple):
    """One bin of a curve.

    Attributes:
        low, high: 95 % interval of the accuracy, bootstrap over objects; NaN for one object.
        pose_deg, pose_low, pose_high: median pose error in degrees and its interval, made alike;
            None for a row without pose.
    """

    start: float
    end: float
    clouds: int
    accuracy: float
    low: float
    high: float
    pose_deg: float | None = None
    pose_low: float | None = None
    pose_high: float | None = None


@dataclass(frozen=True)
class Curves:
    """A column's rows over one quantity, best row first; bins of too few clouds are left out."""

    column: Column
    quantity: str
    rows: dict[str, list[Place]]


def quantities(predictions: Predictions, test_set: TestSet | None) -> dict[str, NDArray]:
    """Quantity → its value for each of M clouds, (M,); those that are known.

    Args:
        test_set: what the predictions are of; None where it is not at hand.
    """
    found: dict[str, NDArray] = {FRACTION: predictions.visible_fraction}
    if test_set is not None:
        R, t = test_set.rotations[predictions.rows], test_set.translations[predictions.rows]
        distance = np.linalg.norm(t, axis=1)
        # The camera is at −Rᵀ·t in the object's frame, whose z is up.
        height = -np.einsum("mi,mi->m", R[:, :, 2], t)
        found[DISTANCE] = distance
        found[ELEVATION] = np.degrees(np.arcsin(np.clip(height / distance, -1, 1)))
    return found


def curves_over(
    values: NDArray, right: NDArray, object_ids: NDArray, edges: Sequence[float],
    pose_deg: Sequence[NDArray | None],
) -> list[list[Place]]:  # fmt: skip
    """For each of R rows its bins [edge, next edge) with ``LEAST`` clouds, the last one closed.

    Args:
        values: (M,) of the quantity. right: (M,R) share of seeds that are right.
        pose_deg: for each row its (M,) pose errors, or None.
    """
    found: list[list[Place]] = [[] for _ in pose_deg]
    for start, end in itertools.pairwise(edges):
        last = end == edges[-1]
        inside = (values >= start) & ((values <= end) if last else (values < end))
        clouds = int(inside.sum())
        if clouds < LEAST:
            continue
        means = right[inside].mean(axis=0)
        bounds = share_intervals(right[inside], object_ids[inside])
        for row, errors in enumerate(pose_deg):
            pose: tuple[float | None, ...] = ()
            if errors is not None:
                pose = (float(np.median(errors[inside])),
                        *median_interval(errors[inside], object_ids[inside]))  # fmt: skip
            low, high = map(float, bounds[row])
            found[row].append(Place(start, end, clouds, float(means[row]), low, high, *pose))
    return found


def find_curves(
    board: list[Column], folder: Path, test_sets: Sequence[TestSet] = ()
) -> list[Curves]:
    """Every column that was tested on one side of things, over each quantity that is known.

    Args:
        folder: of the records, with their predictions.
        test_sets: data at hand; each stands for the columns with its digest.
    """
    by_digest = {each.digest: each for each in test_sets}
    return [
        curves
        for column in board
        for curves in _of_column(column, folder, by_digest.get(column.key[5]))
    ]


def _of_column(column: Column, folder: Path, test_set: TestSet | None) -> Iterator[Curves]:
    names, right, errors = ranked(column), [], []
    tested: Predictions | None = None
    for name in names:
        seeds = [counted(result, folder) for result in column.cells[name].results]
        tested = seeds[0][0]
        if (tested.visible_fraction == 1).all():
            return  # complete clouds
        right.append(np.mean([p.predicted == label for p, label in seeds], axis=0))
        posed = all(p.pose_bins.shape[1] for p, _ in seeds)
        errors.append(
            np.mean([best_pose_errors_deg(p) for p, _ in seeds], axis=0) if posed else None
        )
    assert tested is not None, "a column has at least one row"
    for quantity, values in quantities(tested, test_set).items():
        found = curves_over(
            values, np.stack(right, axis=1), tested.object_ids, EDGES[quantity], errors
        )
        if any(found):
            yield Curves(column, quantity, dict(zip(names, found, strict=True)))


def as_csv(found: Sequence[Curves]) -> str:
    """One line for each bin of each row's curves; shares in [0, 1], angles in degrees."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["column", "quantity", "from", "to", "row", "clouds", "accuracy", "interval_low",
         "interval_high", "pose_median_deg", "pose_low", "pose_high"]
    )  # fmt: skip
    for curves in found:
        for name, places in curves.rows.items():
            for p in places:
                figures = (p.accuracy, p.low, p.high, p.pose_deg, p.pose_low, p.pose_high)
                writer.writerow(
                    [csv_cell(curves.column.title), curves.quantity, f"{p.start:g}", f"{p.end:g}",
                     csv_cell(name), p.clouds,
                     *("" if f is None or math.isnan(f) else f"{f:.6f}" for f in figures)]
                )  # fmt: skip
    return text.getvalue()
