"""Within a column: how sure each row's accuracy is, and which rows cannot be told apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from leaderboard.board import Column, ranked
from partialbench.benchmark.records import results
from partialbench.benchmark.records.predictions import Predictions
from partialbench.benchmark.records.results import Result
from partialbench.benchmark.testing.metrics import shared_clouds
from partialbench.benchmark.testing.uncertainty import (
    bootstrap_intervals,
    flips_for,
    holm,
    indistinguishable_groups,
    paired_p_values,
)
from partialbench.errors import InputError

LEVEL = 0.05


@dataclass(frozen=True)
class Comparison:
    """What a column's predictions say beyond its scores.

    Attributes:
        intervals: row → 95 % interval of the seed-averaged accuracy, bootstrap over objects; NaN
            bounds where the test set is a single object.
        groups: row → numbers, from 1, of the groups it is in: two rows that share none differ at
            the level 0.05 (paired test over objects, Holm over all pairs of the column).
        p_values: (row, row) in rank order → Holm-adjusted p. The smallest there can be is a tenth
            of the level or less: no flip of signs reached the difference that was seen.
        differences: (row, row) in rank order → by how much the first is more accurate, with the
            bounds of its 95 % interval, bootstrap over objects with both rows resampled alike.
    """

    intervals: dict[str, tuple[float, float]]
    groups: dict[str, list[int]]
    p_values: dict[tuple[str, str], float]
    differences: dict[tuple[str, str], tuple[float, float, float]]


def compare(column: Column, folder: Path) -> Comparison:
    """Reads the column's predictions in ``folder`` and compares its rows.

    Raises:
        InputError: a prediction file is missing or not its record's, or two results of the column
            were not tested on the same clouds.
    """
    names = ranked(column)
    values, object_ids = _correct(column, names, folder)
    bounds = bootstrap_intervals(values, object_ids)
    first, second = np.triu_indices(len(names), 1)
    raw = paired_p_values(values, object_ids, flips_for(len(first), LEVEL))
    adjusted = holm(raw[first, second].tolist())
    different = np.zeros(raw.shape, bool)
    different[first, second] = different[second, first] = np.array(adjusted) <= LEVEL
    groups = indistinguishable_groups(different)
    pairs = [(names[i], names[j]) for i, j in zip(first, second, strict=True)]
    ahead = values[:, first] - values[:, second]
    ahead_bounds = bootstrap_intervals(ahead, object_ids)
    return Comparison(
        intervals={n: (float(b[0]), float(b[1])) for n, b in zip(names, bounds, strict=True)},
        groups={
            name: [g + 1 for g, group in enumerate(groups) if i in group]
            for i, name in enumerate(names)
        },
        p_values=dict(zip(pairs, adjusted, strict=True)),
        differences={
            pair: (float(mean), float(low), float(high))
            for pair, mean, (low, high) in zip(pairs, ahead.mean(0), ahead_bounds, strict=True)
        },
    )


def counted(result: Result, folder: Path) -> tuple[Predictions, NDArray]:
    """A result's predictions of the clouds whose class it knows, and their labels among its own."""
    return shared_clouds(
        results.read_predictions(folder, result),
        result.train_data.class_names,
        result.test_data.class_names,
    )


def correct(result: Result, folder: Path) -> tuple[NDArray, NDArray, NDArray]:
    """Of a result's counted clouds: row numbers, object ids, and whether the class is right."""
    predictions, label = counted(result, folder)
    return predictions.rows, predictions.object_ids, predictions.predicted == label


def share_correct(seeds: Sequence[Result], folder: Path) -> tuple[NDArray, NDArray]:
    """Of the clouds all seeds were tested on: object ids, and the share of seeds that are right."""
    tested = [correct(result, folder) for result in seeds]
    return tested[0][1], np.mean([right for *_, right in tested], axis=0)


def _correct(column: Column, names: list[str], folder: Path) -> tuple[NDArray, NDArray]:
    """(M,R) share of seeds that are right for each cloud and row, and the clouds' object ids."""
    values, reference = [], None
    for name in names:
        seeds = []
        for result in column.cells[name].results:
            rows, object_ids, right = correct(result, folder)
            if reference is None:
                reference = (rows, object_ids)
            elif not np.array_equal(reference[0], rows):
                raise InputError(
                    f"{result.row}, seed {result.seed}, was not tested on the same clouds as the "
                    f"others of {column.title!r}; run it again"
                )
            seeds.append(right)
        values.append(np.mean(seeds, axis=0))
    assert reference is not None, "a column has at least one result"
    return np.stack(values, axis=1), reference[1]
