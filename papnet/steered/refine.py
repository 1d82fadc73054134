"""Poses between those of the grid, by climbing the score: it is band-limited in the pose.

A pose R turned a little about axis a changes its Wigner matrices by dD = J_a·D, so the hidden layer
has a slope in closed form and a step costs what scoring one more pose does. A step is kept where it
climbs and halved where it does not: no pose comes out less likely than it went in.
"""

from __future__ import annotations

import math
from functools import cache

import roma
import torch
from torch import Tensor

from baselines.steerable.fields import wigner_matrix
from papnet.steered.head import JointHead, View, wigner_entries

REFINED = 8
"""The most likely poses of the grid are refined: among them the true one lies in 3 of 4 clouds."""
FIRST_STEP = math.radians(10)
_SMALL = 1e-4


@cache
def generators(degree: int) -> Tensor:
    """(3,2l+1,2l+1) float64 J_a: D(e^{ω×}·R) = D(R) + Σ_a ω_a·J_a·D(R) + O(ω²)."""
    turns = roma.rotvec_to_rotmat(_SMALL * torch.eye(3, dtype=torch.float64))
    there, back = wigner_matrix(degree, turns), wigner_matrix(degree, turns.mT)
    return (there - back) / (2 * _SMALL)


def gradient(head: JointHead, view: View, rotation: Tensor) -> Tensor:
    """(B,T,3) slope of log Σ_classes e^score over small turns of the poses (B,T,3,3)."""
    slopes = head.slopes(view, wigner_entries(rotation, head.lmax))
    turned = [wigner_matrix(degree, rotation) for degree in range(head.lmax + 1)]
    found = []
    for axis in range(3):
        entries = torch.cat(
            [
                (generators(degree)[axis].to(rotation) @ D).flatten(-2)
                for degree, D in enumerate(turned)
            ],
            dim=-1,
        )
        found.append((slopes * (entries.to(slopes.dtype) @ view.coefficients)).sum(-1))
    return torch.stack(found, dim=-1)


def climb(head: JointHead, view: View, rotation: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Poses (B,T,3,3) and their scores (B,T,K) after so many steps up the score.

    Args:
        rotation: (B,T,3,3) object → camera, where to begin.
    """
    scores = head.scores(view, wigner_entries(rotation, head.lmax))
    step = scores.new_full(scores.shape[:2], FIRST_STEP)
    for _ in range(steps):
        slope = gradient(head, view, rotation)
        direction = slope / slope.norm(dim=-1, keepdim=True).clamp_min(1e-12)
        turn = roma.rotvec_to_rotmat((step[..., None] * direction).to(rotation.dtype))
        tried = turn @ rotation
        there = head.scores(view, wigner_entries(tried, head.lmax))
        better = there.logsumexp(-1) > scores.logsumexp(-1)
        rotation = torch.where(better[..., None, None], tried, rotation)
        scores = torch.where(better[..., None], there, scores)
        step = torch.where(better, step, step / 2)
    return rotation, scores
