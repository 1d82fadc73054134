"""Reading a data folder for training: labels in memory, points mapped from disk.

Points are read through memory maps of the shards' contiguous data sets, not through h5py handles:
a map survives a fork, is reopened after a spawn, and costs a memory copy per row.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from partialbench.dataset import manifest as manifests
from partialbench.dataset.shards import open_shard
from partialbench.errors import InputError

_SMALL = (
    "label", "object_id", "view", "R_camera_object", "t_camera_object", "visible_fraction",
    "n_visible", "symmetry",
)  # fmt: skip
_SOURCE = "source_sha256"


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
        visible_fraction: (M,) float32. n_visible: (M,) int32.
        symmetries: (M,) str array of group names.
        source_digests: (M,) SHA-256 (hex) of what each row's object was made from, "" if not known.
        has_poses: whether ``rotations`` are poses; where not, no figure may be made of them.
        class_names: label → name. dataset_id, setting, sensor, digest: from the manifest; the
            digest is of this split's content and does not depend on the shard size.
        manifest: the whole ``Manifest``.

    Raises:
        InputError: no such folder or split, an unfinished folder, more points than stored.
    """

    def __init__(self, folder: Path | str, split: str, num_points: int = 1024) -> None:
        self.folder = Path(folder)
        self.split = split
        self.num_points = num_points
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
        self.has_poses = self.manifest.has_poses
        self.digest = self.manifest.digests[split]
        stored: int = self.manifest.configuration["points"]
        if not 1 <= num_points <= stored:
            raise InputError(
                f"{folder} stores {stored} points a cloud, {num_points} were asked for; "
                f"choose 1 to {stored} or render with --points {num_points}"
            )
        columns, self._layout = _read_small_and_layout(self.folder, entries)
        self._first_row = np.cumsum([0, *(rows for _, _, rows in self._layout)])
        self.labels = columns["label"].astype(np.int64)
        self.object_ids = np.char.decode(columns["object_id"], "utf-8")
        self.symmetries = np.char.decode(columns["symmetry"], "utf-8")
        self.views = columns["view"]
        self.rotations = columns["R_camera_object"]
        self.translations = columns["t_camera_object"]
        self.visible_fraction = columns["visible_fraction"]
        self.n_visible = columns["n_visible"]
        self.source_digests = np.char.decode(columns[_SOURCE], "ascii")
        self._stored_points = stored
        self._maps: list[np.memmap | None] = [None] * len(self._layout)

    def __len__(self) -> int:
        return len(self.labels)

    def __getstate__(self) -> dict[str, Any]:
        # A spawned worker opens its own maps instead of receiving the data.
        return {**self.__dict__, "_maps": [None] * len(self._layout)}

    def points(
        self,
        indices: NDArray | list[int],
        rng: np.random.Generator | None = None,
        distinct: bool = False,
    ) -> NDArray[np.float32]:
        """Clouds of the rows ``indices``: (B,num_points,3) float32, camera frame.

        Rows hold their points in random order, so the first ``num_points`` are a fair subset: that
        is what is returned without ``rng``. With it, each cloud starts at a random place of the
        stored (circular) order: another subset every time at the cost of one copy.

        A row of fewer distinct points than are stored has them first, then repeats drawn at random.
        The first ``num_points`` thus have as many distinct ones as there can be, a random place
        has fewer. ``distinct`` makes the circle of the distinct points alone, so that random clouds
        have repeats only where, and as many as, the first ``num_points`` have.
        """
        indices = np.asarray(indices, np.int64)
        if indices.size and not (indices.min() >= 0 and indices.max() < len(self)):
            raise IndexError(f"row indices must lie in [0, {len(self)}), got {indices.min()} to "
                             f"{indices.max()}")  # fmt: skip
        clouds = np.zeros((len(indices), self.num_points, 3), np.float32)
        shard_of = np.searchsorted(self._first_row, indices, side="right") - 1
        circles = np.full(len(indices), self._stored_points)
        if distinct:
            circles = self.n_visible[indices].clip(self.num_points, self._stored_points)
        starts = (
            np.zeros(len(indices), np.int64)
            if rng is None or self.num_points == self._stored_points
            else rng.integers(0, circles)
        )
        for out, index, shard, start, circle in zip(
            clouds, indices, shard_of, starts, circles, strict=True
        ):
            row = self._map(int(shard))[index - self._first_row[shard]]
            head = min(self.num_points, circle - start)
            out[:head] = row[start : start + head]
            out[head:] = row[: self.num_points - head]
        return clouds

    def _map(self, shard: int) -> np.memmap:
        mapped = self._maps[shard]
        if mapped is None:
            path, offset, rows = self._layout[shard]
            shape = (rows, self._stored_points, 3)
            mapped = np.memmap(path, "<f4", "r", offset, shape)
            self._maps[shard] = mapped
        return mapped


def _read_small_and_layout(
    folder: Path, entries: list[manifests.ShardEntry]
) -> tuple[dict[str, NDArray], list[tuple[Path, int, int]]]:
    """Every small column joined over shards, and (path, byte offset of points, rows) of each."""
    parts: dict[str, list[NDArray]] = {name: [] for name in (*_SMALL, _SOURCE)}
    layout = []
    for entry in entries:
        if entry.rows == 0:
            continue
        path = folder / entry.file
        if not path.is_file():
            raise InputError(f"{path} is missing, the manifest lists it; run the render again")
        if path.stat().st_size != entry.bytes:
            raise InputError(
                f"{path} has {path.stat().st_size} bytes, the manifest says {entry.bytes}; "
                f"'partialbench verify {folder}' tells what is damaged"
            )
        with open_shard(path) as file:
            for name in _SMALL:
                parts[name].append(file[name][()])
            parts[_SOURCE].append(_source_of_rows(file, parts["object_id"][-1]))
            offset = file["points"].id.get_offset()
            if offset is None:
                raise InputError(f"{path}: points are not stored contiguously; made by a hand?")
            layout.append((path, offset, entry.rows))
    if not layout:
        raise InputError(f"{folder}: the split has no rows; see its failures.jsonl")
    return {name: np.concatenate(values) for name, values in parts.items()}, layout


def _source_of_rows(file: h5py.File, object_ids: NDArray) -> NDArray:
    """The source digest of each row's object, from the shard's table of objects."""
    objects = file["objects"]
    known = dict(zip(objects["object_id"][()], objects[_SOURCE][()], strict=True))
    return np.array([known.get(name, b"") for name in object_ids], "S64")
