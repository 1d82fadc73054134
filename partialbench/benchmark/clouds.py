"""What the harness asks of a data set."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class Clouds(Protocol):
    """Clouds with labels and poses; ``dataset.loader.ShardDataset`` is one."""

    labels: NDArray[np.int64]
    object_ids: NDArray[np.str_]
    views: NDArray[np.int32]
    rotations: NDArray[np.float64]
    visible_fraction: NDArray[np.float32]
    symmetries: NDArray[np.str_]
    source_digests: NDArray[np.str_]
    class_names: tuple[str, ...]
    dataset_id: str
    setting: str
    sensor: str
    occluders: float
    grid: str
    digest: str
    num_points: int
    has_poses: bool
    has_normals: bool

    def __len__(self) -> int: ...

    def points(
        self,
        indices: NDArray | list[int],
        rng: np.random.Generator | None = None,
        distinct: bool = False,
    ) -> NDArray[np.float32]: ...

    def points_and_normals(
        self,
        indices: NDArray | list[int],
        rng: np.random.Generator | None = None,
        distinct: bool = False,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]: ...
