"""Complete clouds as a source: an HDF5 file of many, or a folder of one file an object."""

from __future__ import annotations

import hashlib
import json
import os
from os import PathLike
from pathlib import Path, PurePosixPath
from typing import Any, Protocol

import h5py
import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.categories import MODELNET40
from partialbench.dataset.cloud_files import SUFFIXES, read_cloud
from partialbench.dataset.sources import ObjectRef, RejectedObject
from partialbench.errors import InputError
from renderers.sources.files import SPLITS, Directory
from renderers.sources.folder import LAYOUT, split_of

CODE_MAX = 4095
ENCODING = "xyz = code / 4095 * 2 - 1"


class CompleteClouds:
    """Complete clouds, normalised: bounding-box centre at the origin, largest norm 1.

    Either an HDF5 file with the groups ``train`` and ``test`` (at least one), each with ``points``
    ((M,3,N) or (M,N,3): floats, or uint16 codes with xyz = code/4095·2 − 1), ``label`` (M,) and
    ``object_id`` (M,), and ``class_names`` beside them; or a folder of PLY, PCD, XYZ, TXT or NPY
    files as ``<class>/<split>/<file>`` or ``<class>/<file>``. Files are read when asked for.

    Normalising again is not idle for stored clouds: a cloud sampled from a mesh with a stray vertex
    sits away from the centre of that mesh's box.

    Args:
        path: the file or the folder.
        up: the files' upward axis, "z" or "y" (y is turned onto z).
        aligned: whether all objects of a class face the same way, as pose labels need; by default
            yes for an HDF5 file, no for a folder.

    Attributes: as ``partialbench.dataset.sources.Source``.

    Raises:
        InputError: nothing is there, the layout is another, labels without a class name, no cloud.
    """

    def __init__(
        self, path: str | PathLike[str], up: str = "z", aligned: bool | None = None
    ) -> None:
        if up not in ("z", "y"):
            raise InputError(f"up must be one of z, y, got {up!r}")
        path = Path(path)
        if not path.exists():
            raise InputError(f"{path} does not exist; expected an HDF5 file or a folder of clouds")
        self._store: _Store = _FolderStore(path) if path.is_dir() else _HdfStore(path)
        self.up = up
        self.frame = "aligned" if (path.is_file() if aligned is None else aligned) else "original"
        self.class_names = self._store.class_names
        self.rejected = self._store.rejected

    def splits(self) -> tuple[str, ...]:
        """The splits that have objects."""
        return tuple(split for split in SPLITS if self._store.refs.get(split))

    def objects(self, split: str) -> list[ObjectRef]:
        """The split's objects in the file's order, or by class and name for a folder."""
        if split not in SPLITS:
            raise InputError(f"no split {split!r}; expected one of {', '.join(SPLITS)}")
        return list(self._store.refs.get(split, []))

    def load(self, ref: ObjectRef) -> NDArray[np.float32]:
        """The cloud, (n,3) float32, object frame, z up, in the unit ball."""
        points = self._store.points(ref)
        if self.up == "y":
            x, y, z = points.T
            points = np.stack([x, -z, y], axis=1)
        return normalise_cloud(points, ref.location)

    def digest(self, ref: ObjectRef) -> str:
        """SHA-256 of the file's bytes, or of the object's stored numbers in an HDF5 file."""
        return hashlib.sha256(self._store.stored(ref)).hexdigest()

    def describe(self) -> dict[str, Any]:
        """What defines the source: where it lies does not, what it lists does."""
        listing = [(r.split, r.object_id, r.label) for s in SPLITS for r in self.objects(s)]
        return {
            "name": "clouds",
            "frame": self.frame,
            "up": self.up,
            "objects": {split: len(self.objects(split)) for split in self.splits()},
            "listing_sha256": hashlib.sha256(json.dumps(listing).encode()).hexdigest(),
        }


def normalise_cloud(points: NDArray, name: str = "the cloud") -> NDArray[np.float32]:
    """(n,3) points with the bounding-box centre at the origin and the largest norm 1, float32.

    Raises:
        InputError: points that are not finite, or all at one place.
    """
    points = np.asarray(points, np.float64)
    if not np.isfinite(points).all():
        raise InputError(f"{name}: has points that are NaN or infinite")
    centred = points - (points.min(axis=0) / 2 + points.max(axis=0) / 2)
    extent = np.abs(centred).max()
    if extent == 0:
        raise InputError(f"{name}: all {len(points)} points are at {points[0].tolist()}")
    # By the extent first, so that the squares neither overflow nor vanish.
    centred /= extent
    return (centred / np.linalg.norm(centred, axis=1).max()).astype(np.float32)


class _Store(Protocol):
    """Where the clouds lie: what is there, and one object's numbers as stored and as points."""

    class_names: tuple[str, ...]
    refs: dict[str, list[ObjectRef]]
    rejected: list[RejectedObject]

    def points(self, ref: ObjectRef) -> NDArray[np.float64]: ...

    def stored(self, ref: ObjectRef) -> bytes: ...


