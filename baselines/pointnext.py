"""PointNeXt-S: PointNet++ with four levels, coordinates in units of the radius, and skips.

Source: Qian et al., PointNeXt, NeurIPS 2022; guochengqian/PointNeXt@02341db, openpoints@8c115a9.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from baselines.anchors import QUIRKS as SAMPLING_QUIRKS
from baselines.anchors import anchors
from baselines.balls import without_padding
from baselines.pointnet2 import GroupLinear
from baselines.points import as_weights, ball_query, gather, normalise
from baselines.published import chosen_quirks, tensors
from baselines.shared_mlp import NormLinear, SharedMLP
from partialbench.benchmark.prediction import Prediction

RADIUS, GROWTH, COUNT = 0.15, 1.5, 32
QUIRKS = {
    "start": SAMPLING_QUIRKS["start"],
    "order": "balls keep their first points in index order",
}
"""What the release does that the row does not."""


class SetAbstraction(nn.Module):
    """ReLU(max over a ball of BN(W₂·ReLU(BN(W₁·[(x_j − x_i)/r, f_j]))) + W₃·f_i + b).

    Args:
        inputs, outputs: channels; half of the outputs between.
        radius: of the balls.
        nearest: see ``points.ball_query``.
    """

    def __init__(self, inputs: int, outputs: int, radius: float, nearest: bool) -> None:
        super().__init__()
        self.radius, self.nearest = radius, nearest
        self.first = GroupLinear(inputs, outputs // 2, bias=False)
        self.second = NormLinear(outputs // 2, outputs, bias=False)
        self.skip = nn.Linear(inputs, outputs)

    def forward(self, xyz: Tensor, f: Tensor, centres: Tensor, own: Tensor) -> Tensor:
        """Points (B,N,3) and their features (B,N,C), centres (B,S,3) and theirs → (B,S,C_out)."""
        index = ball_query(centres, xyz, self.radius, COUNT, self.nearest)
        balls = without_padding(index, xyz.shape[1])
        x = self.first(xyz / self.radius, f, centres / self.radius, balls)
        x = self.second.max_in_balls(x, balls).unflatten(0, centres.shape[:2])
        return F.relu(x + self.skip(own))


class PointNeXt(nn.Module):
    """PointNeXt-S: 32 channels a point; set abstractions of 64, 128, 256, 512 channels, each on
    half of the points; coordinates and features of the last 512-512, maximum, 512-256-K.

    Args:
        quirks: what of ``QUIRKS`` to do as published, joined by "+".
    """

    def __init__(self, num_classes: int, quirks: str = "") -> None:
        super().__init__()
        self.quirks = chosen_quirks(quirks, QUIRKS)
        self.embed = nn.Linear(3, 32)
        widths = (32, 64, 128, 256, 512)
        self.levels = nn.ModuleList(
            SetAbstraction(a, b, RADIUS * GROWTH**i, "order" not in self.quirks)
            for i, (a, b) in enumerate(pairwise(widths))
        )
        self.last = SharedMLP(515, 512, 512, bias=False)
        self.head = nn.Sequential(
            nn.Linear(512, 512, bias=False),
            nn.BatchNorm1d(512),
            nn.ReLU(inplace=True),
            nn.Dropout(0.5),
            nn.Linear(512, 256, bias=False),
            nn.BatchNorm1d(256),
            nn.ReLU(inplace=True),
            nn.Dropout(0.5),
            nn.Linear(256, num_classes),
        )

    def forward(self, points: Tensor) -> Prediction:
        """(B,N,3) clouds in the camera frame → logits (B,K)."""
        points = as_weights(normalise(points, radius=1.0), self)
        x = self.embed(points)
        counts = [max(1, points.shape[1] >> i) for i in range(1, 1 + len(self.levels))]
        chosen = anchors(points, counts[0], self.quirks)
        centres, own = gather(points, chosen), gather(x, chosen)
        for level, count in zip(self.levels, counts, strict=True):
            # The first of the anchors are the anchors of the anchors.
            centres, own = centres[:, :count], own[:, :count]
            x = own = level(points, x, centres, own)
            points = centres
        return Prediction(self.head(self.last.max(torch.cat([points.to(x.dtype), x], dim=-1))))


def from_published(state: Mapping[str, Tensor], model: nn.Module) -> dict[str, Tensor]:
    """The release's state dict of a classifier of three input channels → ours."""
    prefixes = {"encoder.encoder.0.0.convs.0.0": "embed"}
    for i in range(4):
        theirs, ours = f"encoder.encoder.{i + 1}.0", f"levels.{i}"
        prefixes[f"{theirs}.skipconv.0"] = f"{ours}.skip"
        for j, layer in enumerate(("first", "second")):
            prefixes[f"{theirs}.convs.{j}.0"] = f"{ours}.{layer}.linear"
            prefixes[f"{theirs}.convs.{j}.1"] = f"{ours}.{layer}.norm"
    for j in range(2):
        prefixes[f"encoder.encoder.5.0.convs.{j}.0"] = f"last.{j}.linear"
        prefixes[f"encoder.encoder.5.0.convs.{j}.1"] = f"last.{j}.norm"
        prefixes[f"prediction.head.{2 * j}.0"] = f"head.{4 * j}"
        prefixes[f"prediction.head.{2 * j}.1"] = f"head.{4 * j + 1}"
    prefixes["prediction.head.4.0"] = "head.8"
    return tensors(state, model, prefixes)
