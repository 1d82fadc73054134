"""The first layer and its pooling on an occupancy volume, computed only where a point is near.

A cloud of 1,024 points fills 0.4 % of 64³ voxels. Everywhere else the layer's answer is one
constant vector, yet as a dense volume its output is by far the largest tensor of the network.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn

from baselines.steerable import GatedBlock


def pooled_first_layer(block: GatedBlock, volume: Tensor) -> Tensor:
    """``avg_pool3d(block(volume), 3, stride=2, padding=1)`` without the dense volume between.

    Args:
        block: a gated block of size 3, padding 1, stride 1, from one scalar field.
        volume: (B,1,X,Y,Z), mostly zero, even edges.

    Returns:
        (B,C,X/2,Y/2,Z/2) float32.
    """
    with torch.autocast(volume.device.type, enabled=False):
        kernel, bias = block.convolution.normalised_kernel(volume)
        cells, patches = _patches(volume)
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
        for rows, target in _windows(cells, half):
            pooled = pooled.index_add(0, target, difference[rows])
        return pooled.view(len(volume), *half, -1).permute(0, 4, 1, 2, 3).contiguous()


def _patches(volume: Tensor) -> tuple[Tensor, Tensor]:
    """Voxels with anything in their 3³ neighbourhood: (n,4) as (b, x, y, z), and it, (n,27)."""
    padded = nn.functional.pad(volume[:, 0], (1,) * 6)
    _, _, Y, Z = padded.shape
    step = torch.arange(-1, 2, device=volume.device)
    offsets = (step[:, None, None] * (Y * Z) + step[:, None] * Z + step).flatten()
    near = torch.zeros(padded.numel(), dtype=torch.bool, device=volume.device)
    near[(padded.flatten().nonzero() + offsets).flatten()] = True
    cells = near.view(padded.shape)[:, 1:-1, 1:-1, 1:-1].nonzero()
    b, x, y, z = cells.unbind(1)
    centre = ((b * padded.shape[1] + x + 1) * Y + y + 1) * Z + z + 1
    return cells, padded.flatten()[centre[:, None] + offsets]


def _windows(cells: Tensor, half: list[int]) -> list[tuple[Tensor, Tensor]]:
    """Which pooled voxels each cell counts in: (rows of ``cells``, flat pooled index) pairs.

    Window j covers 2j−1, 2j, 2j+1: an even index lies in window i/2 alone, an odd one also in the
    next, where there is one.
    """
    pairs = []
    for upper in itertools.product((0, 1), repeat=3):
        add = torch.tensor(upper, device=cells.device)
        window = cells[:, 1:] // 2 + add
        inside = ((add == 0) | (cells[:, 1:] % 2 == 1)) & (window < window.new_tensor(half))
        rows = inside.all(1).nonzero()[:, 0]
        x, y, z = window[rows].unbind(1)
        target = ((cells[rows, 0] * half[0] + x) * half[1] + y) * half[2] + z
        pairs.append((rows, target))
    return pairs