class _FolderStore:
    """A folder of one file an object; object ids are "<class>/<file without suffix>"."""

    def __init__(self, root: Path) -> None:
        self.files = Directory(root)
        self.rejected: list[RejectedObject] = []
        self._last: tuple[str, bytes] | None = None
        names = [n for n in self.files.names() if PurePosixPath(n).suffix.lower() in SUFFIXES]
        # The preferred format of an object first: the others are then turned away.
        names.sort(key=lambda n: SUFFIXES.index(PurePosixPath(n).suffix.lower()))
        found: dict[tuple[str, str], tuple[str, str]] = {}
        for location in names:
            *folders, _ = location.split("/")
            object_id = f"{folders[0]}/{PurePosixPath(location).stem}" if folders else location
            if len(folders) == 1:
                split = split_of(object_id)
            elif len(folders) == 2 and folders[1] in SPLITS:
                split = folders[1]
            else:
                self._reject(object_id, "", f"does not lie as {LAYOUT}", location)
                continue
            if (split, object_id) in found:
                self._reject(object_id, split, "another file gives this object", location)
                continue
            found[split, object_id] = folders[0], location
        if not found:
            raise InputError(
                f"{root} holds no clouds: looked for {', '.join(SUFFIXES)} as {LAYOUT}, found "
                f"{len(names)} files of these formats elsewhere"
            )
        present = sorted({category for category, _ in found.values()})
        known = set(present) <= set(MODELNET40)
        self.class_names: tuple[str, ...] = MODELNET40 if known else tuple(present)
        self.refs: dict[str, list[ObjectRef]] = {split: [] for split in SPLITS}
        for (split, object_id), (category, location) in sorted(found.items()):
            label = self.class_names.index(category)
            self.refs[split].append(ObjectRef(object_id, label, split, location))

    def _reject(self, object_id: str, split: str, reason: str, location: str) -> None:
        self.rejected.append(RejectedObject(object_id, split, reason, location))

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_last": None}

    def points(self, ref: ObjectRef) -> NDArray[np.float64]:
        return read_cloud(self.stored(ref), ref.location)

    def stored(self, ref: ObjectRef) -> bytes:
        # A build asks for the digest and the cloud of an object one after the other.
        if self._last is None or self._last[0] != ref.location:
            self._last = ref.location, self.files.read(ref.location)
        return self._last[1]


class _HdfStore:
    """An HDF5 file; each process opens its own handle, so a copy survives a fork or a pickle."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rejected: list[RejectedObject] = []
        self._opened: tuple[int, h5py.File] | None = None
        self._last: tuple[ObjectRef, NDArray] | None = None
        file = self._file()
        if "class_names" not in file or not any(split in file for split in SPLITS):
            raise InputError(
                f"{path} has {', '.join(file) or 'nothing'}; expected class_names and the groups "
                f"{' and '.join(SPLITS)}"
            )
        self.class_names: tuple[str, ...] = tuple(file["class_names"].asstr()[()])
        encoding = file.attrs.get("points_encoding", ENCODING)
        if encoding != ENCODING:
            raise InputError(f"{path} encodes points as {encoding!r}, expected {ENCODING!r}")
        self.refs = {split: self._list(file[split], split) for split in SPLITS if split in file}

    def _list(self, group: h5py.Group, split: str) -> list[ObjectRef]:
        where = f"{self.path}, group {split}"
        absent = [name for name in ("points", "label", "object_id") if name not in group]
        if absent:
            raise InputError(f"{where} lacks {', '.join(absent)}")
        points = group["points"]
        if points.ndim != 3 or 3 not in points.shape[1:]:
            raise InputError(f"{where}: points have shape {points.shape}, expected (M,3,N)")
        if points.dtype.kind != "f" and points.dtype != np.uint16:
            raise InputError(f"{where}: points are {points.dtype}, expected floats or uint16 codes")
        rows = {name: len(group[name]) for name in ("points", "label", "object_id")}
        if len(set(rows.values())) > 1:
            raise InputError(f"{where}: the counts differ: {rows}")
        labels = group["label"][()].astype(np.int64).reshape(-1)
        wrong = (labels < 0) | (labels >= len(self.class_names))
        if wrong.any():
            raise InputError(
                f"{where}: row {wrong.argmax()} has label {labels[wrong.argmax()]}, but there are "
                f"{len(self.class_names)} class names"
            )
        return [
            ObjectRef(object_id, int(label), split, f"{split}/{row}")
            for row, (object_id, label) in enumerate(
                zip(group["object_id"].asstr()[()], labels, strict=True)
            )
        ]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": None, "_last": None}

    def _file(self) -> h5py.File:
        if self._opened is None or self._opened[0] != os.getpid():
            try:
                self._opened = os.getpid(), h5py.File(self.path, "r")
            except OSError as error:
                raise InputError(f"{self.path} is not a readable HDF5 file: {error}") from error
        return self._opened[1]

    def _row(self, ref: ObjectRef) -> NDArray:
        """The object's numbers as stored."""
        if self._last is None or self._last[0] != ref:
            split, _, row = ref.location.partition("/")
            try:
                self._last = ref, self._file()[split]["points"][int(row)]
            except OSError as error:
                raise InputError(f"{self.path}: {ref.location} is damaged ({error})") from error
        return self._last[1]

    def stored(self, ref: ObjectRef) -> bytes:
        row = self._row(ref)
        return np.ascontiguousarray(row, row.dtype.newbyteorder("<")).tobytes()

    def points(self, ref: ObjectRef) -> NDArray[np.float64]:
        row = self._row(ref)
        points = row.astype(np.float64)
        if row.dtype.kind != "f":
            if row.max(initial=0) > CODE_MAX:
                raise InputError(
                    f"{self.path}: {ref.location} has the code {row.max()}, above {CODE_MAX}"
                )
            points = points / CODE_MAX * 2 - 1
        return points.T if len(points) == 3 else points
