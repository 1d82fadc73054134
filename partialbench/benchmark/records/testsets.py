"""What is true of the clouds of a test set: stored once, for all that were tested on it.

In ``testsets/`` of a results folder, a file named by the digest of its content. A record names it
by that digest, so rows that are compared were measured against the same labels, ids and poses.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from partialbench.benchmark.clouds import Clouds
from partialbench.benchmark.records import archive
from partialbench.dataset.shards import write_atomically
from partialbench.errors import InputError
from partialbench.geometry.symmetry import GROUPS

FOLDER = "testsets"
DIGITS = 12
"""Hexadecimal digits of the digest in a file's name."""


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """M test clouds, in the order of the data set's rows.

    Attributes:
        rows: (M,) int32 row numbers of the test split.
        labels: (M,) int16 true class, index into ``class_names``.
        object_ids: (M,) str. views: (M,) int32. visible_fraction: (M,) float32.
        quaternions: (M,4) float32 R_camera_object as x, y, z, w; see ``rotations``.
        symmetries: (M,) str group names.
        class_names: (K,) str.
    """

    rows: NDArray[np.int32]
    labels: NDArray[np.int16]
    object_ids: NDArray[np.str_]
    views: NDArray[np.int32]
    quaternions: NDArray[np.float32]
    symmetries: NDArray[np.str_]
    visible_fraction: NDArray[np.float32]
    class_names: NDArray[np.str_]

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def rotations(self) -> NDArray[np.float64]:
        """(M,3,3) R_camera_object, rotations to the last bit of float64.

        A rounded matrix would not be: an eighth of the mapped poses of objects with z-inf symmetry
        lie exactly between two bins, and which is "the nearest" must not hang on rounding.
        """
        return Rotation.from_quat(self.quaternions.astype(np.float64)).as_matrix()

    @property
    def truth_arrays(self) -> dict[str, NDArray]:
        """What is stored, text no wider than it must be: equal content has equal bytes."""
        arrays = {f.name: np.asarray(getattr(self, f.name)) for f in fields(GroundTruth)}
        return {
            name: np.array(values.tolist(), str) if values.dtype.kind == "U" else values
            for name, values in arrays.items()
        }

    @property
    def truth_sha256(self) -> str:
        """The digest a record names it by."""
        return archive.content_digest(self.truth_arrays)


_TYPES = {
    "rows": np.int32, "labels": np.int16, "views": np.int32, "quaternions": np.float32,
    "visible_fraction": np.float32,
}  # fmt: skip


def of(dataset: Clouds, rows: NDArray[np.int64]) -> GroundTruth:
    """The truth of these rows of a test split."""
    return GroundTruth(
        rows=rows.astype(np.int32),
        labels=dataset.labels[rows].astype(np.int16),
        object_ids=dataset.object_ids[rows],
        views=dataset.views[rows].astype(np.int32),
        quaternions=Rotation.from_matrix(dataset.rotations[rows]).as_quat().astype(np.float32),
        symmetries=dataset.symmetries[rows],
        visible_fraction=dataset.visible_fraction[rows].astype(np.float32),
        class_names=np.array(dataset.class_names, str),
    )


def path_of(folder: Path, sha256: str) -> Path:
    """Where the results folder has, or would have, the truth of this digest."""
    return folder / FOLDER / f"{sha256[:DIGITS]}.npz"


def write(folder: Path, truth: GroundTruth) -> str:
    """Stores it in a results folder, unless it is there; returns its digest."""
    digest = truth.truth_sha256
    path = path_of(folder, digest)
    try:
        load(folder, digest)
    except InputError:  # absent or damaged
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, archive.to_bytes(truth.truth_arrays))
    return digest


def load(folder: Path, sha256: str) -> GroundTruth:
    """The truth of this digest.

    Raises:
        InputError: the folder has it not, or something else under its name.
    """
    path = path_of(folder, sha256)
    try:
        status = path.stat()
    except OSError:
        raise InputError(
            f"{path} is missing: the labels and poses of a test set, which records name; copy the "
            f"folder {FOLDER}/ along with them, or run one of the evaluations again"
        ) from None
    return _load(path, sha256, status.st_mtime_ns, status.st_size)


@functools.lru_cache(maxsize=32)
def _load(path: Path, sha256: str, _mtime: int, _size: int) -> GroundTruth:
    names = [field.name for field in fields(GroundTruth)]
    arrays = archive.from_bytes(path.read_bytes(), names, path, "the truth of a test set")
    found = archive.content_digest(arrays)
    if found != sha256:
        raise InputError(
            f"{path} does not hold the test set its records name: digest {found}, expected "
            f"{sha256}; it was changed after it was written. Run one of the evaluations again"
        )
    fault = _fault(arrays)
    if fault:
        raise InputError(f"{path} is not the truth of a test set: {fault}")
    for values in arrays.values():  # one copy is handed to all
        values.flags.writeable = False
    return GroundTruth(**arrays)


def _fault(arrays: dict[str, NDArray]) -> str:
    """The first thing that cannot be true, "" for nothing."""
    size, classes = arrays["labels"].shape, len(arrays["class_names"])
    for name, values in arrays.items():
        kind = np.dtype(_TYPES[name]) if name in _TYPES else None
        if values.dtype != kind if kind else values.dtype.kind != "U":
            return f"{name} is of type {values.dtype}, expected {kind or 'text'}"
        if name != "class_names":
            expected = (*size, 4) if name == "quaternions" else size
            if len(size) != 1 or values.shape != expected:
                return f"{name} has shape {values.shape}, labels have {size}"
    if not size[0]:
        return "it has no clouds"
    labels, norms = arrays["labels"], np.linalg.norm(arrays["quaternions"].astype(float), axis=1)
    if labels.min() < 0 or labels.max() >= classes:
        return f"labels lie in {labels.min()} … {labels.max()}, and there are {classes} classes"
    if not (np.abs(norms - 1) < 1e-3).all():
        return "a quaternion is not of length 1"
    if unknown := set(arrays["symmetries"].tolist()) - set(GROUPS):
        return f"unknown symmetries {sorted(unknown)}"
    seen = arrays["visible_fraction"]
    if not ((seen >= 0) & (seen <= 1)).all():
        return "a visible fraction does not lie in [0, 1]"
    if arrays["rows"].min() < 0 or len(np.unique(arrays["rows"])) < size[0]:
        return "a row number is negative or comes twice"
    return ""
