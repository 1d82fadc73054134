"""PaRI-Conv: convolutions whose kernel is made from how two points' frames stand to each other.

Source: Chen & Cong, The Devil is in the Pose: Ambiguity-free 3D Rotation-invariant Learning via
Pose-aware Convolution, CVPR 2022. Its repository has no licence, so this is written from the paper
and from what ``local_to_global``'s source, which took its layers over, does; what the paper leaves
open is the card's choice. Geometry, and in evaluation whatever chooses neighbours, is computed in
double precision: where rounding chose, a turned cloud would get another answer.
"""

from __future__ import annotations

from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from baselines.joined import JoinedMax
from baselines.local_to_global import (
    MEAN_NEIGHBOURS,
    SLOPE,
    in_double,
    neighbourhoods,
    normed,
    oriented_axes,
    pairs,
    point_features,
    pose_features,
)
from baselines.lra import unit
from baselines.points import gather, knn
from baselines.shared_mlp import NormLinear
from partialbench import given
from partialbench.benchmark.prediction import Prediction
from partialbench.errors import InputError

WIDTHS = (64, 64, 128, 256)
"""Channels a point after each layer."""
POSE = 8
"""Numbers of ``pose_features``."""


class PoseAwareConv(nn.Module):
    """h_ij = ReLU(BN(K(pose_ij) ⊙ W·f_j)), an edge layer on [h_ij − f_i, f_i] and the maximum.

    K is a small network, so that the kernel of an edge is a product of one basis W and of as many
    factors as channels, not a matrix an edge.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.hidden = NormLinear(POSE, inputs // 4)
        self.kernel = nn.Linear(inputs // 4, inputs)
        self.basis = nn.Linear(inputs, inputs, bias=False)
        self.norm = nn.BatchNorm1d(inputs)
        self.edge = JoinedMax(inputs, inputs, outputs, bias=False)

    def forward(self, f: Tensor, near: Tensor, pose: Tensor) -> Tensor:
        """(B,N,C), (B,N,k) and rows (B·N·k,8) of the edges → (B,N,C')."""
        kernel = self.kernel(F.relu_(self.hidden(pose)))
        basis = gather(self.basis(f), near).flatten(0, 2)
        h = F.relu_(self.norm(kernel * basis)).unflatten(0, near.shape)
        return F.leaky_relu(self.edge.about_centres(h, f), SLOPE)


class Layers(nn.Module):
    """The layers before the descriptor; neighbours of all but the first are near in features."""

    def __init__(self, k: int) -> None:
        super().__init__()
        self.k = k
        self.first = NormLinear(POSE + 6, WIDTHS[0], bias=False)
        self.convs = nn.ModuleList(PoseAwareConv(*widths) for widths in pairwise(WIDTHS))

    def forward(self, x: Tensor, axes: Tensor, mean: Tensor, near: Tensor, f: Tensor) -> Tensor:
        """Geometry in float64 and the points' numbers (B,N,3) → all layers' features (B,N,512)."""
        dtype = self.first.linear.weight.dtype
        f = f.to(dtype)
        edges = torch.cat([self.pose(x, axes, mean, near).to(dtype), pairs(f, near)], dim=-1)
        f = F.leaky_relu(self.first.max(edges.unflatten(0, near.shape)), SLOPE)
        features = [f]
        for conv in self.convs:
            near = knn(f.detach().double(), self.k + 1)[..., 1:]
            f = conv(f, near, self.pose(x, axes, mean, near).to(dtype))
            features.append(f)
        return torch.cat(features, dim=-1)

    @staticmethod
    @torch.no_grad()
    def pose(x: Tensor, axes: Tensor, mean: Tensor, near: Tensor) -> Tensor:
        """Rows (B·N·k,8)."""
        return pose_features(x, axes, mean, near).flatten(0, 2)


class PaRIConv(nn.Module):
    """DGCNN's shape with pose-aware layers: 64, 64, 128, 256, joined, 1024, 512-256-K.

    Args:
        k: neighbours, the point itself not included.
        orient: "centroid": local axes point away from it; "camera": towards the camera.

    Raises:
        InputError: no neighbour, or an orientation that is not known.
    """

    def __init__(self, num_classes: int, k: int = 20, orient: str = "centroid") -> None:
        super().__init__()
        if orient not in ("centroid", "camera"):
            raise InputError(f"orient must be centroid or camera, got {orient!r}")
        self.k, self.orient = given.whole_number(k, "k", least=1), orient
        self.layers = Layers(self.k)
        self.embed = normed(sum(WIDTHS), 1024)
        self.head = nn.Sequential(
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

    @torch.no_grad()
    def geometry(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Of clouds (B,N,3) in the camera frame, in float64: normalised points, their axes, the
        directions to their neighbours' means, the k nearest others, and of every point its distance
        from the centroid and the cosine and sine of its axis against the direction to it.
        """
        x, near, relative = neighbourhoods(points, self.k)
        axes = oriented_axes(points, x, relative, self.orient)
        mean = unit(relative[:, :, :MEAN_NEIGHBOURS].mean(dim=2))
        return x, axes, mean, near[..., 1 : self.k + 1], point_features(x, axes)

    def forward(self, points: Tensor) -> Prediction:
        """(B,N,3) clouds in the camera frame, N > k → logits (B,K)."""
        # Autocast would mix eight bits into what evaluation does in double.
        autocast = torch.is_autocast_enabled(points.device.type) and self.training
        with torch.autocast(points.device.type, enabled=autocast):
            layers = self.layers if self.training else in_double(self.layers)
            features = layers(*self.geometry(points))
        features = features.to(self.embed[0].weight.dtype)
        x = F.leaky_relu(self.embed(features.flatten(0, 1)), SLOPE).unflatten(0, points.shape[:2])
        return Prediction(self.head(torch.cat([x.amax(dim=1), x.mean(dim=1)], dim=-1)))
