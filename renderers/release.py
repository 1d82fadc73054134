"""The arrays that the paper's authors released, as a data folder like any other.

TerenceHsu666/PAPNet@878adcc reads ``{train,test}_points.npy`` (M,N,3), ``_labels.npy`` (M,) or
(M,1) and ``_gt_rot.npy`` (M,3,3), the rotation canonical → observed, which is our R_camera_object.
The release gives neither translation nor scale, nor which rows show the same object.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from partialbench import given
from partialbench.dataset.build import BuildPlan, build
from partialbench.dataset.categories import MODELNET40, PS15
from partialbench.dataset.executors import InlineExecutor
from partialbench.dataset.manifest import Manifest
from partialbench.dataset.rows import Job
from partialbench.dataset.sources import ObjectRef, RejectedObject, RejectedView, View
from partialbench.errors import InputError
from partialbench.geometry.portable import polar_rotation
from partialbench.geometry.rotations import is_rotation
from renderers.sources.cloud_store import as_labels

SPLITS = ("train", "test")
ROTATION_TOLERANCE = 1e-3
"""Largest entry of |R·Rᵀ − I| that passes for rounding in the file."""


@dataclass(frozen=True)
class ReleasedSplit:
    """One split's arrays, row by row.

    Attributes:
        points: (M,N,3) float, observed frame, mapped from the file, not read.
        labels: (M,) int64.
        rotations: (M,3,3) float64 rotations canonical → observed, orthonormal to rounding.
    """

    points: NDArray[np.floating]
    labels: NDArray[np.int64]
    rotations: NDArray[np.float64]


def read_release(folder: str | PathLike[str]) -> dict[str, ReleasedSplit]:
    """The released arrays of both splits, checked.

    Raises:
        InputError: a file is missing or not a plain array, a shape is not as above, counts differ,
            labels are not whole numbers of a class, or a matrix is not a rotation.
    """
    folder = given.path(folder, "the release")
    names = [f"{s}_{what}.npy" for s in SPLITS for what in ("points", "labels", "gt_rot")]
    missing = [name for name in names if not (folder / name).is_file()]
    if missing:
        raise InputError(
            f"{folder} lacks {', '.join(missing)}; expected the six files {', '.join(names)}"
        )
    return {split: _read_split(folder, split) for split in SPLITS}


def import_release(
    folder: str | PathLike[str], out: str | PathLike[str], data_set: str | None = None
) -> Manifest:
    """Write the released arrays as shards, rows in the released order.

    A row keeps its number of points: all that differ, then repeats of them drawn at random. The
    data set is ``pm40-release`` or ``ps15-release``, as ``data_set`` ("pm40" or "ps15") says; it
    may be left out where a label is above PS15's, for then it can be PM40 only. Every row is its
    own object with one view, named ``row_000000`` and on. A cloud is centred on its centroid and
    scaled into the unit ball, as the paper's network does first; t_camera_object is zero. The share
    of the surface seen is not known: ``visible_fraction`` is 0 throughout. The release maps PM40's
    poses by class symmetry and PS15's not at all: PS15's rows have the symmetry "none".

    Returns:
        The finished folder's manifest. A repeated import continues or returns it.

    Raises:
        InputError: as ``read_release``; the labels do not tell the data set and it is not given, or
            they do not fit it. ConfigurationMismatchError: the folder holds other data.
    """
    source = ReleasedRows(given.path(folder, "the release"), data_set)
    job = Job(
        source=source,
        occluder=AsReleased(),
        dataset_id=source.dataset_id,
        setting="partial",
        views=dict.fromkeys(SPLITS, 1),
        points=source.points_per_row,
        seed=0,
        min_visible=1,  # as released, whatever they show
    )
    return build(BuildPlan(job, given.path(out, "the data folder"), SPLITS), InlineExecutor)


@dataclass(frozen=True)
class ReleasedRow:
    """One row: (N,3) float64 points in the unit ball, R_camera_object (3,3), and the name of its
    symmetry group, None for its class's."""

    points: NDArray[np.float64]
    rotation: NDArray[np.float64]
    symmetry: str | None = None


