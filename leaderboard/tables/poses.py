"""Poses as tables: how often a row finds them, and what deciding over several is worth.

The paper's figures of top-k pose accuracy and of k, with intervals over test objects. Seeds are
averaged cloud by cloud before objects are resampled.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from leaderboard.board import Column, ranked
from leaderboard.comparison import counted
from leaderboard.tables.layouts import Layout, noise_title
from leaderboard.words import difference, interval, percent, row_title
from partialbench.benchmark.records.predictions import Predictions
from partialbench.benchmark.records.results import Result
from partialbench.benchmark.testing.metrics import (
    best_pose_errors_deg,
    pose_hits,
)
from partialbench.benchmark.testing.uncertainty import bootstrap_intervals

TOP_K = (1, 5, 20)
NEAR_DEG = 30.0
DECIDING = (1, 5, 10, 20)


def pose_layouts(board: list[Column], folder: Path) -> list[Layout]:
    """For each column: its rows that have a pose, then those that decide over several.

    Args:
        folder: of the records, with their predictions.
    """
    found = []
    for column in board:
        found += [
            layout for layout in (_found(column, folder), _deciding(column, folder)) if layout
        ]
    return found


def _found(column: Column, folder: Path) -> Layout | None:
    rows = []
    for result, tested in _tested(column, folder, "pose"):
        hits = []
        for predictions, _ in tested:
            near = best_pose_errors_deg(predictions) < NEAR_DEG
            hits.append(np.column_stack([pose_hits(predictions)[:, [k - 1 for k in TOP_K]], near]))
        shares = _with_intervals(np.mean(hits, axis=0), tested[0][0].object_ids)
        rows.append([row_title(result), *shares])
    if not rows:
        return None
    return Layout(
        f"Pose: {column.title}",
        "Share of clouds (%) whose true pose bin is among the k most probable of the 60, and whose "
        f"best bin errs by less than {NEAR_DEG:g}° modulo symmetry; in brackets the 95 % interval "
        "over test objects.",
        ["model", *(f"top-{k}" for k in TOP_K), f"within {NEAR_DEG:g}°"],
        rows,
    )


def _deciding(column: Column, folder: Path) -> Layout | None:
    rows = []
    for result, tested in _tested(column, folder, "ensemble"):
        object_ids = tested[0][0].object_ids
        seeds = [p.decided == labels[:, None] for p, labels in tested]
        right = np.mean(seeds, axis=0)
        sizes = [k for k in DECIDING if k <= right.shape[1]]
        gain = (right[:, -1] - right[:, 0])[:, None]
        ((low, high),) = bootstrap_intervals(gain, object_ids)
        rows.append(
            [
                noise_title(result),
                *_with_intervals(right[:, [k - 1 for k in sizes]], object_ids),
                *["–"] * (len(DECIDING) - len(sizes)),
                difference((float(gain.mean()), float(low), float(high))),
            ]
        )
    if not rows:
        return None
    return Layout(
        f"Accuracy (%) against the number of poses that decide: {column.title}",
        "After the paper's figure of k and δ: the k most probable poses decide by their highest "
        "logit, whatever k the row itself uses; in brackets the 95 % interval over test objects. "
        "Gain: of all stored poses over one.",
        ["model", *(f"k = {k}" for k in DECIDING), "gain"],
        rows,
    )


def _tested(
    column: Column, folder: Path, score: str
) -> Iterator[tuple[Result, list[tuple[Predictions, NDArray]]]]:
    """Of each row that has the score, best first: a record, and every seed's counted clouds."""
    for name in ranked(column):
        results = column.cells[name].results
        if results[0].scores[score]:
            yield results[0], [counted(result, folder) for result in results]


def _with_intervals(values: NDArray, object_ids: NDArray) -> list[str]:
    """Each column of (M,C) as "7.8 (6.6 – 9.0)"."""
    bounds = bootstrap_intervals(values, object_ids)
    return [
        f"{percent(float(mean), None)} ({interval(*map(float, pair))})"
        for mean, pair in zip(values.mean(axis=0), bounds, strict=True)
    ]
