"""Local-to-global fusion: what a neighbourhood looks like, and where it is in the cloud's own axes.

Source: Zhao et al., Rotation Invariant Point Cloud Analysis: Where Local Geometry Meets Global
Topology; CentauriStar/Rotation-Invariant-Point-Cloud-Analysis@a1b3fad. Its local layers are those
of Chen & Cong, The Devil is in the Pose (PaRI-Conv), CVPR 2022. Geometry is computed in double
precision: where rounding chose a neighbour, a turned cloud would get another answer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from baselines.camera import camera_ray
from baselines.joined import JoinedMax
from baselines.lra import dot, facing, local_axes, unit
from baselines.points import distances, farthest_points, gather, knn, normalise
from baselines.published import chosen_quirks, tensors
from baselines.shared_mlp import NormLinear
from partialbench.benchmark.prediction import Prediction
from partialbench.errors import InputError

SLOPE = 0.2
"""Of every LeakyReLU."""
AXIS_NEIGHBOURS, MEAN_NEIGHBOURS = 32, 48
"""Of a point's axis, and of the mean that its second axis points to; itself included."""
SAMPLED = 32
"""Points whose singular vectors are the cloud's axes."""
QUIRKS = {
    "layout": "the global branch reads each cloud's N×3 numbers as 3×N: other points",
    "neighbours": "the j-th nearest in the cloud's axes stands beside the j-th in the layer's space",
    "signs": "axes have the sign that LAPACK leaves",
    "dropout": "0.8, which a truncated option of the training script sets, in place of 0.5",
}
"""What the release does that the row does not."""


@dataclass(frozen=True)
class Geometry:
    """What no layer changes; no gradient.

    Attributes:
        points: (B,N,3) float64, in the unit ball.
        axes: (B,N,3) local reference axes.
        normals: (B,N,3) normals, or the axes again.
        mean: (B,N,3) direction to the mean of the neighbours.
        near: (B,N,k) nearest others.
        features: (B,N,3) of points: distance from the centroid, cosine and sine of the axis to it.
    """

    points: Tensor
    axes: Tensor
    normals: Tensor
    mean: Tensor
    near: Tensor
    features: Tensor


def pose_features(points: Tensor, axis: Tensor, mean: Tensor, index: Tensor) -> Tensor:
    """How two points' frames stand to their edge and to each other: (B,N,k,8).

    With e = x_j − x_i: cosine and sine of the angle about point i's axis from its ``mean`` to e; of
    that about point j's axis to −e; |e|, cos ∠(axis_i, e), cos ∠(axis_j, e), cos ∠(axis_i, axis_j).

    Args:
        points, axis, mean: (B,N,3), the last two of length 1.
        index: (B,N,k) neighbours.
    """
    # The axis, the part of the mean across it and the third direction: angles are then read off.
    along = mean - dot(mean, axis)[..., None] * axis
    third = torch.linalg.cross(axis, mean, dim=-1)
    frame = torch.cat([axis, along, third], dim=-1).unflatten(-1, (3, 3))
    other = gather(torch.cat([points, frame.flatten(-2)], dim=-1), index)
    edge = other[..., :3] - points[:, :, None]
    length = torch.linalg.vector_norm(edge, dim=-1)
    e = edge / length.masked_fill(length == 0, 1)[..., None]
    mine = e @ frame.mT
    theirs = (other[..., 3:].unflatten(-1, (3, 3)) @ e[..., None])[..., 0]
    between = dot(axis[:, :, None], other[..., 3:6])
    beta_i = torch.atan2(-mine[..., 2], mine[..., 1])
    beta_j = torch.atan2(theirs[..., 2], -theirs[..., 1])
    angles = [beta_i.cos(), beta_i.sin(), beta_j.cos(), beta_j.sin()]
    return torch.stack([*angles, length, mine[..., 0], theirs[..., 0], between], dim=-1)


def normed(inputs: int, outputs: int, bias: bool = False) -> nn.Sequential:
    """A linear layer and batch norm over rows, computed one after the other.

    For layers with many inputs and few outputs that is quicker than ``NormLinear``.
    """
    return nn.Sequential(nn.Linear(inputs, outputs, bias=bias), nn.BatchNorm1d(outputs))


