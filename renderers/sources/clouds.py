"""Complete clouds as a source: an HDF5 file of many, a release of them, or one file an object."""

from __future__ import annotations

import hashlib
import zipfile
from os import PathLike
from pathlib import Path, PurePosixPath
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.categories import MODELNET40
from partialbench.dataset.cloud_files import FORMATS, read_oriented
from partialbench.dataset.cloud_formats.points import padding
from partialbench.dataset.cloud_formats.text import SUFFIXES as TEXT
from partialbench.dataset.cloud_formats.text import looks_like_points
from partialbench.dataset.names import printable
from partialbench.dataset.sources import ObjectRef, OrientedCloud
from partialbench.errors import InputError
from renderers.sources.cloud_store import HdfStore
from renderers.sources.files import HEAD, Files, open_files
from renderers.sources.folder import EXPECTED
from renderers.sources.listing import Listing, list_tree
from renderers.sources.lists import is_list
from renderers.sources.ply_hdf5 import PlyHdf5Store, fields_of, hdf5_files, is_ply_hdf5

UPS = ("z", "y")
_PROSE = ("readme", "license", "licence", "notes", "changelog", "citation", "metadata", "index")


class CompleteClouds:
    """Complete clouds, normalised: bounding-box centre at the origin, largest norm 1.

    Either an HDF5 file with the groups ``train`` and ``test`` (at least one), each with ``points``
    ((M,3,N) or (M,N,3): floats, or uint16 codes with xyz = code/4095·2 − 1), ``label`` (M,) and
    ``object_id`` (M,), and ``class_names`` beside them; or the folder or a file of
    modelnet40_ply_hdf5_2048; or a folder or zip of files as ``cloud_files`` reads them, in any
    layout that ``layout`` understands. Files are read when asked for.

    Its data set is pm40-clouds if it has all of ModelNet40's forty classes, aligned.
    Points that are there more than once count once, as files padded to a fixed size repeat some.
    Normalising again is not idle for stored clouds: a cloud sampled from a mesh with a stray vertex
    sits away from the centre of that mesh's box.

    Args:
        path: the file or the folder.
        up: the files' upward axis, "z" or "y" (y is turned onto z); by default "y" for
            modelnet40_ply_hdf5_2048, which is published so, "z" for all others.
        aligned: whether all objects of a class face the same way, as pose labels need; by default
            yes for an HDF5 file of the first kind, no for all others.

    Attributes: as ``partialbench.dataset.sources.Source``.

    Raises:
        InputError: nothing is there, the layout is another, labels without a class name, no cloud.
    """

    def __init__(
        self, path: str | PathLike[str], up: str | None = None, aligned: bool | None = None
    ) -> None:
        if up not in (*UPS, None):
            raise InputError(f"up must be one of {', '.join(UPS)}, got {up!r}")
        path = Path(path)
        if not path.exists():
            raise InputError(f"{path} does not exist; expected an HDF5 file or a folder of clouds")
        self._store = _store(path)
        own = isinstance(self._store, HdfStore)
        self.up = up or ("y" if isinstance(self._store, PlyHdf5Store) else "z")
        self.frame = "aligned" if (own if aligned is None else aligned) else "original"
        listed = self._store.listing
        self.class_names = listed.class_names
        self.rejected = listed.rejected
        self.listing = listed.words
        if up is None and any("modelnet40_train.txt" in note for note in listed.notes):
            # PointNet++, which published it, turns it about y for "up".
            self.listing += "; modelnet40_normal_resampled has y up: if it is that, say --up y"
        refs = [ref for split in listed.splits() for ref in listed.of(split)]
        present = {self.class_names[ref.label] for ref in refs}
        forty = present == set(MODELNET40) and self.frame == "aligned"
        self.name = "clouds" if forty else "custom-clouds"

    def splits(self) -> tuple[str, ...]:
        """The splits that have objects."""
        return self._store.listing.splits()

    def objects(self, split: str) -> list[ObjectRef]:
        """The split's objects in the file's order, or by class and name for a folder."""
        return self._store.listing.of(split)

    def load(self, ref: ObjectRef) -> NDArray[np.float32] | OrientedCloud:
        """The cloud, (n,3) float32, object frame, z up, in the unit ball; with its normals where
        the file has them.

        Raises:
            InputError: what is wrong with the file; all points at one place; rows of zeros, which
                are padding or no measurement.
        """
        name = printable(ref.location)
        stored, normals = self._store.cloud(ref)
        points = normalise_cloud(self._turned(stored), name)
        _, first = np.unique(points, axis=0, return_index=True)
        first.sort()
        if normals is None:
            return points[first]
        return OrientedCloud(points[first], self._turned(normals[first]).astype(np.float32))

    def _turned(self, vectors: NDArray) -> NDArray:
        if self.up == "z":
            return vectors
        x, y, z = vectors.T
        return np.stack([x, -z, y], axis=1)

    def digest(self, ref: ObjectRef) -> str:
        """SHA-256 of the file's bytes, or of the object's stored numbers in an HDF5 file."""
        return hashlib.sha256(self._store.stored(ref)).hexdigest()

    def describe(self) -> dict[str, Any]:
        """What defines the source: where it lies does not, what it lists does."""
        listed = self._store.listing.describe()
        return {"name": self.name, "frame": self.frame, "up": self.up, **listed}


