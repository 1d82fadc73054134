"""The networks that publications of canonical frames have behind them, to read their weights.

Unlike the registered models they take clouds as they come, neither centred nor scaled. Sources:
feiran-l/rotation-invariant-pointcloud-analysis@205b6e9; arnab39/equiadapt@657ee6f.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from baselines.dense_edges import EdgeLayer
from baselines.dgcnn import SLOPE, EdgeConv
from baselines.points import full_precision, knn
from baselines.shared_mlp import NormLinear, activated
from partialbench.benchmark.prediction import Prediction


def leaky_head(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """inputs-512-hidden-outputs with batch norm, LeakyReLU and dropout 0.5."""
    return nn.Sequential(
        nn.Linear(inputs, 512, bias=False),
        nn.BatchNorm1d(512),
        nn.LeakyReLU(SLOPE, inplace=True),
        nn.Dropout(0.5),
        nn.Linear(512, hidden),
        nn.BatchNorm1d(hidden),
        nn.LeakyReLU(SLOPE, inplace=True),
        nn.Dropout(0.5),
        nn.Linear(hidden, outputs),
    )


class EdgeTNet(nn.Module):
    """A 3×3 matrix of a cloud: 64-128 an edge, maximum, 1024 a point, maximum, 512-256-9."""

    def __init__(self) -> None:
        super().__init__()
        self.edge = EdgeLayer(3, 64, SLOPE)
        self.wide = NormLinear(64, 128, bias=False)
        self.point = NormLinear(128, 1024, bias=False)
        self.cloud = nn.Sequential(
            nn.Linear(1024, 512, bias=False),
            nn.BatchNorm1d(512),
            nn.LeakyReLU(SLOPE, inplace=True),
            nn.Linear(512, 256, bias=False),
            nn.BatchNorm1d(256),
            nn.LeakyReLU(SLOPE, inplace=True),
        )
        self.last = nn.Linear(256, 9)
        nn.init.zeros_(self.last.weight)
        with torch.no_grad():
            self.last.bias.copy_(torch.eye(3).flatten())

    def forward(self, points: Tensor, index: Tensor) -> Tensor:
        """(B,N,3), neighbours (B,N,k) → (B,3,3)."""
        x = F.leaky_relu(self.wide.max(self.edge(points, points, index)), SLOPE)
        x = F.leaky_relu(self.point.max(x), SLOPE)
        return self.last(self.cloud(x)).view(-1, 3, 3)


class TNetDGCNN(nn.Module):
    """DGCNN with 25 neighbours on clouds multiplied by a T-Net's matrix, 512 channels in its head
    twice."""

    K = 25

    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.tnet = EdgeTNet()
        self.convs = nn.ModuleList(
            [EdgeConv(3, 64), EdgeConv(64, 64), EdgeConv(64, 128), EdgeConv(128, 256)]
        )
        self.embed = NormLinear(512, 1024, bias=False)
        self.head = leaky_head(2048, 512, num_classes)

    def forward(self, points: Tensor) -> Prediction:
        """(B,N,3), N ≥ 25 → logits (B,K)."""
        with torch.autocast(points.device.type, enabled=False):
            points = full_precision(points)
            x = points @ self.tnet(points, knn(points, self.K))
        features = []
        for conv in self.convs:
            x = conv(x, self.K)
            features.append(x)
        x = activated([self.embed], torch.cat(features, dim=-1), SLOPE)
        return Prediction(self.head(torch.cat([x.amax(dim=1), x.mean(dim=1)], dim=-1)))


class PlainPointNet(nn.Module):
    """PointNet without T-Nets: 64-64-64-128-1024 a point, maximum, 512-K."""

    def __init__(self, num_classes: int) -> None:
        super().__init__()
        widths = (3, 64, 64, 64, 128, 1024)
        self.mlp = nn.ModuleList(
            NormLinear(widths[i], widths[i + 1], bias=False) for i in range(len(widths) - 1)
        )
        self.head = nn.Sequential(
            nn.Linear(1024, 512, bias=False),
            nn.BatchNorm1d(512),
            nn.ReLU(inplace=True),
            nn.Dropout(0.5),
            nn.Linear(512, num_classes),
        )

    def forward(self, points: Tensor) -> Prediction:
        """(B,N,3) → logits (B,K)."""
        *inner, last = self.mlp
        assert isinstance(last, NormLinear)
        x = F.relu(last.max(activated(inner, points)))
        return Prediction(self.head(x))
