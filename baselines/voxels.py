"""Voxel grids of clouds, over [−1, 1]³ with axes (x, y, z): (B,1,edge,edge,edge) float32."""

from __future__ import annotations

import torch
from torch import Tensor, nn


@torch.no_grad()
def occupancy(points: Tensor, edge: int) -> Tensor:
    """1 where a voxel holds a point, else 0.

    Voxel i of an axis covers [−1 + 2i/edge, −1 + 2(i+1)/edge); points outside the cube are left
    out. Source of the convention: TerenceHsu666/PAPNet@878adcc (which fails at exactly +1).

    Args:
        points: (B,N,3) in the unit ball.
    """
    cell = torch.floor((points.float() + 1) * (edge / 2)).long()
    inside = ((cell >= 0) & (cell < edge)).all(-1)
    index = (cell[..., 0] * edge + cell[..., 1]) * edge + cell[..., 2]
    # One slot more than the grid takes what is outside.
    grid = torch.zeros(len(points), edge**3 + 1, device=points.device)
    grid.scatter_(1, index.where(inside, edge**3), 1.0)
    return grid[:, :-1].reshape(-1, 1, edge, edge, edge)


def low_pass(volume: Tensor, sigma: float, radius: int) -> Tensor:
    """Gaussian blur with zero padding.

    Args:
        volume: (B,1,X,Y,Z).
        sigma: in voxels.
        radius: the kernel has 2·radius+1 taps an axis, normalised to sum to one.
    """
    taps = torch.arange(-radius, radius + 1, device=volume.device, dtype=volume.dtype)
    kernel = torch.exp(-(taps**2) / (2 * sigma**2))
    kernel = kernel / kernel.sum()
    for axis in range(3):
        shape = [1, 1, 1, 1, 1]
        shape[2 + axis] = len(kernel)
        padding = [0, 0, 0]
        padding[axis] = radius
        volume = nn.functional.conv3d(volume, kernel.view(shape), padding=tuple(padding))
    return volume
