"""What a model takes beside the points: normals and, in training, poses, where the data have them.

A model says so by an attribute ``needs_normals`` that is true, a registered one on its card too
(``ModelCard.inputs``). Its forward is then called with ``normals=``, (B,N,3) float32 unit vectors
in the camera frame, one a point. One whose loss takes poses says so by ``needs_poses``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from partialbench.errors import InputError

if TYPE_CHECKING:
    from partialbench.benchmark.clouds import Clouds

NORMALS = "normals"


def needs_normals(model: nn.Module) -> bool:
    """Whether the model is to be called with normals."""
    return bool(getattr(model, "needs_normals", False))


def require(dataset: Clouds, model_name: str) -> None:
    """Raises ``InputError`` where a data set has no normals to give."""
    if not dataset.has_normals:
        raise InputError(
            f"{model_name} takes normals, and the data set {dataset.dataset_id} was made without; "
            f"render it with --normals"
        )


def require_poses(dataset: Clouds, model: nn.Module, model_name: str) -> None:
    """Raises ``InputError`` for a model with a loss of poses where nobody knows the poses.

    A placeholder would teach it in silence that every object is seen in one pose.
    """
    if getattr(model, "needs_poses", False) and not dataset.has_poses:
        raise InputError(
            f"{model_name} learns poses, and nobody knows those of the data set "
            f"{dataset.dataset_id}; train a model, or a variant of it, without pose"
        )


def with_normals(
    dataset: Clouds,
    rows: NDArray[np.int64],
    rng: np.random.Generator | None = None,
    distinct: bool = False,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Points and the normals of the same points, each (B,N,3) float32 in the camera frame.

    The points are those that ``dataset.points`` gives for the same arguments.
    """
    require(dataset, "the model")
    return dataset.points_and_normals(rows, rng, distinct)


def of_rows(
    model: nn.Module,
    dataset: Clouds,
    rows: NDArray[np.int64],
    device: torch.device | str = "cpu",
) -> tuple[Tensor, dict[str, Tensor]]:
    """Test clouds (B,N,3) and what else the model is to be called with, by name."""
    if not needs_normals(model):
        return torch.from_numpy(dataset.points(rows)).to(device), {}
    points, normals = (torch.from_numpy(a).to(device) for a in with_normals(dataset, rows))
    return points, {NORMALS: normals}
