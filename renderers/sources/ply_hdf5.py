"""modelnet40_ply_hdf5_2048, the clouds of PointNet's release: HDF5 files, lists, names of classes.

Each file has ``data`` (M,N,3), ``label`` (M,1) and ``normal`` (M,N,3). ``train_files.txt`` and
``test_files.txt`` are its official splits, ``shape_names.txt`` its classes, and
``ply_data_train_0_id2file.json`` says which mesh each row of ``ply_data_train0.h5`` is of. y is up:
PointNet turns its training clouds about y.
"""

from __future__ import annotations

import json
import re
from pathlib import Path, PurePosixPath
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.categories import MODELNET40
from partialbench.dataset.cloud_formats.points import Points, unit_normals
from partialbench.dataset.cloud_formats.text import decode
from partialbench.dataset.names import printable
from partialbench.dataset.shards import open_hdf5
from partialbench.dataset.sources import ObjectRef, RejectedObject
from partialbench.errors import InputError, parsing
from renderers.sources.cloud_store import HdfFile, dataset, require_counts, whole_labels
from renderers.sources.files import hidden
from renderers.sources.listing import SPLITS, Listing

SUFFIXES = (".h5", ".hdf5")
_SPLIT = re.compile(r"(?<![a-z])(train|test)(?:ing)?(?![a-z])", re.IGNORECASE)


def hdf5_files(path: Path) -> list[Path]:
    """The HDF5 files at a path: itself, or those in a folder and below it, by name; none hidden."""
    if path.is_file():
        return [path] if path.suffix.lower() in SUFFIXES else []
    return sorted(
        p
        for p in path.rglob("*")
        if p.suffix.lower() in SUFFIXES
        and p.is_file()
        and not any(map(hidden, p.relative_to(path).parts))
    )


def fields_of(path: Path) -> set[str]:
    """The names at an HDF5 file's top; none where it is not readable."""
    try:
        with open_hdf5(path) as file:
            return set(file)
    except OSError:
        return set()


def is_ply_hdf5(path: Path) -> bool:
    """Whether HDF5 files of this release are there: with data and label, and no masks."""
    return any(
        {"data", "label"} <= found and "mask" not in found
        for found in map(fields_of, hdf5_files(path))
    )


class PlyHdf5Store:
    """The release in a folder, or one file of it. Object ids are the meshes' names, where they are
    told, else the file's name and the row."""

    def __init__(self, path: Path) -> None:
        files = hdf5_files(path)
        folder = files[0].parent if path.is_dir() else path.parent
        self._files: dict[str, HdfFile] = {}
        for each in files:
            if other := self._files.get(each.name):
                raise InputError(
                    f"{path} has {each.name} in {other.path.parent} and in {each.parent}; give one "
                    f"of these folders"
                )
            self._files[each.name] = HdfFile(each)
        names = _shape_names(folder)
        split_of, listed = _official_splits(folder)
        self.listing = Listing((), {}, pattern="modelnet40_ply_hdf5_2048")
        rows: list[tuple[str, str, int, NDArray[np.int64], list[str]]] = []
        for name, file in self._files.items():
            split = split_of.get(name, "")
            if not split and listed and path.is_dir():
                self._left_out(name, f"is in none of {', '.join(listed)}")
                continue
            if not split and (match := _SPLIT.search(PurePosixPath(name).stem.replace("_", " "))):
                split = match[1].lower()
            if not split:
                raise InputError(
                    f"{file.path}: neither a list nor its name says train or test; put it beside "
                    f"train_files.txt or test_files.txt"
                )
            try:
                opened = file.open()
            except InputError as error:
                if not path.is_dir():
                    raise
                self._left_out(name, str(error))
                continue
            with parsing(str(file.path), "HDF5"):
                labels = _labels(opened)
                rows.append((split, name, len(labels), labels, _meshes(folder, name)))
        if path.is_dir():
            for name in sorted(set(split_of) - set(self._files)):
                self._left_out(name, "is in a list, but not in the folder")
        highest = max(int(labels.max(initial=0)) for *_, labels, _ in rows) if rows else 0
        self.listing.class_names = _class_names(names, highest, folder)
        for split, name, count, labels, meshes in sorted(rows, key=lambda r: r[1]):
            self._add(split, name, count, labels, meshes)
        ids = [{ref.object_id for ref in self.listing.of(split)} for split in SPLITS]
        if both := sorted(ids[0] & ids[1]):
            self.listing.notes.append(
                f"{len(both)} meshes are in both splits by the id2file.json lists ({both[0]}, …)"
            )
        self._say(listed)

    def _left_out(self, name: str, reason: str) -> None:
        self.listing.rejected.append(RejectedObject(name, "", reason, name, failed=True))

    def _add(
        self, split: str, name: str, count: int, labels: NDArray[np.int64], meshes: list[str]
    ) -> None:
        if meshes and len(meshes) != count:
            raise InputError(f"{name} has {count} rows, its id2file.json names {len(meshes)}")
        for row, label in enumerate(labels.tolist()):
            category = self.listing.class_names[label]
            full = f"{PurePosixPath(name).stem}/{row:05d}"
            if meshes:
                full = str(PurePosixPath(meshes[row]).with_suffix(""))
                said = full.rpartition("/")[0]
                if said and said != category:
                    raise InputError(
                        f"{name}: row {row} has label {label} ({category}), its id2file.json says "
                        f"{meshes[row]!r}"
                    )
            ref = ObjectRef(printable(full), label, split, f"{name}/{row}")
            self.listing.objects.setdefault(split, []).append(ref)

    def _say(self, listed: list[str]) -> None:
        listing = self.listing
        listing.objects = {s: listing.objects[s] for s in SPLITS if s in listing.objects}
        counts = {split: len(listing.of(split)) for split in SPLITS}
        present = {ref.label for split in SPLITS for ref in listing.of(split)}
        splits = f"splits from {', '.join(listed)}" if listed else "splits by the files' names"
        listing.notes.insert(0, splits)
        out = [r.location for r in listing.rejected]
        listing.words = (
            f"modelnet40_ply_hdf5_2048: {len(present)} classes, {counts['train']:,} training, "
            f"{counts['test']:,} test objects; {'; '.join(listing.notes)}; y up, as it is "
            f"published, unless --up says otherwise"
            + (f"; {len(out)} files left out: {', '.join(out)}" if out else "")
        )

    def cloud(self, ref: ObjectRef) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """The points, and the normals where the file has them."""
        name, _, row = ref.location.rpartition("/")
        file = self._files[name]
        points = file.row("data", int(row)).astype(np.float64)
        if not np.isfinite(points).all():
            raise InputError(f"{ref.location}: has points that are not finite")
        normals = None
        if "normal" in file.open():
            stored = np.asarray(file.open()["normal"][int(row)], np.float64)
            normals = unit_normals(Points(points, stored, named=True))
        return points, normals

    def stored(self, ref: ObjectRef) -> bytes:
        """The bytes of the points."""
        name, _, row = ref.location.rpartition("/")
        data = self._files[name].row("data", int(row))
        return np.ascontiguousarray(data, data.dtype.newbyteorder("<")).tobytes()


