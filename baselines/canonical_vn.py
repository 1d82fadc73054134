"""A cloud in a frame that a small equivariant network learns to give it.

Source: Mondal et al., Equivariant Adaptation of Large Pretrained Models, NeurIPS 2023, after Kaba
et al., ICML 2023; arnab39/equiadapt@657ee6f.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from baselines.canonical import Backbone
from baselines.points import normalise
from baselines.processes import world_size
from baselines.published import chosen_quirks, tensors
from baselines.released_backbones import PlainPointNet
from baselines.vector_neurons import (
    EPS,
    VectorBatchNorm,
    VectorEdgeConv,
    VectorReLU,
    as_vectors,
    position_edges,
    vector_knn,
)
from baselines.vn_dgcnn import vector_layer
from partialbench import given
from partialbench.benchmark.prediction import Prediction
from partialbench.errors import InputError

FADE = 0.3
"""ε of the frame's layers, see ``vector_neurons.EPS``: clouds are of radius 1. The vectors of a
cloud are means that nearly cancel, so that one point's false direction turns its frame."""
QUIRKS = {
    "mirror": "a third vector gives the frame's last axis, so that half of the clouds are mirrored",
    "epsilon": "a vector of any length has a direction, also where rounding gives it",
    "dropout": "half of the vectors' components are dropped in training",
}
"""What the release does that the row does not."""


def frame_of(vectors: Tensor, mirror: bool = False) -> Tensor:
    """Orthonormal rows (B,3,3) of vectors (B,≥2,3), by Gram and Schmidt.

    The third is across the first two, so that the frame is right-handed; with ``mirror`` it is the
    rest of a third vector, and the frame as often left-handed. Of zero vectors it is zero.
    """
    first = F.normalize(vectors[:, 0], dim=-1)
    second = vectors[:, 1]
    second = F.normalize(second - (second * first).sum(-1, keepdim=True) * first, dim=-1)
    third = torch.linalg.cross(first, second, dim=-1)
    if mirror:
        given = vectors[:, 2]
        third = F.normalize((given * third).sum(-1, keepdim=True) * third, dim=-1)
    return torch.stack([first, second, third], dim=1)


class FrameNet(nn.Module):
    """Four vectors of a cloud, that turn with it: vector neurons, an edge convolution of 21, then
    21 and 4 a point, their mean.

    Args:
        k: neighbours, the point itself included.
        dropout: share of the vectors' components dropped in training.
        eps: see ``vector_neurons.EPS``.
    """

    def __init__(self, k: int, dropout: float, eps: float) -> None:
        super().__init__()
        self.k = given.whole_number(k, "k", least=1)
        self.edge = VectorEdgeConv(1, 21, 0.0, cross=True, eps=eps)
        self.first = VectorReLU(21, 21, 0.0, eps=eps)
        self.norm = VectorBatchNorm(21, eps)
        self.second = VectorReLU(21, 4, 0.0, eps=eps)
        self.dropout = nn.Dropout(dropout)

    def forward(self, points: Tensor) -> Tensor:
        """(B,N,3) centred, N ≥ k → (B,4,3)."""
        v = as_vectors(points)
        v = self.edge(v, position_edges(points, vector_knn(v, self.k), cross=True))
        v = self.dropout(self.second(self.norm(self.first(v))))
        return v.mean(dim=2).permute(1, 2, 0)


class CanonicalVN(nn.Module):
    """A classifier on clouds in a learned frame: what turns with the cloud leaves no rotation.

    Args:
        backbone: a registered model's name, a user's "module:factory", or "released", the PointNet
            behind the published frame.
        backbone_options: of its factory.
        k: neighbours of the frame's edge convolution.
        prior: weight of the mean squared difference of the frame from the identity, 100 as
            published. It wants training clouds near one pose. Of clouds turned at random its mean
            is 2/3 whatever the frame, and its gradient noise.
        quirks: what of ``QUIRKS`` to do as published, joined by "+".

    Raises:
        InputError: a negative prior, no neighbour, an unknown quirk or backbone.
    """

    def __init__(
        self,
        num_classes: int,
        backbone: str = "pointnet2-ssg",
        backbone_options: dict[str, Any] | None = None,
        k: int = 20,
        prior: float = 0.0,
        quirks: str = "",
    ) -> None:
        super().__init__()
        if prior < 0:
            raise InputError(f"prior must be 0 or more, got {prior}")
        self.quirks, self.prior = chosen_quirks(quirks, QUIRKS), prior
        eps = EPS if "epsilon" in self.quirks else FADE
        self.frame = FrameNet(k, 0.5 if "dropout" in self.quirks else 0.0, eps)
        self.backbone = Backbone(num_classes, backbone, backbone_options or {}, PlainPointNet)

    def canonical(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Clouds (B,N,3) → the same, centred, in their frames, and these (B,3,3), whose rows are
        the axes."""
        with torch.autocast(points.device.type, enabled=False):
            points = normalise(points, radius=1.0)
            # Layers that divide by lengths amplify rounding: in evaluation in double precision.
            exact = points if self.training else points.double()
            frame = frame_of(self.frame(exact), "mirror" in self.quirks)
            return (exact @ frame.mT).to(points.dtype), frame

    def forward(self, points: Tensor) -> Prediction:
        """(B,N,3) clouds in the camera frame, N ≥ k → logits (B,K), and the prior as penalty."""
        canonical, frame = self.canonical(points)
        output = self.backbone(canonical)
        if not self.prior:
            return output
        identity = torch.eye(3, device=frame.device, dtype=frame.dtype)
        # A mean over the batch, of which this process has its share.
        penalty = self.prior * (frame - identity).square().mean() / world_size()
        if output.penalty is not None:
            penalty = penalty + output.penalty
        return output._replace(penalty=penalty)


def from_published(state: Mapping[str, Tensor], model: nn.Module) -> dict[str, Tensor]:
    """The release's state dict with its PointNet → ours with ``backbone=released``."""
    net = "canonicalizer.canonicalization_network"
    prefixes = {f"{net}.bn1.bn": "frame.norm.norm"}
    for theirs, ours in (("conv_pos", "edge"), ("conv1", "first"), ("conv2", "second")):
        prefixes |= vector_layer(f"{net}.{theirs}", f"frame.{ours}")
    # The release names a batch norm after its dimensions.
    for theirs in tuple(prefixes):
        if theirs.endswith("bn"):
            prefixes |= {f"{theirs}{d}d": prefixes[theirs] for d in (1, 2)}
    for i in range(5):
        prefixes[f"prediction_network.conv{i + 1}"] = f"backbone.network.mlp.{i}.linear"
        prefixes[f"prediction_network.bn{i + 1}"] = f"backbone.network.mlp.{i}.norm"
    for name, i in (("linear1", 0), ("bn6", 1), ("linear2", 4)):
        prefixes[f"prediction_network.{name}"] = f"backbone.network.head.{i}"
    return tensors(state, model, prefixes)
