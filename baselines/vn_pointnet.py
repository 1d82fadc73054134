"""VN-PointNet: PointNet on vectors that turn with the cloud, read in a frame that turns with them.

Source: Deng et al., Vector Neurons, ICCV 2021; FlyingGiraffe/vnn@f3197e2.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from baselines.points import normalise
from baselines.published import tensors
from baselines.vector_neurons import (
    VectorBatchNorm,
    VectorEdgeConv,
    VectorFrame,
    VectorLinear,
    VectorReLU,
    as_vectors,
    in_frame,
    position_edges,
    vector_knn,
)
from baselines.vn_dgcnn import vector_layer
from partialbench import given
from partialbench.benchmark.prediction import Prediction


class VectorTNet(nn.Module):
    """PointNet's T-Net of vectors: (3,B,N,21) → 21 vectors of the whole cloud (3,B,1,21)."""

    def __init__(self) -> None:
        super().__init__()
        self.points = nn.ModuleList(
            VectorReLU(a, b, 0.0) for a, b in ((21, 21), (21, 42), (42, 341))
        )
        self.cloud = nn.ModuleList(VectorReLU(a, b, 0.0) for a, b in ((341, 170), (170, 85)))
        self.last = VectorLinear(85, 21)

    def forward(self, v: Tensor) -> Tensor:
        for layer in self.points:
            v = layer(v)
        v = v.mean(dim=2)
        for layer in self.cloud:
            v = layer(v)
        return self.last(v)[:, :, None]


class VNPointNet(nn.Module):
    """One edge convolution, then PointNet's layers on 21, 42 and 341 vectors a point; their mean is
    joined to them, read in a frame of its own; maximum over points, 512-256-K.

    Args:
        k: neighbours of the edge convolution, the point itself included.
    """

    def __init__(self, num_classes: int, k: int = 20) -> None:
        super().__init__()
        self.k = given.whole_number(k, "k", least=1)
        self.edge = VectorEdgeConv(1, 21, 0.0, cross=True)
        self.first = VectorReLU(21, 21, 0.0)
        self.tnet = VectorTNet()
        self.second = VectorReLU(42, 42, 0.0)
        self.third = VectorLinear(42, 341)
        self.norm = VectorBatchNorm(341)
        self.frame = VectorFrame(682, 0.0)
        self.head = nn.Sequential(
            nn.Linear(2046, 512),
            nn.BatchNorm1d(512),
            nn.ReLU(inplace=True),
            nn.Linear(512, 256),
            nn.Dropout(0.4),
            nn.BatchNorm1d(256),
            nn.ReLU(inplace=True),
            nn.Linear(256, num_classes),
        )

    def forward(self, points: Tensor) -> Prediction:
        """(B,N,3) clouds in the camera frame, N ≥ k → logits (B,K)."""
        # Each layer divides by lengths and so amplifies rounding: in evaluation the first ones are
        # of double precision, or a turned cloud's logits would differ by more than 1e-4.
        points = normalise(points, radius=1.0, dtype=None if self.training else torch.float64)
        v = as_vectors(points)
        v = self.edge(v, position_edges(points, vector_knn(v, self.k), cross=True))
        v = self.first(v)
        v = self.second(v, self.tnet(v))
        v = self.norm(self.third(v)).to(self.third.weight.dtype)
        mean = v.mean(dim=2, keepdim=True)
        frame = self.frame(v, mean)
        pooled = [in_frame(part, frame).amax(dim=1) for part in (v, mean)]
        return Prediction(self.head(torch.cat(pooled, dim=-1)))


def from_published(state: Mapping[str, Tensor], model: nn.Module) -> dict[str, Tensor]:
    """The release's state dict, of mean pooling over neighbours, → ours."""
    prefixes = {
        "feat.conv3.map_to_feat": "third",
        "feat.bn3.bn": "norm.norm",
        "feat.std_feature.vn_lin": "frame.last",
        "feat.fstn.fc3.map_to_feat": "tnet.last",
        "fc1": "head.0",
        "bn1": "head.1",
        "fc2": "head.3",
        "bn2": "head.5",
        "fc3": "head.7",
    }
    layers = {"conv_pos": "edge", "conv1": "first", "conv2": "second"}
    layers |= {f"std_feature.vn{i + 1}": f"frame.layers.{i}" for i in range(2)}
    layers |= {f"fstn.conv{i + 1}": f"tnet.points.{i}" for i in range(3)}
    layers |= {f"fstn.fc{i + 1}": f"tnet.cloud.{i}" for i in range(2)}
    for theirs, ours in layers.items():
        prefixes |= vector_layer(f"feat.{theirs}", ours)
    return tensors(state, model, prefixes)
