"""Clouds in one HDF5 file, in this project's own layout; and what every HDF5 file is asked."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.cloud_formats.points import padding
from partialbench.dataset.names import printable
from partialbench.dataset.shards import open_hdf5
from partialbench.dataset.sources import ObjectRef, RejectedObject
from partialbench.errors import InputError, parsing
from renderers.sources.listing import SPLITS, Listing

CODE_MAX = 4095
ENCODING = "xyz = code / 4095 * 2 - 1"


class HdfFile:
    """An HDF5 file; each process opens its own handle, so a copy survives a fork or a pickle."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._opened: tuple[int, h5py.File] | None = None
        self._last: tuple[tuple[str, int], NDArray] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": None, "_last": None}

    def open(self) -> h5py.File:
        """This process's handle; ``InputError`` where it is no HDF5 file."""
        if self._opened is None or self._opened[0] != os.getpid():
            try:
                self._opened = os.getpid(), open_hdf5(self.path)
            except OSError as error:
                raise InputError(f"{self.path} is not a readable HDF5 file: {error}") from error
        return self._opened[1]

    def row(self, name: str, row: int) -> NDArray:
        """One row of a data set; ``InputError`` where it cannot be read."""
        if self._last is None or self._last[0] != (name, row):
            try:
                self._last = (name, row), self.open()[name][row]
            except (OSError, RuntimeError) as error:
                raise InputError(f"{self.path}: {name}/{row} is damaged ({error})") from error
        return self._last[1]


def dataset(group: h5py.Group, name: str, where: str) -> h5py.Dataset:
    """A data set; ``InputError`` where it is a group, or a link that leads nowhere."""
    item = group.get(name)
    if not isinstance(item, h5py.Dataset):
        what = "is a group" if isinstance(item, h5py.Group) else "is not there"
        raise InputError(f"{where}: {name} {what}, expected an array")
    return item


def strings(group: h5py.Group, name: str, where: str) -> list[str]:
    """A data set of strings (M,); ``InputError`` for any other, or for one that is no UTF-8."""
    data = dataset(group, name, where)
    if data.ndim != 1 or h5py.check_string_dtype(data.dtype) is None:
        raise InputError(
            f"{where}: {name} is {data.dtype} {data.shape}, expected strings of shape (M,)"
        )
    raw = data[()].tolist()
    try:
        return [item.decode() if isinstance(item, bytes) else str(item) for item in raw]
    except UnicodeDecodeError as error:
        raise InputError(f"{where}: {name} holds {error.object!r}, which is no UTF-8") from error


def whole_labels(
    group: h5py.Group, name: str, classes: int | None, where: str
) -> NDArray[np.int64]:
    """Labels (M,) or (M,1), whole numbers below ``classes``, as (M,) int64.

    Raises:
        InputError: another shape or dtype, a value that is no whole number or has no class.
    """
    return as_labels(np.asarray(dataset(group, name, where)[()]), name, classes, where)


def as_labels(data: NDArray, name: str, classes: int | None, where: str) -> NDArray[np.int64]:
    """As ``whole_labels``, of an array that is already there."""
    if data.ndim not in (1, 2) or (data.ndim == 2 and data.shape[1] != 1):
        raise InputError(
            f"{where}: {name} has shape {data.shape}, expected (M,): one whole number an object"
        )
    if data.dtype.kind not in "iuf":
        raise InputError(f"{where}: {name} is {data.dtype}, expected whole numbers")
    values = np.asarray(data).reshape(-1)
    good = np.isfinite(values) & (values == np.floor(values)) & (values >= 0)
    if not good.all():
        row = int((~good).argmax())
        raise InputError(
            f"{where}: row {row} of {name} is {values[row]}, expected a whole number from 0 on"
        )
    if classes is not None and (values >= classes).any():
        row = int((values >= classes).argmax())
        raise InputError(
            f"{where}: row {row} has {name} {values[row]:g}, but there are {classes} class names"
        )
    return values.astype(np.int64)


def require_counts(group: h5py.Group, names: tuple[str, ...], where: str) -> None:
    """Raise ``InputError`` where data sets do not have as many rows as each other."""
    rows = {name: dataset(group, name, where).shape[:1] for name in names}
    if len(set(rows.values())) > 1:
        said = {name: shape[0] if shape else "one number" for name, shape in rows.items()}
        raise InputError(f"{where}: the counts differ: {said}")


