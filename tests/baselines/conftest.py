"""Clouds to compute with, and the same random weights in every test."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from baselines import points


@pytest.fixture(autouse=True)
def seed() -> None:
    torch.manual_seed(0)


@pytest.fixture
def clouds(rng: np.random.Generator) -> Tensor:
    """(3,200,3) in the unit ball, with repeated points as clouds of few pixels have."""
    cloud = rng.normal(size=(3, 200, 3)) * (0.5, 0.3, 0.2)
    cloud[:, 150:] = cloud[:, :50]
    return points.normalise(torch.from_numpy(cloud).float())
