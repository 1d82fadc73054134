"""Test clouds on which the models disagree, for the page to show and turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leaderboard.board import Column
from leaderboard.page.rows import main_rows
from leaderboard.words import row_title
from partialbench.benchmark.records import results
from partialbench.dataset import manifest as manifests
from partialbench.dataset.loader import ShardDataset
from partialbench.dataset.samples import packed, scenes
from partialbench.dataset.seeding import generator
from partialbench.errors import InputError
from partialbench.geometry.bins import rotation_bins

SAMPLES = 8
POINTS = 256
LICENCE_CLEAN = ("parametric", "rooms")
"""Sources that this project makes itself: their clouds may be shown to anybody."""


@dataclass(frozen=True)
class Sample:
    """One test cloud of a column.

    Attributes:
        row: of the test split, of the data whose digest is the column's.
        answers: (row title, class name, whether right, predicted canonical axes or None), in rank
            order; the axes in the camera frame, one a row.
    """

    digest: str
    row: int
    true: str
    answers: list[tuple[str, str, bool, list[list[float]] | None]]

    @property
    def cloud(self) -> str:
        """Names it among the page's clouds."""
        return f"{self.digest[:12]}-{self.row}"


def open_test_split(folder: Path) -> ShardDataset:
    """A data folder's test split, with as many points a cloud as a sample shows."""
    stored: int = manifests.load(folder).configuration["points"]
    return ShardDataset(folder, "test", min(POINTS, stored))


def data_at_hand(
    results_folder: Path, digests: set[str], look_in: Sequence[Path | str] = ()
) -> list[ShardDataset]:
    """The test splits of these digests in the data folders at hand, each once.

    Those are beside the folder of records, in ``data`` beside it, and in the folders of
    ``look_in``. One that cannot be read is passed over: nobody asked for it.

    Raises:
        InputError: a folder of ``look_in`` that is none.
    """
    for folder in map(Path, look_in):
        if not folder.is_dir():
            raise InputError(f"no folder to look for data in at {folder} (--look-in)")
    beside = results_folder.resolve().parent
    found: dict[str, ShardDataset] = {}
    for parent in (beside, beside / "data", *map(Path, look_in)):
        for path in sorted(parent.glob(f"*/{manifests.NAME}")):
            try:
                digest = manifests.load(path.parent).digests.get("test", "")
                if digest in digests and digest not in found:
                    found[digest] = open_test_split(path.parent)
            except InputError:
                continue
    return [found[digest] for digest in sorted(found)]


def may_be_shown(test_split: ShardDataset) -> bool:
    """Whether its clouds were made from a source of ``LICENCE_CLEAN``."""
    return test_split.manifest.configuration["source"]["name"] in LICENCE_CLEAN


def disagreements(
    column: Column, folder: Path, data: Sequence[ShardDataset], samples: int = SAMPLES
) -> list[Sample]:
    """Clouds that one model names rightly and another wrongly (first seed of each), at random.

    Args:
        data: test splits to take points from; one whose digest is the column's must be there, else
            there is nothing to show.
    """
    names = main_rows(column)
    if not any(d.digest == column.key[5] for d in data) or len(names) < 2:
        return []
    first = [column.cells[name].results[0] for name in names]
    stored = [results.read_predictions(folder, result) for result in first]
    classes, test_classes = first[0].train_data.class_names, first[0].test_data.class_names
    said = np.array([[classes[c] for c in p.predicted] for p in stored])
    true = np.array([test_classes[c] for c in stored[0].labels])
    right = said == true
    chosen = np.flatnonzero(right.any(axis=0) & ~right.all(axis=0) & np.isin(true, classes))
    chosen = np.sort(generator(0, "gallery").permutation(chosen)[:samples])
    return [
        Sample(
            column.key[5],
            int(stored[0].rows[i]),
            str(true[i]),
            [
                (
                    row_title(result),
                    str(said[row, i]),
                    bool(right[row, i]),
                    _axes(rotation_bins()[p.pose_bins[i, 0]]) if p.pose_bins.shape[1] else None,
                )
                for row, (result, p) in enumerate(zip(first, stored, strict=True))
            ],
        )
        for i in chosen
    ]


def drawn(samples: Sequence[Sample], data: Sequence[ShardDataset]) -> dict[str, dict[str, Any]]:
    """``Sample.cloud`` → what the page draws, each cloud once.

    The axes are the true canonical ones, one a row; all else as in ``Scene``.
    """
    found = {}
    for dataset in data:
        rows = sorted({sample.row for sample in samples if sample.digest == dataset.digest})
        for row, scene in zip(rows, scenes(dataset, rows, POINTS), strict=True):
            found[f"{dataset.digest[:12]}-{row}"] = {
                "object_id": str(dataset.object_ids[row]),
                "true": dataset.class_names[dataset.labels[row]],
                "visible": round(float(dataset.visible_fraction[row]), 4),
                "points": packed(scene.points),
                "whole": packed(scene.whole),
                "axes": np.round(scene.axes, 3).tolist(),
                "camera": np.round(scene.camera, 3).tolist(),
            }
    return found


def _axes(rotation: NDArray) -> list[list[float]]:
    """The object's x, y, z axes in the camera frame: the columns of R_camera_object, as rows."""
    axes: list[list[float]] = np.round(rotation.T, 3).tolist()
    return axes