class HdfStore:
    """The project's own layout: groups ``train`` and ``test``, and ``class_names``."""

    def __init__(self, path: Path) -> None:
        self._file = HdfFile(path)
        file = self._file.open()
        with parsing(str(path), "HDF5"):
            if "class_names" not in file or not any(split in file for split in SPLITS):
                raise InputError(
                    f"has {', '.join(file) or 'nothing'}; expected class_names and the groups "
                    f"{' and '.join(SPLITS)}"
                )
            class_names = tuple(strings(file, "class_names", "the file"))
            bare = [name.strip() for name in class_names]
            if len(set(bare)) < len(bare):
                raise InputError(f"class_names has a name twice: {', '.join(class_names)}")
            if "" in bare:
                raise InputError(f"name {bare.index('')} of class_names is empty")
            encoding = file.attrs.get("points_encoding", ENCODING)
            if encoding != ENCODING:
                raise InputError(f"encodes points as {encoding!r}, expected {ENCODING!r}")
            self.listing = Listing(class_names, {}, pattern="HDF5 groups")
            for split in filter(file.__contains__, SPLITS):
                self.listing.objects[split] = self._list(file[split], split)
            others = [
                name
                for name in file
                if name not in SPLITS
                and isinstance(file[name], h5py.Group)
                and "points" in file[name]
            ]
        counts = {split: len(self.listing.of(split)) for split in SPLITS}
        self.listing.words = (
            f"HDF5 groups {' and '.join(self.listing.splits())}: {len(class_names)} classes, "
            f"{counts['train']:,} training, {counts['test']:,} test objects"
            + (f"; left out: the groups {', '.join(others)}" if others else "")
        )
        reason = (
            f"is a group of clouds that is neither {' nor '.join(SPLITS)}; call it one of these"
        )
        self.listing.rejected = [
            RejectedObject(printable(name), "", reason, printable(name), failed=True)
            for name in others
        ]

    def _list(self, group: h5py.Group, split: str) -> list[ObjectRef]:
        where = f"group {split}"
        if not isinstance(group, h5py.Group):
            raise InputError(f"{split} is an array, expected a group of points, label, object_id")
        fields = ("points", "label", "object_id")
        absent = [name for name in fields if name not in group]
        if absent:
            raise InputError(f"{where} lacks {', '.join(absent)}")
        points = dataset(group, "points", where)
        if points.ndim != 3 or (points.shape[1:] == (3, 3)) or 3 not in points.shape[1:]:
            raise InputError(
                f"{where}: points have shape {points.shape}, expected (M,3,N) or (M,N,3)"
            )
        if points.dtype.kind != "f" and points.dtype != np.uint16:
            raise InputError(f"{where}: points are {points.dtype}, expected floats or uint16 codes")
        require_counts(group, fields, where)
        labels = whole_labels(group, "label", len(self.listing.class_names), where)
        ids = strings(group, "object_id", where)
        return [
            ObjectRef(printable(name), int(label), split, f"{split}/{row}")
            for row, (name, label) in enumerate(zip(ids, labels, strict=True))
        ]

    def _row(self, ref: ObjectRef) -> NDArray:
        split, _, row = ref.location.partition("/")
        return self._file.row(f"{split}/points", int(row))

    def stored(self, ref: ObjectRef) -> bytes:
        row = self._row(ref)
        return np.ascontiguousarray(row, row.dtype.newbyteorder("<")).tobytes()

    def cloud(self, ref: ObjectRef) -> tuple[NDArray[np.float64], None]:
        row = self._row(ref)
        points = row.astype(np.float64)
        if row.dtype.kind != "f":
            if row.max(initial=0) > CODE_MAX:
                raise InputError(
                    f"{self._file.path}: {ref.location} has the code {row.max()}, above {CODE_MAX}"
                )
            # Decoded, padding with zeros would be a corner of the cube.
            if padded := int(padding(points.T if len(points) == 3 else points).sum()):
                raise InputError(
                    f"{self._file.path}: {ref.location} has {padded} points of the codes "
                    f"(0, 0, 0), as arrays are padded; remove them"
                )
            points = points / CODE_MAX * 2 - 1
        return (points.T if len(points) == 3 else points), None