class Gate(nn.Module):
    """x·σ(W'·LeakyReLU(BN(W·x))), (R,C) → (R,C)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.squeeze = normed(channels, channels // 2)
        self.spread = nn.Linear(channels // 2, channels, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        inner = F.leaky_relu_(self.squeeze(x), SLOPE)
        return x * torch.sigmoid(self.spread(inner))


class PoseConv(nn.Module):
    """A layer whose kernel depends on how two points stand to each other, and on where they are.

    Args:
        inputs, outputs: channels of a point.
        place: channels of an edge of the global branch.
    """

    def __init__(self, inputs: int, outputs: int, place: int) -> None:
        super().__init__()
        self.kernel = nn.Sequential(
            *normed(8, inputs // 4, bias=True),
            nn.ReLU(inplace=True),
            nn.Linear(inputs // 4, inputs - place),
        )
        self.gate = Gate(inputs)
        self.basis = nn.Linear(inputs, inputs, bias=False)
        self.norm = nn.BatchNorm1d(inputs)
        self.edge = JoinedMax(inputs, inputs, outputs, bias=False)

    def forward(self, f: Tensor, index: Tensor, pose: Tensor, place: Tensor) -> Tensor:
        """(B,N,C), (B,N,k), rows (R,8) and (R,C') of the edges → (B,N,C_out)."""
        kernel = self.gate(torch.cat([self.kernel(pose), place], dim=-1))
        basis = gather(self.basis(f), index).flatten(0, 2)
        h = F.relu_(self.norm(kernel * basis)).unflatten(0, index.shape)
        return F.leaky_relu(self.edge.about_centres(h, f), SLOPE)


class Attention(nn.Module):
    """x + α·(what each point takes from all), on the points' coordinates in the cloud's axes."""

    def __init__(self) -> None:
        super().__init__()
        self.alpha = nn.Parameter(torch.zeros(1))
        self.embed = nn.Sequential(
            *normed(3, 64), nn.ReLU(inplace=True), nn.Linear(64, 128, bias=False)
        )
        self.query, self.key, self.value = normed(128, 16), normed(128, 16), normed(128, 3)

    def forward(self, x: Tensor) -> Tensor:
        """(B,N,3) → (B,N,3)."""
        rows = self.embed(x.flatten(0, 1))
        q, k, v = (
            F.relu(layer(rows)).unflatten(0, x.shape[:2])
            for layer in (self.query, self.key, self.value)
        )
        return x + self.alpha * F.scaled_dot_product_attention(k, q, v, scale=1.0)


class LocalToGlobal(nn.Module):
    """A first layer and three whose neighbours are near in features, 64, 64, 128, 256, their
    outputs joined, 1024 channels a point, maximum and mean over points, 512-256-K.

    Args:
        k: neighbours, the point itself not included.
        orient: "centroid": local axes point away from it; "camera": towards the camera.
        quirks: names of ``QUIRKS`` joined by "+": what to do as the release does.

    Raises:
        InputError: an option that is not known.
    """

    def __init__(
        self, num_classes: int, k: int = 20, orient: str = "centroid", quirks: str = ""
    ) -> None:
        super().__init__()
        if orient not in ("centroid", "camera"):
            raise InputError(f"orient must be centroid or camera, got {orient!r}")
        self.k, self.orient = k, orient
        self.quirks = chosen_quirks(quirks, QUIRKS)
        self.attention = Attention()
        self.place1 = normed(6, 32)
        self.place2 = normed(32, 64)
        self.gate = Gate(14)
        self.first = normed(20, 64)
        self.convs = nn.ModuleList(
            [PoseConv(64, 64, 32), PoseConv(64, 128, 32), PoseConv(128, 256, 64)]
        )
        self.embed = normed(512, 1024)
        dropout = 0.8 if "dropout" in self.quirks else 0.5
        self.head = nn.Sequential(
            nn.Linear(2048, 512, bias=False),
            nn.BatchNorm1d(512),
            nn.LeakyReLU(SLOPE, inplace=True),
            nn.Dropout(dropout),
            nn.Linear(512, 256),
            nn.BatchNorm1d(256),
            nn.LeakyReLU(SLOPE, inplace=True),
            nn.Dropout(dropout),
            nn.Linear(256, num_classes),
        )

    @torch.no_grad()
    def geometry(self, points: Tensor, normals: Tensor | None = None) -> Geometry:
        """Of clouds (B,N,3) in the camera frame, and their normals (B,N,3)."""
        number = points.shape[1]
        if number <= self.k:
            raise InputError(
                f"{self.k} neighbours need clouds of at least {self.k + 1} points, got {number}"
            )
        x = normalise(points.double(), radius=1.0)
        most = min(max(MEAN_NEIGHBOURS, self.k + 1), number)
        near = distances(x, x).topk(most, dim=-1, largest=False).indices
        relative = gather(x, near) - x[:, :, None]
        if "signs" in self.quirks:
            # In the release's precision: another leaves other signs.
            axes = local_axes(relative[:, :, :AXIS_NEIGHBOURS].float()).double()
        else:
            away = -camera_ray(points)[:, None].double() if self.orient == "camera" else x
            axes = facing(local_axes(relative[:, :, :AXIS_NEIGHBOURS]), away)
        mean = unit(relative[:, :, :MEAN_NEIGHBOURS].mean(dim=2))
        normals = axes if normals is None else unit(normals.double())
        ray = unit(x)
        sine = torch.linalg.vector_norm(torch.linalg.cross(axes, ray, dim=-1), dim=-1)
        distance = torch.linalg.vector_norm(x, dim=-1)
        features = torch.stack([distance, dot(axes, ray), sine], dim=-1)
        return Geometry(x, axes, normals, mean, near[..., 1 : self.k + 1], features)

    @torch.no_grad()
    def in_own_axes(self, x: Tensor) -> Tensor:
        """(B,N,3) normalised clouds → their coordinates along their own axes."""
        if "layout" in self.quirks:
            x = x.reshape(len(x), 3, -1).mT
        centred = x - x.mean(dim=1, keepdim=True)
        start = torch.linalg.vector_norm(centred, dim=-1).argmax(dim=1)
        chosen = gather(x, farthest_points(x, min(SAMPLED, x.shape[1]), start))
        own = torch.linalg.svd(chosen, full_matrices=True).Vh.mT
        if self.training:
            signs = torch.randint(2, (len(x), 1, 3), device=x.device) * 2 - 1
        else:
            signs = torch.where(chosen[:, :1] @ own < 0, -1, 1)
        return x @ own * signs

    def places(self, g: Tensor, index: Tensor) -> Tensor:
        """Rows (R,32) of edges: LeakyReLU(BN(W·[g_i, g_j − g_i]))."""
        mine = g[:, :, None].expand(-1, -1, index.shape[2], -1)
        edges = torch.cat([mine, gather(g, index) - mine], dim=-1)
        return F.leaky_relu(self.place1(edges.flatten(0, 2)), SLOPE)

    def neighbours(self, f: Tensor) -> Tensor:
        """(B,N,C) → (B,N,k) nearest others."""
        return knn(f.detach().double(), self.k + 1, nearest_first=True)[..., 1:]

    def forward(self, points: Tensor, normals: Tensor | None = None) -> Prediction:
        """(B,N,3) clouds in the camera frame, N > k, and their normals (B,N,3) → logits (B,K)."""
        dtype = self.attention.alpha.dtype
        geometry = self.geometry(points, normals)
        g = self.attention(self.in_own_axes(geometry.points).to(dtype))

        def pose(axis: Tensor, index: Tensor) -> Tensor:
            made = pose_features(geometry.points, axis, geometry.mean, index)
            return made.flatten(0, 2).to(dtype)

        apart = self.neighbours(g) if "neighbours" in self.quirks else None
        index = geometry.near
        f = geometry.features.to(dtype)
        mine = g[:, :, None].expand(-1, -1, self.k, -1)
        other = gather(g, index if apart is None else apart)
        edges = torch.cat([mine, other - mine], dim=-1).flatten(0, 2)
        gated = self.gate(torch.cat([pose(geometry.normals, index), edges], dim=-1))
        mine = f[:, :, None].expand(-1, -1, self.k, -1)
        own = torch.cat([gather(f, index) - mine, mine], dim=-1).flatten(0, 2)
        y = self.first(torch.cat([gated, own], dim=-1)).unflatten(0, index.shape)
        f = F.leaky_relu(y.amax(dim=2), SLOPE)
        features = [f]
        place = self.places(g, apart) if apart is not None else None
        for i, conv in enumerate(self.convs):
            index = self.neighbours(f)
            where = self.places(g, index) if place is None else place
            if i == 2:
                where = F.leaky_relu(self.place2(where), SLOPE)
            axis = geometry.normals if i == 2 else geometry.axes
            f = conv(f, index, pose(axis, index), where)
            features.append(f)
        x = torch.cat(features, dim=-1)
        x = F.leaky_relu(self.embed(x.flatten(0, 1)), SLOPE).unflatten(0, x.shape[:2])
        return Prediction(self.head(torch.cat([x.amax(dim=1), x.mean(dim=1)], dim=-1)))


def from_published(state: Mapping[str, Any], model: nn.Module) -> dict[str, Tensor]:
    """The release's state dict → ours."""
    prefixes = {"psa": "attention", "linear1": "head.0", "bn6": "head.1", "linear2": "head.4"}
    prefixes |= {"bn7": "head.5", "linear3": "head.8"}
    layers = {"conv1": "first", "conv5": "embed", "gb_gconv_1": "place1", "gb_gconv_2": "place2"}
    layers |= {"psa.query_conv": "attention.query", "psa.key_conv": "attention.key"}
    layers |= {"psa.value_conv": "attention.value"}
    for i, conv in ((i, f"pari_{i + 1}") for i in range(3)):
        prefixes[f"{conv}.basis_matrix"] = f"convs.{i}.basis"
        prefixes[f"{conv}.act.0"] = f"convs.{i}.norm"
        prefixes[f"{conv}.edge_conv.0"] = f"convs.{i}.edge.linear"
        prefixes[f"{conv}.edge_conv.1"] = f"convs.{i}.edge.norm"
        for j in (0, 1, 3):
            prefixes[f"{conv}.dynamic_kernel.{j}"] = f"convs.{i}.kernel.{j}"
    for j in (0, 1, 3):
        prefixes[f"psa.mlp.{j}"] = f"attention.embed.{j}"
    gates = {"feature_fusion": "gate"}
    gates |= {f"pari_{i + 1}.feature_fusion": f"convs.{i}.gate" for i in range(3)}
    for theirs, ours in gates.items():
        layers[f"{theirs}.conv"] = f"{ours}.squeeze"
        prefixes[f"{theirs}.conv.3"] = f"{ours}.spread"
    for theirs, ours in layers.items():
        prefixes |= {f"{theirs}.{j}": f"{ours}.{j}" for j in range(2)}
    ignored = tuple(f"psa.bn{i}." for i in range(1, 5))
    return tensors(state, model, prefixes, ignored=ignored)
