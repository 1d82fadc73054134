"""The first layer and its pooling on an occupancy volume, computed only where a point is near.

A cloud of 1,024 points fills 0.4 % of 64³ voxels. Everywhere else the layer's answer is one
constant vector, yet as a dense volume its output is by far the largest tensor of the network.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn

from baselines.steerable import GatedBlock


def pooled_first_layer(block: GatedBlock, volume: Tensor, points: int | None = None) -> Tensor:
    """``avg_pool3d(block(volume), 3, stride=2, padding=1)`` without the dense volume between.

    Args:
        block: a gated block of size 3, padding 1, stride 1, from one scalar field.
        volume: (B,1,X,Y,Z), mostly zero, even edges.
        points: how many voxels of a volume are not zero, at most. With it as many rows are computed
            as those could reach, and no device has to be waited for.

    Returns:
        (B,C,X/2,Y/2,Z/2) float32.
    """
    with torch.autocast(volume.device.type, enabled=False):
        kernel, bias = block.convolution.normalised_kernel(volume)
        cells, patches = _patches(volume, points)
        responses = torch.addmm(bias, patches, kernel.flatten(1).T)
        values = block.gate(responses[..., None, None, None]).flatten(1)
        background = block.gate(bias.view(1, -1, 1, 1, 1)).flatten(1)
        # Zero padding counts in the mean, so at the border the background weighs less.
        coverage = nn.functional.avg_pool3d(
            torch.ones_like(volume[:1]), 3, stride=2, padding=1
        ).flatten()
        half = [edge // 2 for edge in volume.shape[2:]]
        pooled = (coverage[:, None] * background).repeat(len(volume), 1)
        difference = (values - background) / 27
        for inside, target in _windows(cells, half):
            if points is None:
                rows = inside.nonzero()[:, 0]
                pooled = pooled.index_add(0, target[rows], difference[rows])
            else:
                pooled = pooled.index_add(0, target * inside, difference * inside[:, None])
        return pooled.view(len(volume), *half, -1).permute(0, 4, 1, 2, 3).contiguous()


def _patches(volume: Tensor, most: int | None) -> tuple[Tensor, Tensor]:
    """Voxels with anything in their 3³ neighbourhood: (n,4) as (b, x, y, z), and it, (n,27).

    Args:
        most: voxels of a volume that are not zero. With it the n are as many as there could be,
            those beyond what there are with nothing about them.
    """
    padded = nn.functional.pad(volume[:, 0], (1,) * 6)
    B, X, Y, Z = padded.shape
    step = torch.arange(-1, 2, device=volume.device)
    offsets = (step[:, None, None] * (Y * Z) + step[:, None] * Z + step).flatten()
    if most is None:
        near = torch.zeros(padded.numel(), dtype=torch.bool, device=volume.device)
        near[(padded.flatten().nonzero() + offsets).flatten()] = True
        b, x, y, z = near.view(padded.shape)[:, 1:-1, 1:-1, 1:-1].nonzero().unbind(1)
    else:
        near = nn.functional.max_pool3d(padded.abs(), 3, stride=1).flatten(1) > 0
        count = min(27 * most, near.shape[1])
        cell = near.to(torch.uint8).topk(count, dim=1, sorted=False).indices
        b = torch.arange(B, device=volume.device).repeat_interleave(count)
        column, z = cell.flatten() // (Z - 2), cell.flatten() % (Z - 2)
        x, y = column // (Y - 2), column % (Y - 2)
    centre = ((b * X + x + 1) * Y + y + 1) * Z + z + 1
    return torch.stack([b, x, y, z], dim=1), padded.flatten()[centre[:, None] + offsets]


def _windows(cells: Tensor, half: list[int]) -> list[tuple[Tensor, Tensor]]:
    """Which pooled voxels each cell counts in: (whether it does, flat pooled index) pairs, (n,).

    Window j covers 2j−1, 2j, 2j+1: an even index lies in window i/2 alone, an odd one also in the
    next, where there is one.
    """
    pairs = []
    for upper in itertools.product((0, 1), repeat=3):
        inside = torch.ones_like(cells[:, 0], dtype=torch.bool)
        target = cells[:, 0]
        for axis, add in enumerate(upper):
            i = cells[:, axis + 1]
            inside &= (i // 2 + add < half[axis]) & ((i % 2 == 1) if add else True)
            target = target * half[axis] + i // 2 + add
        pairs.append((inside, target))
    return pairs
