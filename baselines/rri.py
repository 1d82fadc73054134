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
balls keep their nearest points. RRI's own discontinuities are ramps (``RAMP``, ``FADE``; gentler by
``--option ramp=0.2``). What remains is rounding: a ramp is steep, and where two distances agree to
the last digits a turned cloud may choose the other.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from baselines.chunks import chunks
from baselines.pointnet2 import PointNet2
from baselines.points import (
    distances,
    farthest_from_centre,
    full_precision,
    gather,
    normalise,
    smallest,
)
from baselines.shared_mlp import NormLinear
from partialbench import given
from partialbench.benchmark.prediction import Prediction
from partialbench.errors import InputError

NEIGHBOURS = 32
WIDTH = 64
LARGEST = math.pi / 2
"""Radians; larger φ, of neighbourhoods open to one side, count as this."""
RAMP = 0.02
"""Radians. As defined, φ_ik jumps where a neighbour's direction passes another's: ψ = 0 turns into
2π and the least angle into the gap to the next. Equal directions are common (symmetric shapes,
repeated points), and rounding would decide. Here a follower nearer than the ramp counts as
ψ + LARGEST·(1 − ψ/ramp), which is LARGEST on both sides of ψ = 0: φ is continuous, and as defined
where no two directions are that near. A longer ramp is gentler to rounding but is another feature:
the gaps between 32 directions average 2π/32 = 0.196, and under a ramp as long as that most φ are
not as defined. The model's card has the figures of both."""
FADE = 0.5
"""Share of the ramp that is the length below which a direction fades out: of p_i near the centroid,
of a neighbour across p̂_i when it is in line with it. Their angles would be rounding alone."""


def across(p: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors that make a right-handed frame with each unit vector p (…,3)."""
    # The axis least along p, so that the product is never short.
    axis = F.one_hot(p.abs().argmin(dim=-1), 3).to(p.dtype)
    u = F.normalize(torch.linalg.cross(p, axis), dim=-1)
    return u, torch.linalg.cross(p, u)


@torch.no_grad()
def rri(
    points: Tensor, k: int = NEIGHBOURS, ramp: float = RAMP, dtype: torch.dtype | None = None
) -> Tensor:
    """RRI features (B,N,k,4) as (r_i, r_ik, θ_ik, φ_ik) of normalised clouds (B,N,3); no gradient.

    ``dtype`` is the features', the clouds' own by default; neighbours are chosen in it.

    φ is 0 for a neighbour in line with p_i, which is nobody's follower; θ and φ are 0 for a point
    at the centroid. Neighbours are the k nearest other points, in no particular order.

    Raises:
        InputError: for clouds of k points or fewer.
    """
    if points.shape[1] <= k:
        raise InputError(
            f"{k} neighbours need clouds of at least {k + 1} points, got {points.shape[1]}"
        )
    with torch.autocast(points.device.type, enabled=False):
        precise = full_precision(points).double()
        points = precise.to(dtype or full_precision(points).dtype)
        distance = distances(points, points)
        distance.diagonal(dim1=1, dim2=2).fill_(torch.inf)
        nearest = smallest(distance, k)[1]
        # What the ramps make steep is computed in double precision: k angles a point, not k².
        q = gather(precise, nearest)
        r = torch.linalg.vector_norm(precise, dim=-1)
        r_k = torch.linalg.vector_norm(q, dim=-1)
        p = precise / r[..., None].clamp_min(1e-12)
        # In a frame about p, q = (x, y, along): θ and ψ are read off without acos.
        u, v = across(p)
        x, y, along = (q @ torch.stack([u, v, p], dim=-1)).unbind(-1)
        length = torch.hypot(x, y)
        shortest = FADE * ramp
        fade = (r / shortest).clamp_max(1)[..., None]
        theta = (torch.atan2(length, along) * fade).to(points.dtype)
        has_direction = (length / shortest).clamp_max(1).to(points.dtype)
        angle = torch.atan2(y, x).to(points.dtype)
        phi = torch.empty_like(theta)
        for part in chunks(len(points), points.shape[1] * k * k, points.device):
            phi[part] = _to_follower(angle[part], has_direction[part], ramp)
        phi *= fade.to(points.dtype)
        r, r_k = r.to(points.dtype), r_k.to(points.dtype)
        return torch.stack([r[..., None].expand_as(r_k), r_k, theta, phi], dim=-1)


def _to_follower(angle: Tensor, has_direction: Tensor, ramp: float) -> Tensor:
    """φ (…,k) from the angles (…,k) of the neighbours about p."""
    psi = angle[..., None, :] - angle[..., None]
    psi.add_((psi < 0).to(psi.dtype), alpha=2 * math.pi)
    # A neighbour is its own follower at ψ = 0, which the ramp makes LARGEST.
    psi.add_((psi * (-1 / ramp)).add_(1).clamp_min_(0), alpha=LARGEST)
    psi.add_((1 - has_direction)[..., None, :], alpha=LARGEST)
    return psi.amin(dim=-1).clamp_max_(LARGEST).mul_(has_direction)


class RRIPointNet2(nn.Module):
    """PointNet++ (SSG) on rotation-invariant features; its logits do not depend on the pose."""

    def __init__(self, num_classes: int, k: int = NEIGHBOURS, ramp: float = RAMP) -> None:
        """``k`` neighbours of every point; ``ramp`` in radians, see ``RAMP``.

        Raises:
            InputError: no neighbour, or a ramp that is none: not above 0, or so long that every φ
                would be ``LARGEST``.
        """
        super().__init__()
        if not 0 < ramp < LARGEST:
            raise InputError(
                f"ramp must be an angle in radians above 0 and below π/2, from where on every φ is "
                f"π/2; got {ramp}"
            )
        self.k = given.whole_number(k, "k", least=1)
        self.ramp = ramp
        self.embed = NormLinear(4, WIDTH)
        self.classifier = PointNet2(num_classes, features=WIDTH, use_xyz=False, nearest=True)

    def forward(self, points: Tensor) -> Prediction:
        """(B,N,3) clouds in the camera frame, N > k → logits (B,K)."""
        precise = normalise(points, dtype=torch.float64)
        points = precise.float()
        features = F.relu_(self.embed.max(rri(precise, self.k, self.ramp, points.dtype)))
        start = farthest_from_centre(points)
        return Prediction(self.classifier.classify(points, features, start))
