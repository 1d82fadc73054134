"""VN-DGCNN: DGCNN on vectors that turn with the cloud, read in a frame that turns with them.

Source: Deng et al., Vector Neurons, ICCV 2021; FlyingGiraffe/vnn@f3197e2.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from baselines.points import normalise
from baselines.published import tensors
from baselines.vector_neurons import (
    Edges,
    VectorEdgeConv,
    VectorFrame,
    VectorReLU,
    as_vectors,
    in_frame,
    position_edges,
    vector_knn,
)
from partialbench import given
from partialbench.benchmark.prediction import Prediction

SLOPE = 0.2
"""Of every LeakyReLU."""


class VNDGCNN(nn.Module):
    """Edge convolutions of 21, 21, 42, 85 vectors, their outputs joined, 341 vectors a point and
    their mean, read in a frame of its own; maximum and mean over points, 512-256-K.

    Args:
        k: neighbours, the point itself included.
    """

    def __init__(self, num_classes: int, k: int = 20) -> None:
        super().__init__()
        self.k = given.whole_number(k, "k", least=1)
        self.convs = nn.ModuleList(
            VectorEdgeConv(a, b, SLOPE) for a, b in ((1, 21), (21, 21), (21, 42), (42, 85))
        )
        self.embed = VectorReLU(169, 341, SLOPE, shared=True)
        self.frame = VectorFrame(682, SLOPE)
        self.head = nn.Sequential(
            nn.Linear(4092, 512),
            nn.BatchNorm1d(512),
            nn.LeakyReLU(SLOPE, inplace=True),
            nn.Dropout(0.5),
            nn.Linear(512, 256),
            nn.BatchNorm1d(256),
            nn.LeakyReLU(SLOPE, inplace=True),
            nn.Dropout(0.5),
            nn.Linear(256, num_classes),
        )

    def forward(self, points: Tensor) -> Prediction:
        """(B,N,3) clouds in the camera frame, N ≥ k → logits (B,K)."""
        # Rounding chooses neighbours among features: in evaluation these are of double precision.
        points = normalise(points, radius=1.0, dtype=None if self.training else torch.float64)
        v = as_vectors(points)
        edges = position_edges(points, vector_knn(v, self.k))
        features: list[Tensor] = []
        for conv in self.convs:
            v = conv(v, edges if not features else Edges(vector_knn(v, self.k)))
            features.append(v)
        v = self.embed(torch.cat(features, dim=-1).to(self.embed.linear.weight.dtype))
        mean = v.mean(dim=2, keepdim=True)
        frame = self.frame(v, mean)
        x = torch.cat([in_frame(v, frame), in_frame(mean, frame)], dim=-1)
        return Prediction(self.head(torch.cat([x.amax(dim=1), x.mean(dim=1)], dim=-1)))


def vector_layer(theirs: str, ours: str) -> dict[str, str]:
    """The names of a published vector ReLU's parts and ours."""
    parts = {"map_to_feat": "linear", "batchnorm.bn": "norm", "map_to_dir": "direction"}
    return {f"{theirs}.{a}": f"{ours}.{b}" for a, b in parts.items()}


def from_published(state: Mapping[str, Tensor], model: nn.Module) -> dict[str, Tensor]:
    """The release's state dict, of mean pooling over neighbours, → ours."""
    prefixes = vector_layer("conv5", "embed")
    for i in range(4):
        prefixes |= vector_layer(f"conv{i + 1}", f"convs.{i}")
    for i in range(2):
        prefixes |= vector_layer(f"std_feature.vn{i + 1}", f"frame.layers.{i}")
    prefixes["std_feature.vn_lin"] = "frame.last"
    layers = ("linear1", "bn1", None, None, "linear2", "bn2", None, None, "linear3")
    prefixes |= {name: f"head.{i}" for i, name in enumerate(layers) if name}
    return tensors(state, model, prefixes)
