"""What a model is to be tested on, and under which conditions, as it was asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import nn

from partialbench import given
from partialbench.benchmark.testing import damage, given_pose
from partialbench.benchmark.testing.run import try_given_pose
from partialbench.dataset import grid as grids
from partialbench.dataset.loader import ShardDataset
from partialbench.errors import InputError


@dataclass(frozen=True)
class Asked:
    """Tests to be made of one training, or of several that are alike.

    Attributes:
        folders: whose test splits are tested on, each once.
        cells: data folders of grids' cells.
        points: of a cloud, beside the number trained on.
        poses, damages: as ``given_pose.parse`` and ``damage.parse`` name them.
    """

    folders: list[Path]
    cells: list[Path]
    points: list[int]
    poses: list[str]
    damages: tuple[str, ...]

    def open(
        self, num_points: int, class_names: tuple[str, ...]
    ) -> tuple[list[ShardDataset], list[ShardDataset]]:
        """The test splits, each with every number of points, and those of the cells.

        Args:
            num_points, class_names: trained on.

        Raises:
            InputError: see ``ShardDataset``; or a test split without a class that is trained on.
        """
        numbers = dict.fromkeys([num_points, *self.points])
        test_sets = [ShardDataset(f, "test", number) for f in self.folders for number in numbers]
        cells = [ShardDataset(folder, "test", num_points) for folder in self.cells]
        for cell, folder in zip(cells, self.cells, strict=True):
            cell.grid = folder.name
        for part in (*test_sets, *cells):
            if not set(class_names) & set(part.class_names):
                raise InputError(
                    f"the test data ({part.dataset_id}) share no class with the training data: "
                    f"{', '.join(part.class_names)} against {', '.join(class_names)}"
                )
        return test_sets, cells

    def try_poses(
        self,
        name: str,
        model: nn.Module,
        test_sets: Sequence[ShardDataset],
        class_names: Sequence[str],
    ) -> None:
        """Raises ``InputError`` for a pose that the model does not take or the data do not have."""
        for pose in self.poses:
            for test_set in test_sets:
                try_given_pose(name, model, test_set, pose, class_names)


def read(
    data: Any, test_data: Any, test_grid: Any, test_points: Any, test_poses: Any, test_damages: Any
) -> Asked:
    """The arguments of ``run.run_eval`` that are so called.

    Raises:
        InputError: one of them cannot be right.
    """
    folders = [*([] if data is None else [data]), *given.several(test_data, "test_data")]
    of_grid = [given.path(one, "a grid") for one in given.several(test_grid, "test_grid")]
    poses = map(given_pose.parse, given.several(test_poses, "test_poses"))
    return Asked(
        list(dict.fromkeys(given.path(folder, "a data folder") for folder in folders)),
        [folder for path in of_grid for folder in grids.folders(path)],
        [
            given.whole_number(n, "test_points", 1)
            for n in given.several(test_points, "test_points")
        ],
        list(dict.fromkeys(poses)),
        damage.parse(test_damages),
    )
