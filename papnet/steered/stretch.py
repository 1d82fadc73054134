"""Shapes that were never modelled: clouds stretched along the axes of their objects.

A pose label says where the object's axes are, so a cloud can be made longer, wider or flatter as
the object would be. An affine map takes lines of sight to lines of sight: what was seen stays what
is seen, of the stretched object, from the camera's image under the map. Rotations drawn on all of
SO(3) leave no preferred camera, so the cloud is as good as a rendered one; and the object's axes
stay where they were, so the pose label holds.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from partialbench.benchmark.prediction import Batch


def stretched(batch: Batch, most: float) -> Tensor:
    """Points (B,N,3) of the batch, each cloud stretched along its object's three axes.

    Args:
        most: each axis is drawn log-uniformly between 1/most and most; 1 changes nothing.
    """
    if most == 1:
        return batch.points
    R = batch.rotation.to(batch.points.dtype)
    draw = 2 * torch.rand(len(R), 3, device=R.device, dtype=R.dtype) - 1
    factors = (draw * math.log(most)).exp()
    # p = R·q with q in the object's frame; the translation does not matter, clouds are normalised.
    return batch.points @ (R * factors[:, None]) @ R.mT
