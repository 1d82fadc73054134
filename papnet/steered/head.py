"""Scores of every class under every pose, from a steerable descriptor x.

Under the pose R (object → camera) the descriptor brought to the object's frame is D(R)ᵀ·x, and one
hidden layer reads it: h(R) = Σ_l W_l·D^l(R)ᵀ·x_l. With W_l: (H,C,2l+1) this is

    h(R) = Σ_l Σ_mn D^l_mn(R)·G^l_mn,      G^l_mn = Σ_c x_l[c,m]·W_l[·,c,n]

a band-limited function on SO(3) with the Fourier coefficients G. They are computed once a cloud;
each pose then costs a product with its Σ(2l+1)² (84 for l ≤ 3) Wigner entries instead of a turned
descriptor and a hidden layer of its own.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from baselines.steerable.fields import wigner_matrix
from papnet.steered.descriptor import Descriptor
from papnet.steered.poses import pose_grid


def wigner_entries(rotation: Tensor, lmax: int) -> Tensor:
    """(…,3,3) → (…,Σ(2l+1)²): every entry of D^0(R), …, D^lmax(R), row after row."""
    return torch.cat(
        [wigner_matrix(degree, rotation).flatten(-2) for degree in range(lmax + 1)], dim=-1
    )


def num_invariants(channels: int, width: int, lmax: int) -> int:
    """How many ``invariants`` a descriptor has."""
    return channels * (lmax + 1) + width


def invariants(x: Descriptor) -> Tensor:
    """(B,C·(lmax+1) + W): scalars, the norms of all other channels, the invariant features."""
    scalars, *others = x.steerable.values()
    # The square root of a tiny number, not of zero: its slope is finite.
    norms = [(part.square().mean(2) + 1e-6).sqrt() for part in others]
    return torch.cat([scalars[..., 0], *norms, x.invariant], dim=1)


def num_joint_weights(channels: int, width: int, lmax: int, hidden: int) -> int:
    """Weights of the hidden layer of ``JointHead``."""
    return hidden * (channels * (lmax + 1) ** 2 + num_invariants(channels, width, lmax))


class JointHead(nn.Module):
    """Descriptor → unnormalised log-probabilities of (pose, class).

    Args:
        channels, width, lmax: of the descriptor.
        hidden: H.
        poses: how many poses are tried, see ``pose_grid``.
    """

    def __init__(
        self, channels: int, width: int, lmax: int, hidden: int, num_classes: int, poses: int
    ) -> None:
        super().__init__()
        self.lmax = lmax
        fan_in = channels * (lmax + 1) ** 2
        self.weights = nn.ParameterList(
            torch.randn(channels, (2 * degree + 1) * hidden) / fan_in**0.5
            for degree in range(lmax + 1)
        )
        self.invariant = nn.Linear(num_invariants(channels, width, lmax), hidden, bias=False)
        self.norm = nn.BatchNorm1d(hidden)
        self.score = nn.Linear(hidden, num_classes)
        self.entries: Tensor
        entries = wigner_entries(torch.tensor(pose_grid(poses)), lmax)
        self.register_buffer("entries", entries.float(), persistent=False)

    def coefficients(self, x: Descriptor) -> Tensor:
        """G: (B,Σ(2l+1)²,H)."""
        parts = []
        for degree, weight in enumerate(self.weights):
            m = 2 * degree + 1
            parts.append((x.steerable[degree].mT @ weight).unflatten(2, (m, -1)).flatten(1, 2))
        return torch.cat(parts, dim=1)

    def forward(self, x: Descriptor, rotation: Tensor | None = None) -> Tensor:
        """Scores (B,P,K) under P poses.

        Args:
            rotation: (B,P,3,3) object → camera; by default those of ``pose_grid``.
        """
        G = self.coefficients(x)
        if rotation is None:
            entries = self.entries
        else:
            entries = wigner_entries(rotation.to(G.device), self.lmax)
        h = entries.to(G.dtype) @ G + self.invariant(invariants(x))[:, None]
        return self.score(F.relu(self.norm(h.flatten(0, 1)).view_as(h)))


class InvariantHead(nn.Module):
    """The same descriptor without its pose: its invariants into a classifier.

    Args:
        channels, width, lmax: of the descriptor.
        hidden: of the second hidden layer.
        budget: weights of both hidden layers; the first is as wide as that allows.
    """

    def __init__(
        self, channels: int, width: int, lmax: int, hidden: int, num_classes: int, budget: int
    ) -> None:
        super().__init__()
        inputs = num_invariants(channels, width, lmax)
        wide = round(budget / (inputs + hidden))
        self.layers = nn.Sequential(
            nn.Linear(inputs, wide, bias=False),
            nn.BatchNorm1d(wide),
            nn.ReLU(),
            nn.Linear(wide, hidden, bias=False),
            nn.BatchNorm1d(hidden),
            nn.ReLU(),
            nn.Linear(hidden, num_classes),
        )

    def forward(self, x: Descriptor) -> Tensor:
        """(B,K)."""
        return self.layers(invariants(x))
