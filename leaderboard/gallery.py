"""Test clouds on which the models disagree, for the page to show and turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from leaderboard.board import Column, ranked
from leaderboard.words import row_title
from partialbench.benchmark.records import results
from partialbench.dataset import manifest as manifests
from partialbench.dataset.loader import ShardDataset
from partialbench.dataset.seeding import generator
from partialbench.geometry.bins import rotation_bins

SAMPLES = 8
POINTS = 256


@dataclass(frozen=True)
class Sample:
    """One test cloud.

    Attributes:
        points: (n,3) camera frame, centred on their mean and scaled into the unit ball.
        axes: (3,3) the true canonical axes in the camera frame, one a row.
        true: class name. visible: share of the surface seen.
        answers: (row title, class name, whether right, predicted canonical axes or None), in rank
            order.
    """

    object_id: str
    points: list[list[float]]
    axes: list[list[float]]
    true: str
    visible: float
    answers: list[tuple[str, str, bool, list[list[float]] | None]]


def open_test_split(folder: Path) -> ShardDataset:
    """A data folder's test split, with as many points a cloud as a sample shows."""
    stored: int = manifests.load(folder).configuration["points"]
    return ShardDataset(folder, "test", min(POINTS, stored))


def disagreements(
    column: Column, folder: Path, data: Sequence[ShardDataset], samples: int = SAMPLES
) -> list[Sample]:
    """Clouds that one row names rightly and another wrongly (first seed of each), drawn at random.

    Args:
        data: test splits to take points from; one whose digest is the column's must be there, else
            there is nothing to show.
    """
    dataset = next((d for d in data if d.digest == column.key[5]), None)
    names = ranked(column)
    if dataset is None or len(names) < 2:
        return []
    first = [column.cells[name].results[0] for name in names]
    stored = [results.read_predictions(folder, result) for result in first]
    classes, test_classes = first[0].train_data.class_names, first[0].test_data.class_names
    said = np.array([[classes[c] for c in p.predicted] for p in stored])
    true = np.array([test_classes[c] for c in stored[0].labels])
    right = said == true
    chosen = np.flatnonzero(right.any(axis=0) & ~right.all(axis=0) & np.isin(true, classes))
    chosen = np.sort(generator(0, "gallery").permutation(chosen)[:samples])
    found = []
    for i in chosen:
        points = dataset.points([stored[0].rows[i]])[0]
        points = points - points.mean(axis=0)
        points = points / max(float(np.linalg.norm(points, axis=1).max()), 1e-9)
        answers = [
            (
                row_title(result),
                str(said[row, i]),
                bool(right[row, i]),
                _axes(rotation_bins()[p.pose_bins[i, 0]]) if p.pose_bins.shape[1] else None,
            )
            for row, (result, p) in enumerate(zip(first, stored, strict=True))
        ]
        found.append(
            Sample(
                str(stored[0].object_ids[i]),
                np.round(points, 3).tolist(),
                _axes(stored[0].rotations[i]),
                str(true[i]),
                float(stored[0].visible_fraction[i]),
                answers,
            )
        )
    return found


def _axes(rotation: np.ndarray) -> list[list[float]]:
    """The object's x, y, z axes in the camera frame: the columns of R_camera_object, as rows."""
    return np.round(rotation.T, 3).tolist()
