"""3D Steerable CNN: the voxel network of the SHREC17 experiment, on clouds.

Source: Weiler, Geiger, Welling, Boomsma & Cohen, "3D Steerable CNNs", NeurIPS 2018; se3cnn@546bc68,
examples/image/shrec17 (architecture and input), whose meshes are replaced by the cloud's points.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn

from baselines.points import normalise
from baselines.steerable import Fields, GatedBlock
from baselines.voxels import low_pass, occupancy
from partialbench.benchmark.prediction import Prediction
from partialbench.errors import InputError

GRID = 64
FIELDS = ((8, 4, 2),) * 2 + ((16, 8, 4),) * 2 + ((32, 16, 8),) * 3 + ((512,),)
STRIDES = (2, 1, 2, 1, 2, 1, 2, 1)

# The input has twice the resolution it is used at: σ = ½·√(2² − 1) removes what would alias.
LOW_PASS_SIGMA = 0.5 * 3**0.5


class SteerableCNN(nn.Module):
    """Eight gated blocks of 5³ kernels; the last keeps scalars, whose mean a linear layer reads.

    The output of the trunk is a scalar field, so the logits do not change when the cloud is turned,
    up to what the grid and the strides break.

    Args:
        num_classes: K.
        grid: edge of the input volume; the published 64.
    """

    def __init__(self, num_classes: int, *, grid: int = GRID) -> None:
        super().__init__()
        if grid < 1:
            raise InputError(f"grid must be positive, got {grid}")
        self.grid = grid
        self.trunk = nn.Sequential(
            *(
                GatedBlock(Fields(a), Fields(b), 5, padding=4, stride=stride)
                for (a, b), stride in zip(itertools.pairwise(((1,), *FIELDS)), STRIDES, strict=True)
            )
        )
        self.classifier = nn.Linear(FIELDS[-1][0], num_classes)

    def forward(self, points: Tensor) -> Prediction:
        """(B,N,3) clouds, any scale and position → class logits (B,K)."""
        with torch.autocast(points.device.type, enabled=False):
            fine = occupancy(normalise(points), 2 * self.grid)
            volume = low_pass(nn.functional.avg_pool3d(fine, 2), LOW_PASS_SIGMA, radius=2)
        return Prediction(self.classifier(self.trunk(volume).mean((2, 3, 4))))
