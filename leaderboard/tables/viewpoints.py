"""Accuracy and pose error over what a view shows: visible fraction, distance, elevation.

The visible fraction is part of every record's truth. Where the camera was is not: distance and
elevation need the data folder that a column was tested on.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from leaderboard.board import Column, own_columns, ranked
from leaderboard.comparison import counted
from leaderboard.tables.layouts import Layout
from leaderboard.words import interval, percent, row_title
from partialbench.benchmark.records.predictions import Predictions
from partialbench.benchmark.testing.metrics import VISIBILITY_EDGES, best_pose_errors_deg
from partialbench.benchmark.testing.uncertainty import bootstrap_intervals

FRACTION, DISTANCE, ELEVATION = "visible fraction", "distance", "elevation"
EDGES: dict[str, tuple[float, ...]] = {
    FRACTION: VISIBILITY_EDGES,
    DISTANCE: (2, 2.75, 3.5, 4.25, 5, 6),
    ELEVATION: (-90, -60, -30, 0, 30, 60, 90),
}
"""Quantity → the bounds of its bins: a share; object units, an object's radius being 1; degrees of
the camera above the object's horizon."""
LEAST = 10
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
        pose_deg: median pose error in degrees; None for a row without pose.
    """

    start: float
    end: float
    clouds: int
    accuracy: float
    low: float
    high: float
    pose_deg: float | None


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


def curve(
    values: NDArray, right: NDArray, object_ids: NDArray, edges: Sequence[float],
    pose_deg: NDArray | None = None,
) -> list[Place]:  # fmt: skip
    """Accuracy and pose error in each bin [edge, next edge) with ``LEAST`` clouds, the last closed.

    Args:
        values: (M,) of the quantity. right: (M,) share of seeds that are right.
        pose_deg: (M,) pose errors, or None.
    """
    found = []
    for start, end in itertools.pairwise(edges):
        last = end == edges[-1]
        inside = (values >= start) & ((values <= end) if last else (values < end))
        if inside.sum() < LEAST:
            continue
        ((low, high),) = bootstrap_intervals(right[inside][:, None], object_ids[inside])
        error = None if pose_deg is None else float(np.median(pose_deg[inside]))
        found.append(
            Place(start, end, int(inside.sum()), float(right[inside].mean()), float(low),
                  float(high), error)
        )  # fmt: skip
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
    found = []
    for column in own_columns(board):
        test_set = by_digest.get(column.key[5])
        rows: dict[str, dict[str, list[Place]]] = {}
        for name in ranked(column):
            seeds = [counted(result, folder) for result in column.cells[name].results]
            first = seeds[0][0]
            if (first.visible_fraction == 1).all():
                break  # complete clouds
            right = np.mean([p.predicted == label for p, label in seeds], axis=0)
            posed = all(p.pose_bins.shape[1] for p, _ in seeds)
            errors = np.mean([best_pose_errors_deg(p) for p, _ in seeds], axis=0) if posed else None
            for quantity, values in quantities(first, test_set).items():
                rows.setdefault(quantity, {})[name] = curve(
                    values, right, first.object_ids, EDGES[quantity], errors
                )
        found += [Curves(column, quantity, each) for quantity, each in rows.items()]
    return found


def as_layout(curves: Curves) -> Layout:
    """Accuracies by bin, and the median pose error of a row that has one."""
    bins = sorted({(p.start, p.end) for places in curves.rows.values() for p in places})
    counts = {(p.start, p.end): p.clouds for places in curves.rows.values() for p in places}
    rows = []
    for name, places in curves.rows.items():
        there = {(p.start, p.end): p for p in places}
        rows.append(
            [
                row_title(curves.column.cells[name].results[0]),
                *(_text(there.get(each)) for each in bins),
            ]
        )
    return Layout(
        f"Accuracy (%) by {curves.quantity}: {curves.column.title}",
        "In brackets the 95 % interval over test objects; then the median pose error of a row that "
        f"has a pose. Bins of at least {LEAST} clouds, their number in the head.",
        ["model", *(f"{_head(*each)} ({counts[each]:,})" for each in bins)],
        rows,
    )


def _head(start: float, end: float) -> str:
    return f"{start:g} – {end:g}"


def _text(place: Place | None) -> str:
    if place is None:
        return "–"
    pose = "" if place.pose_deg is None else f", {place.pose_deg:.0f}°"
    return f"{percent(place.accuracy, None)} ({interval(place.low, place.high)}){pose}"
