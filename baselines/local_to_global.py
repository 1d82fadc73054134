"""Local-to-global fusion: what a neighbourhood looks like, and where it is in the cloud's own axes.

Source: Zhao et al., Rotation Invariant Point Cloud Analysis: Where Local Geometry Meets Global
Topology; CentauriStar/Rotation-Invariant-Point-Cloud-Analysis@a1b3fad. Its local layers are those
of Chen & Cong, The Devil is in the Pose (PaRI-Conv), CVPR 2022. Geometry is computed in double
precision: where rounding chose a neighbour, a turned cloud would get another answer.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.func import functional_call

from baselines.camera import camera_ray
from baselines.joined import JoinedMax
from baselines.lra import as_normals, dot, facing, local_axes, require_signs, unit
from baselines.points import (
    distances,
    farthest_from_centre,
    farthest_points,
    gather,
    knn,
    normalise,
)
from baselines.published import chosen_quirks, tensors
from baselines.shared_mlp import NormLinear
from partialbench import given
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
    "neighbours": "the j-th nearest in the cloud's axes stands beside the layer's own j-th",
    "signs": "axes have the sign that LAPACK leaves",
    "dropout": "0.8, which a truncated option of the training script sets, in place of 0.5",
}
"""What the release does that the row does not."""


@dataclass(frozen=True)
class Geometry:
    """What no layer changes; no gradient.

    Attributes:
        points: (B,N,3) float64, in the unit ball.
        own: (B,N,3) their coordinates along the cloud's axes.
        axes: (B,N,3) local reference axes.
        normals: (B,N,3) normals, or the axes again.
        mean: (B,N,3) direction to the mean of the neighbours.
        near: (B,N,k) nearest others, nearest first.
        features: (B,N,3) of points: distance from the centroid, cosine and sine of the axis to it.
    """

    points: Tensor
    own: Tensor
    axes: Tensor
    normals: Tensor
    mean: Tensor
    near: Tensor
    features: Tensor

    @torch.no_grad()
    def pose(self, axis: Tensor, index: Tensor) -> Tensor:
        """Rows (R,8) of the edges, by axes or normals; see ``pose_features``."""
        return pose_features(self.points, axis, self.mean, index).flatten(0, 2)


def neighbourhoods(points: Tensor, k: int) -> tuple[Tensor, Tensor, Tensor]:
    """Clouds (B,N,3) in the unit ball, each point's nearest (B,N,M), itself first, and these as the
    point sees them (B,N,M,3); float64. M is what axes, means and k others need.

    Raises:
        InputError: for clouds of k points or fewer.
    """
    number = points.shape[1]
    if number <= k:
        raise InputError(f"{k} neighbours need clouds of at least {k + 1} points, got {number}")
    x = normalise(points, radius=1.0, dtype=torch.float64)
    most = min(max(MEAN_NEIGHBOURS, k + 1), number)
    near = distances(x, x).topk(most, dim=-1, largest=False).indices
    return x, near, gather(x, near) - x[:, :, None]


def oriented_axes(points: Tensor, x: Tensor, relative: Tensor, orient: str) -> Tensor:
    """Local axes (B,N,3) that point away from the centroid, or ("camera") towards the camera.

    Args:
        points: clouds in the camera frame. x, relative: see ``neighbourhoods``.
    """
    away = -camera_ray(points)[:, None].double() if orient == "camera" else x
    return facing(local_axes(relative[:, :, :AXIS_NEIGHBOURS]), away)


def point_features(x: Tensor, axes: Tensor) -> Tensor:
    """(B,N,3): distance from the centroid, cosine and sine of the axis against the way to it."""
    ray = unit(x)
    sine = torch.linalg.vector_norm(torch.linalg.cross(axes, ray, dim=-1), dim=-1)
    return torch.stack([torch.linalg.vector_norm(x, dim=-1), dot(axes, ray), sine], dim=-1)


def in_double(module: nn.Module) -> Callable[..., Any]:
    """The module in double precision: in evaluation, rounding is not to choose neighbours."""
    named = chain(module.named_parameters(), module.named_buffers())
    state = {name: t.double() if t.is_floating_point() else t for name, t in named}
    return lambda *inputs: functional_call(module, state, inputs)


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


def pairs(x: Tensor, index: Tensor, own_first: bool = False) -> Tensor:
    """Rows (R,2C) of [x_j − x_i, x_i], or the other order; (B,N,C), (B,N,k)."""
    mine = x[:, :, None].expand(-1, -1, index.shape[2], -1)
    relative = gather(x, index) - mine
    parts = [mine, relative] if own_first else [relative, mine]
    return torch.cat(parts, dim=-1).flatten(0, 2)


def normed(inputs: int, outputs: int) -> nn.Sequential:
    """A linear layer and batch norm over rows, computed one after the other.

    For layers with many inputs and few outputs that is quicker than ``NormLinear``.
    """
    return nn.Sequential(nn.Linear(inputs, outputs, bias=False), nn.BatchNorm1d(outputs))


class Gate(nn.Module):
    """x·σ(W'·LeakyReLU(BN(W·x))), (R,C) → (R,C)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.squeeze = normed(channels, channels // 2)
        self.spread = nn.Linear(channels // 2, channels, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        inner = F.leaky_relu_(self.squeeze(x), SLOPE)
        return x * self.spread(inner).sigmoid_()


class PoseConv(nn.Module):
    """A layer whose kernel depends on how two points stand to each other, and on where they are.

    Args:
        inputs, outputs: channels of a point.
        place: channels of an edge of the global branch.
    """

    def __init__(self, inputs: int, outputs: int, place: int) -> None:
        super().__init__()
        self.hidden = NormLinear(8, inputs // 4)
        self.kernel = nn.Linear(inputs // 4, inputs - place)
        self.gate = Gate(inputs)
        self.basis = nn.Linear(inputs, inputs, bias=False)
        self.norm = nn.BatchNorm1d(inputs)
        self.edge = JoinedMax(inputs, inputs, outputs, bias=False)

    def forward(self, f: Tensor, near: Tensor, pose: Tensor, place: Tensor) -> Tensor:
        """(B,N,C), (B,N,k), rows (R,8) and (R,C') of the edges → (B,N,C_out)."""
        kernel = self.kernel(F.relu_(self.hidden(pose)))
        kernel = self.gate(torch.cat([kernel, place], dim=-1))
        basis = gather(self.basis(f), near).flatten(0, 2)
        h = F.relu_(self.norm(kernel * basis)).unflatten(0, near.shape)
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


class Trunk(nn.Module):
    """All layers whose outputs choose neighbours: 64, 64 and 128 channels a point.

    Args:
        k, quirks: see ``LocalToGlobal``.
    """

    def __init__(self, k: int, quirks: frozenset[str]) -> None:
        super().__init__()
        self.k, self.quirks = k, quirks
        self.attention = Attention()
        self.place = NormLinear(6, 32, bias=False)
        self.gate = Gate(14)
        self.first = NormLinear(20, 64, bias=False)
        self.convs = nn.ModuleList([PoseConv(64, 64, 32), PoseConv(64, 128, 32)])

    def neighbours(self, f: Tensor) -> Tensor:
        """(B,N,C) features → (B,N,k) nearest others, nearest first."""
        # In training, where rounding may choose, in half the time.
        return knn(f.detach() if self.training else f.detach().double(), self.k + 1)[..., 1:]

    def places(self, g: Tensor, index: Tensor) -> Tensor:
        """Rows (R,32) of edges in the cloud's axes, (B,N,3), (B,N,k)."""
        return F.leaky_relu(self.place(pairs(g, index, own_first=True)), SLOPE)

    def forward(self, geometry: Geometry) -> tuple[list[Tensor], Tensor, Tensor]:
        """Features of points after each layer, the neighbours of the next, their places (R,32)."""
        dtype = self.attention.alpha.dtype
        g = self.attention(geometry.own.to(dtype))
        apart = self.neighbours(g) if "neighbours" in self.quirks else None
        near, f = geometry.near, geometry.features.to(dtype)
        pose = geometry.pose(geometry.normals, near).to(dtype)
        where = pairs(g, near if apart is None else apart, own_first=True)
        gated = self.gate(torch.cat([pose, where], dim=-1))
        edges = torch.cat([gated, pairs(f, near)], dim=-1).unflatten(0, near.shape)
        f = F.leaky_relu(self.first.max(edges), SLOPE)
        features, shared = [f], None if apart is None else self.places(g, apart)
        for conv in self.convs:
            near = self.neighbours(f)
            place = self.places(g, near) if shared is None else shared
            f = conv(f, near, geometry.pose(geometry.axes, near).to(dtype), place)
            features.append(f)
        near = self.neighbours(f)
        return features, near, self.places(g, near) if shared is None else shared


class LocalToGlobal(nn.Module):
    """A first layer and three whose neighbours are near in features, 64, 64, 128, 256, their
    outputs joined, 1024 channels a point, maximum and mean over points, 512-256-K.

    Args:
        k: neighbours, the point itself not included.
        orient: "centroid": local axes point away from it; "camera": towards the camera.
        quirks: names of ``QUIRKS`` joined by "+": what to do as the release does.

    Raises:
        InputError: no neighbour, or an option that is not known or, beside another, does nothing.
    """

    def __init__(
        self, num_classes: int, k: int = 20, orient: str = "centroid", quirks: str = ""
    ) -> None:
        super().__init__()
        if orient not in ("centroid", "camera"):
            raise InputError(f"orient must be centroid or camera, got {orient!r}")
        self.k, self.orient = given.whole_number(k, "k", least=1), orient
        self.quirks = chosen_quirks(quirks, QUIRKS)
        require_signs(orient, self.quirks)
        self.trunk = Trunk(self.k, self.quirks)
        self.place = NormLinear(32, 64, bias=False)
        self.conv = PoseConv(128, 256, 64)
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
        x, near, relative = neighbourhoods(points, self.k)
        if "signs" in self.quirks:
            # In the release's precision: another leaves other signs.
            axes = local_axes(relative[:, :, :AXIS_NEIGHBOURS].float()).double()
        else:
            axes = oriented_axes(points, x, relative, self.orient)
        mean = unit(relative[:, :, :MEAN_NEIGHBOURS].mean(dim=2))
        normals = axes if normals is None else as_normals(normals, points)
        others, features = near[..., 1 : self.k + 1], point_features(x, axes)
        return Geometry(x, self.in_own_axes(x), axes, normals, mean, others, features)

    def in_own_axes(self, x: Tensor) -> Tensor:
        """(B,N,3) normalised clouds → their coordinates along their own axes."""
        if "layout" in self.quirks:
            x = x.reshape(len(x), 3, -1).mT
        start = farthest_from_centre(x - x.mean(dim=1, keepdim=True))
        chosen = gather(x, farthest_points(x, min(SAMPLED, x.shape[1]), start))
        own = torch.linalg.svd(chosen, full_matrices=False).Vh.mT
        if self.training:
            signs = torch.randint(2, (len(x), 1, 3), device=x.device) * 2 - 1
        else:
            signs = torch.where(chosen[:, :1] @ own < 0, -1, 1)
        return x @ own * signs

    def forward(self, points: Tensor, normals: Tensor | None = None) -> Prediction:
        """(B,N,3) clouds in the camera frame, N > k, and their normals (B,N,3) → logits (B,K)."""
        geometry = self.geometry(points, normals)
        trunk = self.trunk if self.training else in_double(self.trunk)
        # Autocast would mix eight bits into what evaluation does in double.
        autocast = torch.is_autocast_enabled(points.device.type) and self.training
        with torch.autocast(points.device.type, enabled=autocast):
            features, near, place = trunk(geometry)
        dtype = self.conv.norm.weight.dtype
        f = features[-1].to(dtype)
        place = F.leaky_relu(self.place(place.to(dtype)), SLOPE)
        pose = geometry.pose(geometry.normals, near).to(dtype)
        x = torch.cat([*(x.to(dtype) for x in features), self.conv(f, near, pose, place)], dim=-1)
        x = F.leaky_relu(self.embed(x.flatten(0, 1)), SLOPE).unflatten(0, x.shape[:2])
        return Prediction(self.head(torch.cat([x.amax(dim=1), x.mean(dim=1)], dim=-1)))


def from_published(state: Mapping[str, Tensor], model: nn.Module) -> dict[str, Tensor]:
    """The release's state dict → ours."""
    prefixes = {"psa": "trunk.attention", "linear1": "head.0", "bn6": "head.1"}
    prefixes |= {"linear2": "head.4", "bn7": "head.5", "linear3": "head.8"}
    layers = {"conv5": "embed"}
    folded = {"conv1": "trunk.first", "gb_gconv_1": "trunk.place", "gb_gconv_2": "place"}
    layers |= {f"psa.{n}_conv": f"trunk.attention.{n}" for n in ("query", "key", "value")}
    gates = {"feature_fusion": "trunk.gate"}
    convs = {"pari_1": "trunk.convs.0", "pari_2": "trunk.convs.1", "pari_3": "conv"}
    for theirs, ours in convs.items():
        prefixes[f"{theirs}.basis_matrix"] = f"{ours}.basis"
        prefixes[f"{theirs}.act.0"] = f"{ours}.norm"
        prefixes[f"{theirs}.edge_conv.0"] = f"{ours}.edge.linear"
        prefixes[f"{theirs}.edge_conv.1"] = f"{ours}.edge.norm"
        gates[f"{theirs}.feature_fusion"] = f"{ours}.gate"
        prefixes[f"{theirs}.dynamic_kernel.3"] = f"{ours}.kernel"
        folded[f"{theirs}.dynamic_kernel"] = f"{ours}.hidden"
    for j in (0, 1, 3):
        prefixes[f"psa.mlp.{j}"] = f"trunk.attention.embed.{j}"
    for theirs, ours in gates.items():
        layers[f"{theirs}.conv"] = f"{ours}.squeeze"
        prefixes[f"{theirs}.conv.3"] = f"{ours}.spread"
    for theirs, ours in layers.items():
        prefixes |= {f"{theirs}.{j}": f"{ours}.{j}" for j in range(2)}
    for theirs, ours in folded.items():
        prefixes |= {f"{theirs}.0": f"{ours}.linear", f"{theirs}.1": f"{ours}.norm"}
    # It names the attention's norms a second time.
    ignored = tuple(f"psa.bn{i}." for i in range(1, 5))
    return tensors(state, model, prefixes, ignored=ignored)
