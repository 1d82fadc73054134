"""DGCNN: edge convolutions on graphs rebuilt in feature space at every layer.

Source: Wang et al., Dynamic Graph CNN for Learning on Point Clouds, TOG 2019;
WangYueFt/dgcnn@f765b46, pytorch.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from baselines.edges import edge_moments, neighbour_max
from baselines.maximum import kept_max
from baselines.points import knn, normalise
from baselines.published import tensors
from baselines.shared_mlp import FullPrecision, Normed, NormLinear, activated, autocast, linear
from partialbench import given
from partialbench.benchmark.prediction import Prediction

SLOPE = 0.2
"""Of every LeakyReLU."""


class EdgeConv(Normed):
    """max over j ∈ N(i) of LeakyReLU(BN(W·[x_j − x_i, x_i])), with N(i) the k nearest of x_i.

    With W = [W₁, W₂] the product is W₁·x_j + (W₂ − W₁)·x_i: one product a point (see ``edges``).
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(2 * inputs, outputs, bias=False)

    def forward(self, x: Tensor, k: int) -> Tensor:
        """(B,N,C_in) → (B,N,C_out)."""
        index = knn(x, k)
        neighbour, relative = self.linear.weight.chunk(2, dim=1)
        a = linear(x, neighbour)
        c = linear(x, relative - neighbour)
        moments = edge_moments(a, c, index) if self.norm.training else None
        scale, shift = self.scale_and_shift(moments, index.numel())
        # Scaled first: where the scale is negative the smallest neighbour becomes the largest.
        (scaled,) = autocast(a * scale)
        return F.leaky_relu(neighbour_max(scaled, index) + (c * scale + shift), SLOPE)


class DGCNN(nn.Module):
    """DGCNN's classifier: edge convolutions 64, 64, 128, 256, their outputs joined, 1024 channels a
    point, maximum and mean over points, 512-256-K with dropout 0.5 twice.

    Args:
        k: neighbours, the point itself included.

    Raises:
        InputError: no neighbour.
    """

    def __init__(self, num_classes: int, k: int = 20) -> None:
        super().__init__()
        self.k = given.whole_number(k, "k", least=1)
        self.convs = nn.ModuleList(
            [EdgeConv(3, 64), EdgeConv(64, 64), EdgeConv(64, 128), EdgeConv(128, 256)]
        )
        self.embed = NormLinear(512, 1024, bias=False)
        self.head = FullPrecision(
            nn.Linear(2048, 512, bias=False),
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
        x = normalise(points)
        features = []
        for conv in self.convs:
            x = conv(x, self.k)
            features.append(x)
        x = activated([self.embed], torch.cat(features, dim=-1), SLOPE)
        pooled = torch.cat([kept_max(x), x.mean(dim=1)], dim=-1)
        return Prediction(self.head(pooled))


def from_published(state: Mapping[str, Tensor], model: nn.Module) -> dict[str, Tensor]:
    """WangYueFt's PyTorch state dict → ours.

    Its ``conv1`` … ``conv5`` are (convolution, batch norm, …) sequences whose norms it lists a
    second time as ``bn1`` … ``bn5``; ``linear1``, ``bn6``, ``linear2``, ``bn7``, ``linear3`` make
    the head.
    """
    names = {f"conv{i + 1}": f"convs.{i}" for i in range(4)} | {"conv5": "embed"}
    prefixes = {f"{theirs}.0": f"{ours}.linear" for theirs, ours in names.items()}
    prefixes |= {f"{theirs}.1": f"{ours}.norm" for theirs, ours in names.items()}
    layers = ("linear1", "bn6", None, None, "linear2", "bn7", None, None, "linear3")
    prefixes |= {name: f"head.{i}" for i, name in enumerate(layers) if name}
    ignored = tuple(f"bn{i}." for i in range(1, 6))
    return tensors(state, model, prefixes, ignored=ignored)
