"""ScanObjectNN's HDF5 files, as a data folder like any other, but without poses.

Uy et al., "Revisiting Point Cloud Classification", ICCV 2019. A file has ``data`` (M,N,3),
``label`` (M,) and ``mask`` (M,N); ``training_X.h5`` and ``test_X.h5`` belong together. The clouds
are parts of objects as they were scanned, so that nothing is rendered, and nobody knows the poses.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from partialbench import given
from partialbench.dataset.build import BuildPlan, build
from partialbench.dataset.executors import InlineExecutor
from partialbench.dataset.manifest import Manifest
from partialbench.dataset.rows import Job
from partialbench.dataset.sources import ObjectRef, RejectedObject
from partialbench.errors import InputError, parsing
from renderers.release import AsReleased, ReleasedRow
from renderers.sources.cloud_store import HdfFile, dataset, require_counts, whole_labels
from renderers.sources.ply_hdf5 import hdf5_files

CLASSES = (
    "bag", "bin", "box", "cabinet", "chair", "desk", "display", "door", "shelf", "table", "bed",
    "pillow", "sink", "sofa", "toilet",
)  # fmt: skip
"""Label → name. Source: shape_names_ext.txt of hkust-vgd/scanobjectnn."""

_BEGINNINGS = {"train": "training_", "test": "test_"}


def import_scanobjectnn(folder: str | PathLike[str], out: str | PathLike[str]) -> Manifest:
    """Write the clouds as shards, rows in the released order; data set ``scanobjectnn``.

    A row keeps its distinct points, those of the background too. A cloud is centred on its centroid
    and scaled into the unit ball. Every row is its own object with one view: the files do not say
    which of them are augmented copies of one. Its pose is not known: R is the identity and t is
    zero throughout, the configuration has ``pose: none``, and no figure may be made of them.

    Args:
        folder: with one pair of files, or one file of a pair.

    Raises:
        InputError: no pair or several, or arrays of another shape.
    """
    source = ScannedObjects(given.path(folder, "the folder of ScanObjectNN"))
    job = Job(
        source=source,
        occluder=AsReleased(),
        dataset_id="scanobjectnn",
        setting="partial",
        views=dict.fromkeys(_BEGINNINGS, 1),
        points=source.points_per_row,
        seed=0,
    )
    plan = BuildPlan(job, given.path(out, "the data folder"), source.splits())
    return build(plan, InlineExecutor)


class ScannedObjects:
    """The rows as a source. Attributes: as ``partialbench.dataset.sources.Source``."""

    frame = "original"
    pose = "none"

    def __init__(self, path: str | PathLike[str]) -> None:
        self._files = {split: HdfFile(file) for split, file in _pair(Path(path)).items()}
        self.class_names: tuple[str, ...] = CLASSES
        self.rejected: list[RejectedObject] = []
        self._labels: dict[str, NDArray[np.int64]] = {}
        widths = {}
        for split, file in self._files.items():
            with parsing(str(file.path), "HDF5"):
                opened = file.open()
                data = dataset(opened, "data", "the file")
                if data.ndim != 3 or data.shape[2] != 3 or data.dtype.kind != "f":
                    raise InputError(f"data are {data.dtype} {data.shape}, expected floats (M,N,3)")
                require_counts(opened, ("data", "label"), "the file")
                self._labels[split] = whole_labels(opened, "label", len(CLASSES), "the file")
                widths[split] = data.shape[1]
        if len(set(widths.values())) > 1:
            raise InputError(f"{path}: the splits differ in points per row: {widths}")
        self.points_per_row = widths["train"]
        names = " and ".join(file.path.name for file in self._files.values())
        counts = {split: len(labels) for split, labels in self._labels.items()}
        self.listing = (
            f"ScanObjectNN, {names}: {len(CLASSES)} classes, {counts['train']:,} training, "
            f"{counts['test']:,} test objects; their poses are not known"
        )

    def splits(self) -> tuple[str, ...]:
        """Both."""
        return tuple(self._files)

    def objects(self, split: str) -> list[ObjectRef]:
        """One object a row, in the released order."""
        return [
            ObjectRef(f"row_{row:06d}", int(label), split, f"{split}/{row}")
            for row, label in enumerate(self._labels[split])
        ]

    def load(self, ref: ObjectRef) -> ReleasedRow:
        """The row; ``InputError`` where its points are not finite or all at one place."""
        points = self._row(ref).astype(np.float64)
        centred = points - points.mean(axis=0)
        size = np.linalg.norm(centred, axis=1).max()
        if not (np.isfinite(size) and size > 0):
            raise InputError(f"{ref.location}: the points are not finite or all at one place")
        return ReleasedRow(centred / size, np.eye(3), "none")

    def poses(
        self, shape: ReleasedRow, rngs: Iterable[np.random.Generator]
    ) -> list[tuple[NDArray, NDArray]]:
        """The identity, which is no pose: see ``pose``."""
        return [(shape.rotation, np.zeros(3)) for _ in rngs]

    def digest(self, ref: ObjectRef) -> str:
        """SHA-256 of the row's points."""
        row = self._row(ref)
        return hashlib.sha256(
            np.ascontiguousarray(row, row.dtype.newbyteorder("<")).tobytes()
        ).hexdigest()

    def describe(self) -> dict[str, Any]:
        """The files' names and their labels: two variants of the set differ in both or in one."""
        whole = hashlib.sha256(b"".join(labels.tobytes() for labels in self._labels.values()))
        return {
            "name": "scanobjectnn",
            "files": {split: file.path.name for split, file in self._files.items()},
            "rows": {split: len(labels) for split, labels in self._labels.items()},
            "labels_sha256": whole.hexdigest(),
        }

    def _row(self, ref: ObjectRef) -> NDArray:
        return self._files[ref.split].row("data", int(ref.location.rpartition("/")[2]))


def _pair(path: Path) -> dict[str, Path]:
    """The training and the test file that belong together."""
    if not path.exists():
        raise InputError(f"{path} does not exist; expected a folder of ScanObjectNN's HDF5 files")
    files = hdf5_files(path if path.is_dir() else path.parent)
    pairs: dict[tuple[Path, str], dict[str, Path]] = {}
    for file in files:
        for split, beginning in _BEGINNINGS.items():
            if file.name.startswith(beginning):
                key = file.parent, file.name.removeprefix(beginning)
                pairs.setdefault(key, {})[split] = file
    whole = [pair for pair in pairs.values() if len(pair) == 2]
    if path.is_file():
        whole = [pair for pair in whole if path in pair.values()]
    if len(whole) != 1:
        found = ", ".join(str(pair["train"].relative_to(path)) for pair in whole[:8])
        raise InputError(
            f"{path} has {len(whole) or 'no'} pairs of files training_X.h5 and test_X.h5"
            + (f": {found}; give one of them" if whole else "")
        )
    return {split: whole[0][split] for split in _BEGINNINGS}
