"""RRI before PointNet++: rotation-invariant numbers of every neighbourhood, then the classifier.

RRI is ClusterNet's representation (Chen et al., CVPR 2019). With the centroid as origin, p_i a
point and q_k its neighbours, hats for unit vectors, neighbour k gives

    r_i = |p_i|,   r_ik = |q_k|,   θ_ik = ∠(p_i, q_k),   φ_ik = min over j of ψ_kj ≥ 0

where ψ_kj is the angle about p̂_i from t_k to t_j, the neighbours' directions across p̂_i, modulo
2π. No official code was found. Re-implementations differ in ψ's sign: the minimum over (−π, π], of
|ψ|, which cannot tell a shape from its mirror image, or modulo 2π as here.

The paper compares with this pair but releases no code for it. Ours: k = 32 neighbours, one shared
layer 4-64 and the maximum over neighbours make a point's feature; PointNet++ (SSG) samples and
groups by coordinates but sees these features alone, in its last level too. Everything chosen by
coordinates is independent of the pose: sampling starts at the point farthest from the centroid and
balls keep their nearest points. What remains is rounding: where two distances agree to the last
digits, a turned cloud may choose the other.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from baselines.pointnet2 import PointNet2
from baselines.points import (
    distances,
    farthest_from_centre,
    full_precision,
    gather,
    normalise,
)
from baselines.shared_mlp import NormLinear
from partialbench.benchmark.prediction import Prediction

NEIGHBOURS = 32
WIDTH = 64
TIE = 1e-3
"""Radians within which two directions count as one. Exactly equal directions are common (symmetric
shapes, repeated points); without a tolerance rounding would decide which of them comes first, and
with it whether an angle is 0 or the whole gap to the next."""
SMALL = 1e-5
"""Lengths below this have no direction: a point at the centroid, a neighbour in line with p_i."""


def across(p: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors that make a right-handed frame with each unit vector p (…,3)."""
    # The axis least along p, so that the product is never short.
    axis = F.one_hot(p.abs().argmin(dim=-1), 3).to(p.dtype)
    u = F.normalize(torch.linalg.cross(p, axis), dim=-1)
    return u, torch.linalg.cross(p, u)


@torch.no_grad()
def rri(points: Tensor, k: int = NEIGHBOURS) -> Tensor:
    """RRI features (B,N,k,4) as (r_i, r_ik, θ_ik, φ_ik) of centred clouds (B,N,3); no gradient.

    φ is 2π for a neighbour whose direction across p̂_i no other follows, and 0 for one that has no
    such direction (in line with p_i, or p_i at the centroid); the latter is nobody's successor.
    Neighbours are the k nearest other points, in no particular order.
    """
    with torch.autocast(points.device.type, enabled=False):
        points = full_precision(points)
        distance = distances(points, points)
        distance.diagonal(dim1=1, dim2=2).fill_(torch.inf)
        q = gather(points, distance.topk(k, dim=-1, largest=False, sorted=False).indices)
        r = torch.linalg.vector_norm(points, dim=-1)
        r_k = torch.linalg.vector_norm(q, dim=-1)
        p = torch.where(r[..., None] > SMALL, points / r[..., None].clamp_min(SMALL), 0.0)
        # In a frame about p, q = (x, y, along): θ and ψ are read off without acos.
        u, v = across(p)
        x, y, along = (q @ torch.stack([u, v, p], dim=-1)).unbind(-1)
        across_length = torch.hypot(x, y)
        theta = torch.atan2(across_length, along)
        has_direction = across_length > SMALL
        # The least ψ_kj is the gap to the next direction counter-clockwise: sort instead of
        # comparing all pairs. A second turn follows the first; those without direction are last.
        angle = torch.where(has_direction, torch.atan2(y, x), torch.inf)
        first = angle.sort(dim=-1).values
        turns = torch.cat([first, first + 2 * math.pi], dim=-1).sort(dim=-1).values
        follower = torch.searchsorted(turns, angle + TIE, right=True).clamp_max(2 * k - 1)
        phi = torch.where(has_direction, turns.gather(-1, follower) - angle, 0.0)
        return torch.stack([r[..., None].expand_as(r_k), r_k, theta, phi], dim=-1)


class RRIPointNet2(nn.Module):
    """PointNet++ (SSG) on rotation-invariant features; its logits do not depend on the pose."""

    def __init__(self, num_classes: int, k: int = NEIGHBOURS) -> None:
        super().__init__()
        self.k = k
        self.embed = NormLinear(4, WIDTH)
        self.classifier = PointNet2(num_classes, features=WIDTH, use_xyz=False, nearest=True)

    def forward(self, points: Tensor) -> Prediction:
        """(B,N,3) clouds in the camera frame, N > k → logits (B,K)."""
        points = normalise(points)
        features = F.relu_(self.embed.max(rri(points, self.k)))
        start = farthest_from_centre(points)
        return Prediction(self.classifier.classify(points, features, start))