def _labels(file: h5py.File) -> NDArray[np.int64]:
    data = dataset(file, "data", "the file")
    if data.ndim != 3 or data.shape[2] != 3 or data.shape[1] == 3 or data.dtype.kind != "f":
        raise InputError(f"data are {data.dtype} {data.shape}, expected floats (M,N,3)")
    if "normal" in file and dataset(file, "normal", "the file").shape != data.shape:
        raise InputError(f"normal has shape {file['normal'].shape}, data have {data.shape}")
    require_counts(file, ("data", "label"), "the file")
    return whole_labels(file, "label", None, "the file")


def _shape_names(folder: Path) -> list[str]:
    paths = sorted(folder.glob("*shape_names.txt"))
    if folder / "shape_names.txt" in paths:
        paths = [folder / "shape_names.txt"]
    lists = [_lines(path) for path in paths]
    if any(names != lists[0] for names in lists):
        raise InputError(
            f"{folder} has {', '.join(path.name for path in paths)}, which name other classes; "
            f"keep the one that the labels are of"
        )
    if not lists:
        return []
    names = lists[0]
    for line, name in enumerate(names, 1):
        # A label is the number of a line: none may be skipped.
        if not name or name in names[: line - 1]:
            what = f"is {name!r} for the second time" if name else "is empty"
            raise InputError(f"{paths[0]}: line {line} {what}; expected a class a line")
    return names


def _lines(path: Path) -> list[str]:
    """The lines of a list, empty ones at its end aside."""
    with parsing(str(path), "text"):
        return [line.strip() for line in decode(path.read_bytes()).rstrip().splitlines()]


def _class_names(names: list[str], highest: int, folder: Path) -> tuple[str, ...]:
    """The names in the file; ModelNet40's where these begin as they do."""
    if names and names == list(MODELNET40[: len(names)]) and highest < len(MODELNET40):
        return MODELNET40
    if highest >= len(names):
        raise InputError(
            f"{folder}: there are labels up to {highest}, but {len(names)} names of classes; "
            f"expected one a line in shape_names.txt"
        )
    return tuple(names)


def _official_splits(folder: Path) -> tuple[dict[str, str], list[str]]:
    """File name → split from ``train_files.txt`` and ``test_files.txt``, and the lists found."""
    split_of: dict[str, str] = {}
    listed = []
    for split in SPLITS:
        path = folder / f"{split}_files.txt"
        if not path.is_file():
            continue
        listed.append(path.name)
        for line in filter(None, _lines(path)):
            name = PurePosixPath(line.replace("\\", "/")).name
            if split_of.setdefault(name, split) != split:
                raise InputError(f"{folder}: {name} is in both lists, {' and '.join(listed)}")
    return split_of, listed


def _meshes(folder: Path, name: str) -> list[str]:
    match = re.fullmatch(r"(.*?)_?(\d+)", PurePosixPath(name).stem)
    path = folder / f"{match[1]}_{match[2]}_id2file.json" if match else folder / "none"
    if not path.is_file():
        return []
    with parsing(path.name, "JSON"):
        data: Any = json.loads(path.read_bytes())
    if not (isinstance(data, list) and all(isinstance(item, str) for item in data)):
        raise InputError(f"{path.name} is no list of names")
    return data
