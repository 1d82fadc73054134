"""What a model is to be tested on, and under which conditions, as it was asked for."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from torch import nn

from partialbench import given
from partialbench.benchmark.testing import damage, given_pose
from partialbench.benchmark.testing.run import Test, try_given_pose
from partialbench.dataset import grid as grids
from partialbench.dataset.loader import ShardDataset
from partialbench.errors import InputError

Parsed = TypeVar("Parsed")


@dataclass(frozen=True)
class Folder:
    """A data folder whose test split is tested on, and the conditions.

    Attributes:
        points: of a cloud, beside the number trained on.
        poses, damages: as ``given_pose.parse`` and ``damage.parse`` name them. They are for clouds
            of the size trained on alone: a test under two conditions lies on no curve.
    """

    path: Path
    points: tuple[int, ...] = ()
    poses: tuple[str, ...] = ()
    damages: tuple[str, ...] = ()


@dataclass(frozen=True)
class Asked:
    """Tests to be made of one training, or of several that are alike: of folders, each once, and of
    the data folders of grids' cells."""

    folders: list[Folder]
    cells: list[Path]

    @property
    def paths(self) -> list[Path]:
        """Of the folders."""
        return [folder.path for folder in self.folders]

    def open(self, num_points: int, class_names: tuple[str, ...]) -> list[Test]:
        """The test splits, each with every number of points, and then those of the cells.

        Args:
            num_points, class_names: trained on.

        Raises:
            InputError: see ``ShardDataset`` and ``grid.require_cells``; or a test split without a
                class that is trained on.
        """
        tests = []
        for grid in dict.fromkeys(path.parent for path in self.cells):
            grids.require_cells(grid, [path.name for path in self.cells if path.parent == grid])
        for folder in self.folders:
            own = ShardDataset(folder.path, "test", num_points)
            tests.append(Test(own, folder.poses, folder.damages))
            others = [number for number in folder.points if number != num_points]
            tests += [Test(ShardDataset(folder.path, "test", number)) for number in others]
        for path in self.cells:
            cell = ShardDataset(path, "test", num_points)
            cell.grid = path.name
            tests.append(Test(cell))
        for test in tests:
            names = test.clouds.class_names
            if not set(class_names) & set(names):
                raise InputError(
                    f"the test data ({test.clouds.dataset_id}) share no class with the training "
                    f"data: {', '.join(names)} against {', '.join(class_names)}"
                )
        return tests


def try_poses(
    name: str, model: nn.Module, tests: Sequence[Test], class_names: Sequence[str]
) -> None:
    """Raises ``InputError`` for a pose that the model does not take or the data do not have."""
    for test in tests:
        for pose in test.poses:
            try_given_pose(name, model, test.clouds, pose, class_names)


def read(
    data: Any, test_data: Any, test_grid: Any, test_points: Any, test_poses: Any, test_damages: Any
) -> Asked:
    """The arguments of ``run.run_eval`` that are so called.

    Raises:
        InputError: one of them cannot be right.
    """
    folders = [*([] if data is None else [data]), *given.several(test_data, "test_data")]
    paths = list(dict.fromkeys(given.path(folder, "a data folder") for folder in folders))
    points = _by_folder(test_points, "test_points", paths, _points)
    poses = _by_folder(test_poses, "test_poses", paths, _poses)
    damages = _by_folder(test_damages, "test_damages", paths, damage.parse)
    if not paths:
        # Asked of no folder they would be dropped.
        conditions = {"points": test_points, "pose": test_poses, "damage": test_damages}
        if unused := [name for name, value in conditions.items() if given.several(value, name)]:
            raise InputError(
                f"{', '.join(f'--test-{name}' for name in unused)} would have no effect: the cells "
                f"of a grid are tested as they are; give --data or --test-data too, or leave it out"
            )
    of_grid = [given.path(one, "a grid") for one in given.several(test_grid, "test_grid")]
    return Asked(
        [Folder(path, points[path], poses[path], damages[path]) for path in paths],
        [folder for path in of_grid for folder in grids.folders(path)],
    )


def _by_folder(
    value: Any, name: str, folders: Sequence[Path], parse: Callable[[Any], Parsed]
) -> dict[Path, Parsed]:
    """Conditions of each folder: the same of all, or of those that a mapping names."""
    if not isinstance(value, Mapping):
        return dict.fromkeys(folders, parse(value))
    asked = {given.path(folder, f"a folder of {name}"): one for folder, one in value.items()}
    if unknown := [str(path) for path in asked if path not in folders]:
        raise InputError(
            f"{name} names {', '.join(unknown)}, which is not tested on; tested on are "
            f"{', '.join(map(str, folders)) or 'no folders'}"
        )
    return {path: parse(asked.get(path, ())) for path in folders}


def _points(value: Any) -> tuple[int, ...]:
    numbers = given.several(value, "test_points")
    return tuple(dict.fromkeys(given.whole_number(n, "test_points", 1) for n in numbers))


def _poses(value: Any) -> tuple[str, ...]:
    return tuple(dict.fromkeys(map(given_pose.parse, given.several(value, "test_poses"))))
