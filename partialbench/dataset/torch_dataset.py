"""A data folder as a ``torch.utils.data.Dataset`` of dictionaries, for a ``DataLoader``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from partialbench import given, registry
from partialbench.dataset import manifest as manifests
from partialbench.dataset.loader import ShardDataset
from partialbench.errors import InputError

Sample = dict[str, Any]

_COLUMNS: dict[str, str] = {
    "label": "labels", "R": "rotations", "t": "translations", "K": "intrinsics",
    "object_id": "object_ids", "view": "views", "visible_fraction": "visible_fraction",
    "n_visible": "n_visible", "symmetry": "symmetries",
}  # fmt: skip
FIELDS = ("points", "normals", "depth", *_COLUMNS)
"""What a sample may hold."""


def load_dataset(
    folder: Path | str,
    split: str = "train",
    num_points: int | None = None,
    fields: Sequence[str] = ("points", "label", "R", "t"),
    transform: Callable[[Sample], Any] | None = None,
) -> TorchDataset:
    """One split of a data folder, for PyTorch. (``ShardDataset`` is the same for NumPy.)

    Args:
        folder: made by ``partialbench render``.
        split: "train" or "test".
        num_points: of each cloud, at most as many as are stored; None for all of them.
        fields: what a sample holds, of ``FIELDS``: "points" (num_points,3), "normals" (the same),
            "depth" (H,W), "R" (3,3) and "t" (3,) of p_camera = R·p_object + t, "K" (3,3), all
            float32 tensors; "label", "view", "n_visible" int; "visible_fraction" float;
            "object_id", "symmetry" str.
        transform: called with each sample; what it returns is given instead.

    Returns:
        A map-style data set that works with any number of workers, forked or spawned.

    Raises:
        InputError: see ``ShardDataset``; or fields that there are none of.

    ::

        from torch.utils.data import DataLoader
        data = partialbench.load_dataset("data/pm40", "train", num_points=1024)
        for batch in DataLoader(data, batch_size=32, shuffle=True, num_workers=4):
            batch["points"]  # (32,1024,3) float32
            batch["label"]   # (32,) int64
            batch["R"]       # (32,3,3) float32
    """
    return TorchDataset(folder, split, num_points, fields, transform)


class TorchDataset(Dataset[Any]):
    """See ``load_dataset``.

    Attributes:
        shards: the ``ShardDataset`` behind it, with all columns as arrays.
        class_names: label → name.
    """

    def __init__(
        self,
        folder: Path | str,
        split: str = "train",
        num_points: int | None = None,
        fields: Sequence[str] = ("points", "label", "R", "t"),
        transform: Callable[[Sample], Any] | None = None,
    ) -> None:
        fields = given.several(fields, "fields")
        if not fields:
            raise InputError(f"fields is empty: name one or more of {', '.join(FIELDS)}")
        for field in fields:
            if field not in FIELDS:
                raise InputError(f"no field {field!r}{registry.close_matches(field, FIELDS)}")
        given.function(transform, "transform", " with a sample")
        folder = given.path(folder, "the data folder")
        if num_points is None:
            num_points = int(manifests.load(folder).configuration["points"])
        self.shards = ShardDataset(folder, split, num_points)
        self.fields = tuple(dict.fromkeys(fields))
        self.transform = transform
        self.class_names = self.shards.class_names
        self._require_fields(folder)

    def _require_fields(self, folder: Path | str) -> None:
        if "normals" in self.fields and not self.shards.has_normals:
            raise InputError(f"{folder} has no normals; render it with --normals")
        if "depth" in self.fields and not self.shards.has_depth:
            raise InputError(f"{folder} has no depth images; render it with --keep-depth")
        if {"R", "t"} & set(self.fields) and not self.shards.has_poses:
            raise InputError(
                f"{folder} has no poses (its rows' rotations are placeholders); leave R and t out: "
                f'fields=("points", "label")'
            )

    def __repr__(self) -> str:
        return f"<TorchDataset of {', '.join(self.fields)} of {self.shards!r}>"

    def __len__(self) -> int:
        return len(self.shards)

    def __getitem__(self, index: int) -> Any:
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[Any]:
        """The samples of a whole batch: what a ``DataLoader`` asks for."""
        rows = np.array([self._row(index) for index in indices], np.int64)
        columns: dict[str, Sequence[Any]] = {}
        for field in self.fields:
            columns[field] = self._column(field, rows)
        samples = [{field: columns[field][i] for field in self.fields} for i in range(len(rows))]
        return samples if self.transform is None else [self.transform(one) for one in samples]

    def _row(self, index: int) -> int:
        row = given.whole_number(index, "an index of a sample")
        if not -len(self) <= row < len(self):
            raise IndexError(f"index {row} is out of range for {len(self)} clouds")
        return row % len(self)

    def _column(self, field: str, rows: NDArray[np.int64]) -> Sequence[Any]:
        if field == "depth":
            return torch.from_numpy(self.shards.depth(rows)).unbind()
        if field == "points":
            return torch.from_numpy(self.shards.points(rows)).unbind()
        if field == "normals":
            return torch.from_numpy(self.shards.points_and_normals(rows)[1]).unbind()
        values = getattr(self.shards, _COLUMNS[field])[rows]
        if values.ndim > 1:
            return torch.from_numpy(values.astype(np.float32)).unbind()
        return values.tolist()
