"""Scores of every class under every pose, from a steerable descriptor x.

Under the pose R (object → camera) the descriptor brought to the object's frame is D(R)ᵀ·x, and one
hidden layer reads it: h(R) = Σ_l W_l·D^l(R)ᵀ·x_l. With W_l: (H,C,2l+1) this is

    h(R) = Σ_l Σ_mn D^l_mn(R)·G^l_mn,      G^l_mn = Σ_c x_l[c,m]·W_l[·,c,n]

a band-limited function on SO(3) with the Fourier coefficients G. They are computed once a cloud;
each pose then costs a product with its Σ(2l+1)² (84 for l ≤ 3) Wigner entries instead of a turned
descriptor and a hidden layer of its own.
"""

from __future__ import annotations

from typing import NamedTuple

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


class View(NamedTuple):
    """A cloud as a ``JointHead`` sees it, to be scored under any pose.

    Attributes:
        coefficients: G, (B,Σ(2l+1)²,H).
        constant: (B,H), what no pose changes.
        context: (B,H) of the second round, or None.
    """

    coefficients: Tensor
    constant: Tensor
    context: Tensor | None


class SecondRound(nn.Module):
    """Every pose and class scored once more, in the light of the first round's distribution.

    The first round's hidden layer, averaged over the poses as likely as they are found, and the
    classes' probabilities make a vector that is added to the layer under each pose: attention of
    one query, from the pose to the class and back.
    """

    def __init__(self, hidden: int, num_classes: int) -> None:
        super().__init__()
        self.attend = nn.Linear(hidden + num_classes, hidden, bias=False)
        self.norm = nn.BatchNorm1d(hidden)
        self.score = nn.Linear(hidden, num_classes)

    def context(self, active: Tensor, scores: Tensor) -> Tensor:
        """(B,H) from the first round's layer (B,P,H) and scores (B,P,K)."""
        joint = scores.flatten(1).softmax(1).view_as(scores)
        attended = (joint.sum(2)[:, None] @ active)[:, 0]
        return self.attend(torch.cat([attended, joint.sum(1).to(attended.dtype)], dim=1))


class JointHead(nn.Module):
    """Descriptor → unnormalised log-probabilities of (pose, class).

    Args:
        channels, width, lmax: of the descriptor.
        hidden: H.
        poses: how many poses are tried, see ``pose_grid``.
        rounds: 2 for a ``SecondRound``, else 1.
    """

    def __init__(
        self, channels: int, width: int, lmax: int, hidden: int, num_classes: int, poses: int,
        rounds: int = 1,
    ) -> None:  # fmt: skip
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
        self.second = SecondRound(hidden, num_classes) if rounds == 2 else None
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

    def forward(self, x: Descriptor) -> Tensor:
        """Scores (B,P,K) under the poses of ``pose_grid``."""
        return self.look(x)[0]

    def look(self, x: Descriptor) -> tuple[Tensor, View]:
        """Scores (B,P,K) under the poses of ``pose_grid``, and what scores under others need."""
        view = View(self.coefficients(x), self.invariant(invariants(x)), None)
        h = self.layer(view, self.entries)
        active = _active(self.norm, h)
        scores = self.score(active)
        if self.second is None:
            return scores, view
        view = view._replace(context=self.second.context(active, scores))
        return scores + self._again(view, h), view

    def layer(self, view: View, entries: Tensor) -> Tensor:
        """The hidden layer (B,P,H) under poses by their Wigner entries, (P,E) or (B,P,E)."""
        G = view.coefficients
        return entries.to(G.dtype) @ G + view.constant[:, None]

    def scores(self, view: View, entries: Tensor) -> Tensor:
        """Scores (B,P,K) under poses by their Wigner entries."""
        h = self.layer(view, entries)
        scores = self.score(_active(self.norm, h))
        return scores if self.second is None else scores + self._again(view, h)

    def _again(self, view: View, h: Tensor) -> Tensor:
        assert self.second is not None
        assert view.context is not None
        return self.second.score(_active(self.second.norm, h + view.context[:, None]))

    def slopes(self, view: View, entries: Tensor) -> Tensor:
        """d log Σ_k e^score / d h, (B,P,H), of a head in evaluation mode.

        Written out, for there are no gradients to be had in inference mode.
        """
        h = self.layer(view, entries)
        classes = self.scores(view, entries).softmax(-1)
        slopes = _slope(self.norm, self.score, h, classes)
        if self.second is not None:
            assert view.context is not None
            moved = h + view.context[:, None]
            slopes = slopes + _slope(self.second.norm, self.second.score, moved, classes)
        return slopes


def _active(norm: nn.BatchNorm1d, h: Tensor) -> Tensor:
    return F.relu(norm(h.flatten(0, 1)).view_as(h))


def _slope(norm: nn.BatchNorm1d, score: nn.Linear, h: Tensor, classes: Tensor) -> Tensor:
    """d Σ_k p_k·score_k / d h at fixed p."""
    assert norm.running_var is not None
    gain = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
    return (classes @ score.weight) * (_active(norm, h) > 0) * gain


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
