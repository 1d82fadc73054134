"""Pose in training: bins, soft targets and noise, in torch, on the batch's device.

A half precision would tell bins apart to a few degrees: autocast is off wherever rotations meet.

Frames: every rotation is object → camera; what brings a cloud to its canonical pose is the inverse.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from baselines.points import full_precision, geometric, require_sound
from partialbench.errors import InputError
from partialbench.geometry.bins import rotation_bins

SOFT_WEIGHTS = (0.4, 0.2, 0.2, 0.2)


TOLERANCE = 1e-3
"""Of the entries of R·Rᵀ of a pose that is told."""


@geometric
def told(rotation: Tensor, clouds: int) -> Tensor:
    """Poses (B,3,3) that are told with so many clouds, in full precision.

    Raises:
        InputError: for another shape or dtype, or what is no rotation: NaN, a scale, a reflection;
            on other devices than the CPU torch's own error for the last.
    """
    if rotation.shape != (clouds, 3, 3) or not rotation.is_floating_point():
        raise InputError(
            f"expected one rotation per cloud, floating and of shape {(clouds, 3, 3)}, "
            f"got {tuple(rotation.shape)} {rotation.dtype}"
        )
    rotation = full_precision(rotation)
    identity = torch.eye(3, device=rotation.device, dtype=rotation.dtype)
    off = (rotation @ rotation.mT - identity).abs().amax((1, 2))
    sound = (off <= TOLERANCE) & (torch.linalg.det(rotation) > 0)
    require_sound(
        sound, "a pose that was told is no rotation",
        lambda which: f"the pose told with cloud {which} of the batch is no rotation: R·Rᵀ must be "
        f"the identity and det R = 1, got R = {rotation[which].tolist()}",
    )  # fmt: skip
    return rotation


def bins(like: Tensor) -> Tensor:
    """The 60 rotations, (60,3,3), on ``like``'s device and in its dtype."""
    return torch.as_tensor(rotation_bins().copy(), device=like.device, dtype=like.dtype)


def similarity(rotation: Tensor) -> Tensor:
    """(…,60) tr(R_bᵀ·R) = 1 + 2·cos of the angle to each bin, of (…,3,3)."""
    return to_each(rotation, bins(full_precision(rotation)).flatten(1))


def to_each(rotation: Tensor, poses: Tensor) -> Tensor:
    """(…,P) tr(R_pᵀ·R) to each of P poses (P,9), of (…,3,3), in full precision."""
    with torch.autocast(rotation.device.type, enabled=False):
        return full_precision(rotation).flatten(-2) @ poses.T


def nearest_bin(rotation: Tensor) -> Tensor:
    """(B,3,3) → (B,) int64."""
    return similarity(rotation).argmax(1)


def soft_target(rotation: Tensor) -> Tensor:
    """(B,60): 0.4 on the nearest bin and 0.2 on each of the next three; NaN where a pose is."""
    near = similarity(rotation)
    order = near.topk(len(SOFT_WEIGHTS)).indices
    weights = torch.stack([rotation.new_full((len(rotation),), w) for w in SOFT_WEIGHTS], dim=1)
    # Of NaN some bins come out first, too; a loss on them would be a number like any other.
    return (0 * near).scatter_(1, order, weights)


@geometric
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