def normalise_cloud(points: NDArray, name: str = "the cloud") -> NDArray[np.float32]:
    """(n,3) points with the bounding-box centre at the origin and the largest norm 1, float32.

    Raises:
        InputError: points that are not finite, all at one place, or padded with zeros.
    """
    points = np.asarray(points, np.float64)
    _require_no_padding(points, name)
    if not np.isfinite(points).all():
        raise InputError(f"{name}: has points that are NaN or infinite")
    centred = points - (points.min(axis=0) / 2 + points.max(axis=0) / 2)
    extent = np.abs(centred).max()
    if extent == 0:
        raise InputError(f"{name}: all {len(points)} points are at {points[0].tolist()}")
    # By the extent first, so that the squares neither overflow nor vanish.
    centred /= extent
    return (centred / np.linalg.norm(centred, axis=1).max()).astype(np.float32)


def _require_no_padding(points: NDArray, name: str) -> None:
    if count := int(padding(points).sum()):
        raise InputError(
            f"{name}: {count} of {len(points)} points are (0, 0, 0), as files are padded or say "
            f"that nothing was measured; remove them"
        )


class _Store(Protocol):
    """Where the clouds lie: what is there, and one object's numbers as stored and as points."""

    listing: Listing

    def cloud(self, ref: ObjectRef) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]: ...

    def stored(self, ref: ObjectRef) -> bytes: ...


def _store(path: Path) -> _Store:
    if is_ply_hdf5(path):
        return PlyHdf5Store(path)
    if any("mask" in fields_of(file) for file in hdf5_files(path)):
        raise InputError(
            f"{path} is ScanObjectNN's: parts of objects as they were scanned, whose poses nobody "
            f"knows. They are no complete clouds to render; make the data set of them as they are "
            f"with 'partialbench import scanobjectnn {path} --out DIR'"
        )
    if path.is_dir() or zipfile.is_zipfile(path):
        return _FileStore(open_files(path))
    return HdfStore(path)


def cloud_locations(files: Files) -> list[str]:
    """The files of a tree that may be clouds, by their names and, where those fit lists and
    prose too, by how they begin."""
    return [name for name in files.names() if _may_be_cloud(files, name)]


def _may_be_cloud(files: Files, name: str) -> bool:
    path = PurePosixPath(name)
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        return False
    if suffix not in TEXT:
        return True
    # A table lies in a class's folder; at the top, and by these names, it may be anything.
    doubtful = len(path.parts) == 1 or is_list(name) or path.stem.lower() in _PROSE
    return not doubtful or looks_like_points(files.head(name, HEAD))


class _FileStore:
    """One file an object."""

    def __init__(self, files: Files) -> None:
        self.files = files
        self._last: tuple[str, bytes] | None = None
        locations = cloud_locations(files)
        found = list_tree(files, locations, FORMATS)
        if found is None:
            raise InputError(
                f"{files} holds no clouds: looked for {', '.join(FORMATS)} as {EXPECTED}, found "
                f"{len(locations)} files of these formats elsewhere"
            )
        self.listing = found

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_last": None}

    def cloud(self, ref: ObjectRef) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        return read_oriented(self.stored(ref), printable(ref.location))

    def stored(self, ref: ObjectRef) -> bytes:
        # A build asks for the digest and the cloud of an object one after the other.
        if self._last is None or self._last[0] != ref.location:
            self._last = ref.location, self.files.read(ref.location)
        return self._last[1]
