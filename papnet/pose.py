"""Pose in training: bins, soft targets and noise, in torch, on the batch's device.

Frames: every rotation is object → camera; what brings a cloud to its canonical pose is the inverse.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from partialbench.geometry.bins import rotation_bins

SOFT_WEIGHTS = (0.4, 0.2, 0.2, 0.2)


def bins(like: Tensor) -> Tensor:
    """The 60 rotations, (60,3,3), on ``like``'s device and in its dtype."""
    return torch.as_tensor(rotation_bins().copy(), device=like.device, dtype=like.dtype)


def similarity(rotation: Tensor) -> Tensor:
    """(B,60) tr(R_bᵀ·R) = 1 + 2·cos of the angle to each bin."""
    return rotation.flatten(1) @ bins(rotation).flatten(1).T


def nearest_bin(rotation: Tensor) -> Tensor:
    """(B,3,3) → (B,) int64."""
    return similarity(rotation).argmax(1)


def soft_target(rotation: Tensor) -> Tensor:
    """(B,60): 0.4 on the nearest bin and 0.2 on each of the next three."""
    order = similarity(rotation).topk(len(SOFT_WEIGHTS)).indices
    weights = torch.stack([rotation.new_full((len(rotation),), w) for w in SOFT_WEIGHTS], dim=1)
    return rotation.new_zeros(len(rotation), len(bins(rotation))).scatter_(1, order, weights)


def noise(rotation: Tensor, delta_deg: float) -> Tensor:
    """Rz(c)·Ry(b)·Rx(a)·R with every angle ~ U(−δ, δ), from torch's global generator.

    Source: the paper's footnote on U(−δ, δ); order of the factors from the release.
    """
    angles = math.radians(delta_deg) * (2 * torch.rand_like(rotation[:, 0]) - 1)
    a, b, c = angles.unbind(-1)
    zero, one = torch.zeros_like(a), torch.ones_like(a)

    def matrix(*entries: Tensor) -> Tensor:
        return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))

    Rx = matrix(one, zero, zero, zero, a.cos(), -a.sin(), zero, a.sin(), a.cos())
    Ry = matrix(b.cos(), zero, b.sin(), zero, one, zero, -b.sin(), zero, b.cos())
    Rz = matrix(c.cos(), -c.sin(), zero, c.sin(), c.cos(), zero, zero, zero, one)
    return Rz @ Ry @ Rx @ rotation
