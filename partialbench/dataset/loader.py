"""Reading a data folder for training: labels in memory, points and normals mapped from disk.

They are read through memory maps of the shards' contiguous data sets, not through h5py handles:
a map survives a fork, is reopened after a spawn, and costs a memory copy per row.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from partialbench import given
from partialbench.dataset import manifest as manifests
from partialbench.dataset import objects as tables
from partialbench.dataset.shards import content_digest, file_sha256, open_shard
from partialbench.errors import InputError

_SMALL = (
    "label", "object_id", "view", "R_camera_object", "t_camera_object", "K", "visible_fraction",
    "n_visible", "symmetry",
)  # fmt: skip
_SOURCE = "source_sha256"
_ROW_DIGEST = "row_sha256"
_OCCLUDED = "occluded_fraction"
_MAPPED = ("points", "normals")


@dataclass(frozen=True)
class _Shard:
    """A shard's file, its number of rows, and where in it each field to be mapped begins."""

    path: Path
    rows: int
    offsets: dict[str, int]
    has_depth: bool


class ShardDataset:
    """One split of a data folder.

    Args:
        folder: made by ``partialbench render``.
        split: "train" or "test".
        num_points: points per cloud, at most the P of the shards.

    Attributes:
        labels: (M,) int64.
        object_ids: (M,) str array.
        views: (M,) int32.
        rotations: (M,3,3) float64 R_camera_object. translations: (M,3) float64 t_camera_object.
        intrinsics: (M,3,3) float64 K, zeros where no image was formed.
        has_normals, has_depth: whether the folder was rendered with them.
        visible_fraction: (M,) float32. n_visible: (M,) int32.
        occluded_fraction: (M,) float32, zeros where the folder was rendered without occluders.
        symmetries: (M,) str array of group names.
        source_digests: (M,) SHA-256 (hex) of what each row's object was made from, "" if not known.
        has_poses: whether ``rotations`` are poses; where not, no figure may be made of them.
        occluders: the share that was to be hidden, 0 without. grid: the cell that a test on a grid
            calls this set, "" for none.
        class_names: label → name. dataset_id, setting, sensor, digest: from the manifest; the
            digest is of this split's content and does not depend on the shard size.
        manifest: the whole ``Manifest``.

    Raises:
        InputError: no such folder or split, an unfinished folder, more points than stored, or a
            shard whose bytes are not those its manifest lists.
    """

    def __init__(self, folder: Path | str, split: str, num_points: int = 1024) -> None:
        self.folder = given.path(folder, "the data folder")
        self.split = split
        self.num_points = num_points = given.whole_number(num_points, "num_points", 1)
        if not isinstance(split, str):
            raise InputError(f'split must be "train" or "test", got {split!r}')
        self.manifest = manifests.load(self.folder)
        if self.manifest.state != "complete":
            raise InputError(
                f"{folder} is unfinished (state {self.manifest.state!r}): run its render command "
                f"again to complete it"
            )
        entries = [s for s in self.manifest.shards if s.split == split]
        if not entries:
            raise InputError(f"{folder} has no split {split!r}; it has {self.manifest.splits()}")
        self.class_names: tuple[str, ...] = tuple(self.manifest.class_names)
        self.dataset_id = self.manifest.dataset_id
        self.setting: str = self.manifest.configuration["setting"]
        self.sensor = self.manifest.sensor
        self.occluders = self.manifest.occluders
        self.grid = ""
        self.has_poses = self.manifest.has_poses
        self.digest = self.manifest.digests[split]
        stored: int = self.manifest.configuration["points"]
        if num_points > stored:
            raise InputError(
                f"{folder} stores {stored} points a cloud, {num_points} were asked for; "
                f"choose 1 to {stored} or render with --points {num_points}"
            )
        columns, self._layout = _read_small_and_layout(self.folder, entries)
        if content_digest([columns[_ROW_DIGEST]]) != self.digest:
            raise InputError(
                f"{folder}: the rows of split {split!r} do not have the digest its manifest claims "
                f"({self.digest[:12]}); 'partialbench verify {folder}' tells what differs"
            )
        self._first_row = np.cumsum([0, *(shard.rows for shard in self._layout)])
        self.has_normals = all("normals" in shard.offsets for shard in self._layout)
        self.has_depth = all(shard.has_depth for shard in self._layout)
        self.labels = columns["label"].astype(np.int64)
        self.object_ids = np.char.decode(columns["object_id"], "utf-8")
        self.symmetries = np.char.decode(columns["symmetry"], "utf-8")
        self.views = columns["view"]
        self.rotations = columns["R_camera_object"]
        self.translations = columns["t_camera_object"]
        self.intrinsics = columns["K"]
        self.visible_fraction = columns["visible_fraction"]
        self.n_visible = columns["n_visible"]
        self.occluded_fraction = columns[_OCCLUDED]
        self.source_digests = np.char.decode(columns[_SOURCE], "ascii")
        self._stored_points = stored
        self._maps: dict[tuple[int, str], np.memmap] = {}

    def __repr__(self) -> str:
        return (
            f"<{self.dataset_id} {self.split}: {len(self):,} clouds of {self.num_points} points, "
            f"{len(np.unique(self.labels))} classes, in {self.folder}>"
        )

    def __len__(self) -> int:
        return len(self.labels)

    def __getstate__(self) -> dict[str, Any]:
        # A spawned worker opens its own maps instead of receiving the data.
        return {**self.__dict__, "_maps": {}}

    def points(
        self,
        indices: NDArray | Sequence[int],
        rng: np.random.Generator | None = None,
        distinct: bool = False,
    ) -> NDArray[np.float32]:
        """Clouds of the rows ``indices``: (B,num_points,3) float32, camera frame.

        Rows are told by their numbers (B,), or by a mask (M,) over all of them.

        Rows hold their points in random order, so the first ``num_points`` are a fair subset: that
        is what is returned without ``rng``. With it, each cloud starts at a random place of the
        stored (circular) order: another subset every time at the cost of one copy.

        A row of fewer distinct points than are stored has them first, then repeats drawn at random.
        The first ``num_points`` thus have as many distinct ones as there can be, a random place
        has fewer. ``distinct`` makes the circle of the distinct points alone, so that random clouds
        have repeats only where, and as many as, the first ``num_points`` have.
        """
        return self._clouds(indices, ("points",), rng, distinct)[0]

    def points_and_normals(
        self,
        indices: NDArray | Sequence[int],
        rng: np.random.Generator | None = None,
        distinct: bool = False,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """As ``points``, with the unit normal of each of the same points: two (B,num_points,3).

        Raises:
            InputError: the folder has no normals.
        """
        if not self.has_normals:
            raise InputError(f"{self.folder} has no normals; render it with --normals")
        points, normals = self._clouds(indices, _MAPPED, rng, distinct)
        return points, normals

    def depth(self, indices: NDArray | Sequence[int]) -> NDArray[np.float32]:
        """Depth images of the rows ``indices``: (B,H,W) float32 z-depth, 0 = no surface.

        They are not mapped but unpacked from disk at each call.

        Raises:
            InputError: the folder has no depth images.
        """
        if not self.has_depth:
            raise InputError(f"{self.folder} has no depth images; render it with --keep-depth")
        indices = self._checked(indices)
        shard_of = np.searchsorted(self._first_row, indices, side="right") - 1
        images: list[NDArray] = [np.zeros(0)] * len(indices)
        for shard in np.unique(shard_of):
            # Opened at each call: an HDF5 handle does not survive a fork.
            with open_shard(self._layout[shard].path) as file:
                for i in np.flatnonzero(shard_of == shard):
                    images[i] = file["depth"][int(indices[i] - self._first_row[shard])]
        return np.stack(images) if images else np.zeros((0, 0, 0), np.float32)

    def _checked(self, indices: NDArray | Sequence[int]) -> NDArray[np.int64]:
        """Row numbers (B,), also of a mask over all rows, such as ``labels == 3`` is."""
        indices = np.asarray(indices)
        if indices.dtype == bool:
            if indices.shape != (len(self),):
                raise InputError(
                    f"a mask of rows must have the shape ({len(self)},), got {indices.shape}"
                )
            return np.flatnonzero(indices)
        if indices.ndim != 1 or (indices.size and indices.dtype.kind not in "iu"):
            raise InputError(
                f"row indices must be whole numbers (B,), or a mask ({len(self)},), got "
                f"{indices.dtype} of shape {indices.shape}"
            )
        indices = indices.astype(np.int64)
        if indices.size and not (indices.min() >= 0 and indices.max() < len(self)):
            raise IndexError(f"row indices must lie in [0, {len(self)}), got {indices.min()} to "
                             f"{indices.max()}")  # fmt: skip
        return indices

    def _clouds(
        self,
        indices: NDArray | Sequence[int],
        names: tuple[str, ...],
        rng: np.random.Generator | None,
        distinct: bool,
    ) -> list[NDArray[np.float32]]:
        """The same part of each row's circle in each of the named fields."""
        if not isinstance(rng, np.random.Generator | None):
            raise InputError(f"rng must be a numpy.random.Generator or None, got {rng!r}")
        indices = self._checked(indices)
        fields = [np.zeros((len(indices), self.num_points, 3), np.float32) for _ in names]
        shard_of = np.searchsorted(self._first_row, indices, side="right") - 1
        circles = np.full(len(indices), self._stored_points)
        if distinct:
            circles = self.n_visible[indices].clip(self.num_points, self._stored_points)
        starts = (
            np.zeros(len(indices), np.int64)
            if rng is None or self.num_points == self._stored_points
            else rng.integers(0, circles)
        )
        for name, clouds in zip(names, fields, strict=True):
            for out, index, shard, start, circle in zip(
                clouds, indices, shard_of, starts, circles, strict=True
            ):
                row = self._map(int(shard), name)[index - self._first_row[shard]]
                head = min(self.num_points, circle - start)
                out[:head] = row[start : start + head]
                out[head:] = row[: self.num_points - head]
        return fields

    def _map(self, shard: int, name: str) -> np.memmap:
        mapped = self._maps.get((shard, name))
        if mapped is None:
            file = self._layout[shard]
            shape = (file.rows, self._stored_points, 3)
            try:
                mapped = np.memmap(file.path, "<f4", "r", file.offsets[name], shape)
            except (OSError, ValueError) as error:
                raise InputError(
                    f"{file.path} cannot be read any more ({error}): moved, deleted or rewritten "
                    f"since the folder was opened; open it again where it is"
                ) from error
            self._maps[shard, name] = mapped
        return mapped


def _read_small_and_layout(
    folder: Path, entries: list[manifests.ShardEntry]
) -> tuple[dict[str, NDArray], list[_Shard]]:
    """Every small column joined over shards, and how each shard lies in its file."""
    parts: dict[str, list[NDArray]] = {
        name: [] for name in (*_SMALL, _ROW_DIGEST, _OCCLUDED, _SOURCE)
    }
    layout = []
    table = tables.load(folder)
    place = folder.absolute()  # opened later too, when the current folder may be another
    for entry in entries:
        if entry.rows == 0:
            continue
        path = place / entry.file
        if not path.is_file():
            raise InputError(f"{path} is missing, the manifest lists it; run the render again")
        if path.stat().st_size != entry.bytes:
            raise InputError(
                f"{path} has {path.stat().st_size} bytes, the manifest says {entry.bytes}; "
                f"'partialbench verify {folder}' tells what is damaged"
            )
        _require_unchanged(folder, path, entry.sha256)
        with open_shard(path) as file:
            for name in (*_SMALL, _ROW_DIGEST):
                parts[name].append(file[name][()])
            parts[_OCCLUDED].append(
                file[_OCCLUDED][()] if _OCCLUDED in file else np.zeros(entry.rows, np.float32)
            )
            known = _sources_in(file) if "objects" in file else _sources_of(entry, table, folder)
            ids = parts["object_id"][-1]
            parts[_SOURCE].append(np.array([known.get(name, b"") for name in ids], "S64"))
            offsets = {name: file[name].id.get_offset() for name in _MAPPED if name in file}
            if None in offsets.values() or "points" not in offsets:
                raise InputError(f"{path}: points are not stored contiguously; made by a hand?")
            if len(ids) != entry.rows:
                # No digest covers the number, by which rows are counted over shards.
                raise InputError(
                    f"{path} holds {len(ids)} rows, its manifest says {entry.rows}: the manifest "
                    f"was edited or is damaged; run the render again in a new folder"
                )
            layout.append(_Shard(path, entry.rows, offsets, "depth" in file))
    if not layout:
        raise InputError(f"{folder}: the split has no rows; see its failures.jsonl")
    return {name: np.concatenate(values) for name, values in parts.items()}, layout


def _require_unchanged(folder: Path, path: Path, expected: str) -> None:
    """Holds a shard against its manifest: what is trained and tested on is what a digest names."""
    status = path.stat()
    found = _file_digest(path.absolute(), status.st_mtime_ns, status.st_size)
    if found != expected:
        raise InputError(
            f"{path} is not the file its manifest lists (SHA-256 {found[:12]}, expected "
            f"{expected[:12]}): it was changed after it was rendered, or is damaged. 'partialbench "
            f"verify {folder}' tells what differs; delete the shard and run the render again"
        )


@functools.lru_cache(maxsize=4096)
def _file_digest(path: Path, _mtime: int, _size: int) -> str:
    """Once a process for a file as it is."""
    return file_sha256(path)


def _sources_in(file: h5py.File) -> dict[bytes, bytes]:
    """Object id → source digest, from a shard of format 1."""
    objects = file["objects"]
    return dict(zip(objects["object_id"][()], objects[_SOURCE][()], strict=True))


def _sources_of(
    entry: manifests.ShardEntry, table: dict[str, str], folder: Path
) -> dict[bytes, bytes]:
    """Object id → source digest, from the table of objects, which must be as the manifest says."""
    text = table.get(entry.file, "")
    path = folder / tables.NAME
    if tables.text_digest(text) != entry.objects_sha256:
        raise InputError(
            f"{path} does not list the objects of {entry.file} as the manifest recorded them: "
            f"missing, damaged or edited; run the render again"
        )
    lines = tables.parse(text, path)
    return {line.object_id.encode(): line.source_sha256.encode() for line in lines}