class ReleasedRows:
    """The released rows as a source. Attributes: as ``partialbench.dataset.sources.Source``."""

    frame = "aligned"

    def __init__(self, folder: str | PathLike[str], data_set: str | None = None) -> None:
        self._folder = Path(folder)
        self._splits = read_release(folder)
        widths = {split: data.points.shape[1] for split, data in self._splits.items()}
        if len(set(widths.values())) > 1:
            raise InputError(f"{folder}: the splits differ in points per row: {widths}")
        self.points_per_row = widths["train"]
        highest = max(int(data.labels.max()) for data in self._splits.values())
        is_ps15 = self._is_ps15(data_set, highest)
        self._data_set = "ps15" if is_ps15 else "pm40"
        self.dataset_id = "ps15-release" if is_ps15 else "pm40-release"
        self.class_names: tuple[str, ...] = PS15 if is_ps15 else MODELNET40
        self.rejected: list[RejectedObject] = []

    def _is_ps15(self, data_set: str | None, highest: int) -> bool:
        if data_set not in (None, "pm40", "ps15"):
            raise InputError(f"data_set must be pm40 or ps15, got {data_set!r}")
        if highest >= len(PS15):
            if data_set == "ps15":
                raise InputError(
                    f"{self._folder}: there are labels up to {highest}, PS15 has {len(PS15)} "
                    f"classes: these are not its arrays"
                )
            return False
        if data_set is None:
            raise InputError(
                f"{self._folder}: all labels are below {len(PS15)}, so the arrays may be of PS15 "
                f"or of some classes of PM40; say which with --data-set pm40 or ps15"
            )
        return data_set == "ps15"

    def __getstate__(self) -> dict[str, Any]:
        # Arrays mapped from files would be pickled whole.
        return {"folder": self._folder, "data_set": self._data_set}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["folder"], state["data_set"])  # type: ignore[misc]

    def splits(self) -> tuple[str, ...]:
        """Both."""
        return SPLITS

    def objects(self, split: str) -> list[ObjectRef]:
        """One object a row, in the released order."""
        return [
            ObjectRef(f"row_{row:06d}", int(label), split, f"{split}/{row}")
            for row, label in enumerate(self._splits[split].labels)
        ]

    def load(self, ref: ObjectRef) -> ReleasedRow:
        """The row; ``InputError`` where its points are not finite or all at one place."""
        points, rotation = self._row(ref)
        centred = points - points.mean(axis=0)
        size = np.linalg.norm(centred, axis=1).max()
        if not (np.isfinite(size) and size > 0):
            raise InputError(f"{ref.location}: the points are not finite or all at one place")
        symmetry = "none" if self.dataset_id == "ps15-release" else None
        return ReleasedRow(centred / size, rotation, symmetry)

    def poses(
        self, shape: ReleasedRow, rngs: Iterable[np.random.Generator]
    ) -> list[tuple[NDArray, NDArray]]:
        """The row's own rotation, without a translation."""
        return [(shape.rotation, np.zeros(3)) for _ in rngs]

    def digest(self, ref: ObjectRef) -> str:
        """SHA-256 of the row's points and rotation as float64."""
        points, rotation = self._row(ref)
        return hashlib.sha256(points.tobytes() + rotation.tobytes()).hexdigest()

    def describe(self) -> dict[str, Any]:
        """Counts, and a digest of all labels and rotations."""
        whole = hashlib.sha256()
        for data in self._splits.values():
            whole.update(data.labels.tobytes() + data.rotations.tobytes())
        rows = {split: len(data.labels) for split, data in self._splits.items()}
        symmetry = "none" if self.dataset_id == "ps15-release" else "of the class"
        return {
            "name": "papnet-release", "rows": rows, "symmetry": symmetry,
            "annotations_sha256": whole.hexdigest(),
        }  # fmt: skip

    def _row(self, ref: ObjectRef) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        data, row = self._splits[ref.split], int(ref.location.rpartition("/")[2])
        return np.array(data.points[row], np.float64), data.rotations[row]


class AsReleased:
    """Views that show a released row's points, each once."""

    def views(
        self,
        shape: ReleasedRow,
        poses: list[tuple[NDArray, NDArray]],
        rngs: list[np.random.Generator],
    ) -> list[View | RejectedView]:
        """One view per pose with the row's distinct points, in the released order."""
        stored = shape.points.astype(np.float32)
        # The builder repeats points behind the distinct ones; the release has its repeats among
        # them, where a reader of the first n_visible would meet them.
        _, first = np.unique(stored, axis=0, return_index=True)
        points = stored[np.sort(first)]
        return [
            View(
                points, rotation, translation, np.zeros((3, 3)), 0.0, len(points),
                symmetry=shape.symmetry,
            )
            for rotation, translation in poses
        ]  # fmt: skip

    def describe(self) -> dict[str, Any]:
        """Name, and what is done to repeats."""
        return {"name": "as-released", "repeats": "behind the distinct points"}


def _read_split(folder: Path, split: str) -> ReleasedSplit:
    points = _load(folder / f"{split}_points.npy")
    labels = _load(folder / f"{split}_labels.npy")
    rotations = _load(folder / f"{split}_gt_rot.npy")
    where = f"{folder}, {split}"
    if points.ndim != 3 or points.shape[2] != 3 or 0 in points.shape or points.dtype.kind != "f":
        raise InputError(
            f"{where}_points.npy is {points.dtype} {points.shape}, expected floats of shape (M,N,3)"
        )
    known = as_labels(labels, "label", len(MODELNET40), f"{where}_labels.npy")
    if rotations.ndim != 3 or rotations.shape[1:] != (3, 3) or rotations.dtype.kind not in "fiu":
        raise InputError(
            f"{where}_gt_rot.npy is {rotations.dtype} {rotations.shape}, expected (M,3,3) real "
            f"numbers"
        )
    rows = {"points": len(points), "labels": len(labels), "gt_rot": len(rotations)}
    if len(set(rows.values())) > 1:
        raise InputError(f"{where}: the counts differ: {rows}")
    return ReleasedSplit(points, known, _orthonormal(rotations, where))


def _load(path: Path) -> NDArray:
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise InputError(f"{path} is not a readable .npy array: {error}") from error
    if not isinstance(array, np.ndarray):  # NumPy goes by the content, whatever it is called
        array.close()
        raise InputError(f"{path} is an archive of arrays (NPZ), expected one .npy array")
    return array


def _orthonormal(rotations: NDArray, where: str) -> NDArray[np.float64]:
    """The nearest exact rotations, where the given ones are rotations to rounding."""
    matrices = np.asarray(rotations, np.float64)
    good = is_rotation(matrices, ROTATION_TOLERANCE)
    if not good.all():
        row = int((~good).argmax())
        raise InputError(
            f"{where}_gt_rot.npy: {(~good).sum()} of {len(good)} matrices are no rotations "
            f"(finite, R·Rᵀ = I within {ROTATION_TOLERANCE:g}, det > 0), the first is row {row}: "
            f"{matrices[row].round(4).tolist()}"
        )
    return polar_rotation(matrices)
