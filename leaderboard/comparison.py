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
    difference_intervals,
    holm,
    indistinguishable_groups,
    paired_p_values,
    seed_test,
    share_intervals,
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
            the level 0.05 (Holm over all pairs of the column).
        p_values: (row, row) in rank order → Holm-adjusted p: of the networks at hand on other
            objects (paired test), and where some row of the column has two seeds or more, not less
            than of the methods with other seeds.
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
    values, object_ids, seed_means = _correct(column, names, folder)
    bounds = share_intervals(values, object_ids)
    first, second = np.triu_indices(len(names), 1)
    raw = paired_p_values(values, object_ids)
    over_seeds = seed_test(values, object_ids, seed_means)
    if over_seeds is not None:
        raw = np.maximum(raw, over_seeds)
    adjusted = holm(raw[first, second].tolist())
    different = np.zeros(raw.shape, bool)
    different[first, second] = different[second, first] = np.array(adjusted) <= LEVEL
    groups = indistinguishable_groups(different)
    pairs = [(names[i], names[j]) for i, j in zip(first, second, strict=True)]
    means = values.mean(axis=0)
    low, high = difference_intervals(values, object_ids)
    return Comparison(
        intervals={n: (float(b[0]), float(b[1])) for n, b in zip(names, bounds, strict=True)},
        groups={
            name: [g + 1 for g, group in enumerate(groups) if i in group]
            for i, name in enumerate(names)
        },
        p_values=dict(zip(pairs, adjusted, strict=True)),
        differences={
            pair: (float(means[i] - means[j]), float(low[i, j]), float(high[i, j]))
            for pair, i, j in zip(pairs, first, second, strict=True)
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


def _correct(
    column: Column, names: list[str], folder: Path
) -> tuple[NDArray, NDArray, list[list[float]]]:
    """(M,R) share of seeds that are right for each cloud and row, the clouds' object ids, and for
    each row the accuracy of each seed.
    """
    values, seed_means, reference = [], [], None
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
        seed_means.append([float(right.mean()) for right in seeds])
    assert reference is not None, "a column has at least one result"
    return np.stack(values, axis=1), reference[1], seed_means
