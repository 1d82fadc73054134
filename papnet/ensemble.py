"""The class branch under many poses, computing once what the grid's own symmetries share.

Twelve of the 60 bins (the rotations of the tetrahedron) turn the voxel grid onto itself, and the
steerable layers commute with such turns exactly. So with a bin's canonicalising rotation written as
R_bᵀ = P·S·h, where h is one of five coset representatives, S a half turn about an axis (or none)
and P a cyclic permutation of the axes::

    conv0(T_{PSh} F)           = T_P T_S conv0(T_h F)           5 evaluations, not 60
    mean conv2 conv1 pool(…)   = ρ(P) mean conv2 conv1 pool(T_S conv0(T_h F))      20, not 60

The pooling samples at even indices, which a half turn makes odd: it commutes with P but not with S.
Nothing is approximated: the answers are those of one pose at a time, to rounding.
"""

from __future__ import annotations

import itertools
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from baselines.steerable import Fields
from papnet.parts import Backbone, ClassHead, pool
from papnet.rotate_field import rotate_field
from partialbench.geometry.bins import rotation_bins

# Feature volumes held at a time, in bytes.
_CHUNK_BYTES = 64 << 20


class Decomposition(NamedTuple):
    """R_bᵀ = permutations[p[b]] · half_turns[s[b]] · representatives[h[b]] for every bin b.

    Attributes:
        representatives: (5,3,3).
        half_turns: (4,3,3), diagonal, the identity first.
        permutations: (3,3,3), the identity first.
        h, s, p: (60,) int64.
    """

    representatives: Tensor
    half_turns: Tensor
    permutations: Tensor
    h: Tensor
    s: Tensor
    p: Tensor


@cache
def decompose_bins() -> Decomposition:
    """The decomposition of the 60 bins, float64 on the CPU."""
    half_turns = np.stack(
        [np.diag(d).astype(float) for d in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))]
    )
    permutations = np.stack([np.roll(np.eye(3), i, axis=0) for i in range(3)])
    representatives: list[np.ndarray] = []
    found = []
    for R in rotation_bins():
        for h, s, p in itertools.product(range(len(representatives) + 1), range(4), range(3)):
            if h == len(representatives):
                representatives.append(R.T)
            product = permutations[p] @ half_turns[s] @ representatives[h]
            if np.abs(product - R.T).max() < 1e-9:
                found.append((h, s, p))
                break
    assert len(representatives) == 5
    assert len(found) == 60
    turns = [torch.tensor(t) for t in (np.stack(representatives), half_turns, permutations)]
    return Decomposition(*turns, *torch.tensor(found).unbind(1))


def half_turn(field: Tensor, turn: Tensor, fields: Fields) -> Tensor:
    """``rotate_field`` for one diagonal rotation (3,3): voxels and signs change places, exactly."""
    axes = [2 + i for i in range(3) if turn[i, i] < 0]
    if not axes:
        return field
    signs = [
        fields.wigner(turn)[degree].diagonal().round().repeat(m) for degree, m, _ in fields.degrees
    ]
    sign = torch.cat(signs).to(field).view(-1, 1, 1, 1)
    return field.flip(axes) * sign


def classify_under_bins(head: ClassHead, features: Tensor, bins: Tensor) -> Tensor:
    """Class logits of a head in evaluation mode under several poses a sample.

    Args:
        features: (B,256,X,X,X), the backbone's, as observed.
        bins: (B,k) int64, poses as bins, object → camera.

    Returns:
        (B,k,K).
    """
    table = decompose_bins()
    device = features.device
    flat = bins.flatten()
    h, s, p = (index.to(device)[flat] for index in (table.h, table.s, table.p))
    sample = torch.arange(len(bins), device=device).repeat_interleave(bins.shape[1])
    # What is distinct: (sample, h) for conv0, and (sample, h, s) for what follows.
    turned, of_turned = torch.unique(sample * 5 + h, return_inverse=True)
    pooled, of_pooled = torch.unique(of_turned * 4 + s, return_inverse=True)

    at_once = max(1, _CHUNK_BYTES // (features[0].numel() * features.element_size()))
    representatives = table.representatives.to(device, torch.float32)
    descriptors = features.new_zeros(len(pooled), head.descriptor.channels)
    for start in range(0, len(turned), at_once):
        now = turned[start : start + at_once]
        field = rotate_field(features[now // 5], representatives[now % 5], Backbone.fields)
        field = head.conv0(field)
        for turn_index, turn in enumerate(table.half_turns):
            volume = pooled // 4 - start
            inside = (volume >= 0) & (volume < len(now)) & (pooled % 4 == turn_index)
            rows = inside.nonzero()[:, 0]
            if len(rows):
                part = half_turn(field[volume[rows]], turn, Backbone.fields)
                descriptors[rows] = head.describe(pool(part)).to(descriptors.dtype)

    permutations = table.permutations.to(device, torch.float32)[p]
    wigner = head.descriptor.wigner(permutations)
    answers = head.descriptor.rotate_components(descriptors[of_pooled], wigner)
    return head.fc(answers).view(*bins.shape, -1)
