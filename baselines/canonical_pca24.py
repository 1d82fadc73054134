"""A cloud in the frame of its principal axes, in all 24 poses that the axes leave open.

Source: Li et al., A Closer Look at Rotation-Invariant Deep Point Cloud Analysis, ICCV 2021;
feiran-l/rotation-invariant-pointcloud-analysis@205b6e9.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from baselines.canonical import Backbone
from baselines.dgcnn import SLOPE
from baselines.points import as_weights, full_precision, normalise
from baselines.published import tensors
from baselines.released_backbones import TNetDGCNN
from baselines.shared_mlp import NormLinear, activated
from partialbench.benchmark.prediction import Prediction

POSES = 24
_AXES = (
    ((0, 1, 2), (1, 2, 0), (2, 0, 1)),
    ((0, 2, 1), (1, 0, 2), (2, 1, 0)),
)
_SIGNS = (
    ((1, 1, 1), (-1, -1, 1), (-1, 1, -1), (1, -1, -1)),
    ((-1, -1, -1), (-1, 1, 1), (1, -1, 1), (1, 1, -1)),
)


def octahedral_group() -> Tensor:
    """The 24 rotations (24,3,3) that map the axes onto each other, float32, as the release orders
    them. Column a of each has its one entry, the sign, in the row that becomes axis a."""
    group = torch.zeros(POSES, 3, 3)
    which = 0
    for parity in range(2):
        for axes in _AXES[parity]:
            for signs in _SIGNS[parity]:
                for column in range(3):
                    group[which, axes[column], column] = signs[column]
                which += 1
    return group


def composed(group: Tensor) -> Tensor:
    """Index (24,24) of G_r·G_c."""
    products = group[:, None] @ group
    return (products[:, :, None] == group).flatten(3).all(dim=-1).long().argmax(dim=-1)


@torch.no_grad()
def principal_frame(points: Tensor) -> Tensor:
    """Coordinates (B,N,3) of centred clouds (B,N,3) along their principal axes, the smallest
    variance first, right-handed; of which 24 poses is the solver's choice.

    Axes of equal variance are undetermined: they are any in their plane.
    """
    with torch.autocast(points.device.type, enabled=False):
        exact = points.double()
        _, axes = torch.linalg.eigh(exact.mT @ exact)
        axes[..., 0] *= torch.linalg.det(axes)[:, None].sign()
        return (exact @ axes).to(full_precision(points).dtype)


class Selector(nn.Module):
    """Weights (B,24) of poses, summing to 1, from their coordinates: 24-512-256 a number of the
    cloud, maximum, 24."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.ModuleList([NormLinear(POSES, 512), NormLinear(512, 256)])
        self.last = nn.Linear(256, POSES)

    def forward(self, poses: Tensor) -> Tensor:
        """(B,N,3,24) → (B,24)."""
        first, second = self.layers
        assert isinstance(second, NormLinear)
        x = F.leaky_relu(second.max(activated([first], poses.flatten(1, 2), SLOPE)), SLOPE)
        return self.last(x).softmax(dim=-1)


class CanonicalPCA24(nn.Module):
    """A classifier on clouds along their principal axes.

    In training each cloud stands in one of its 24 poses, drawn at random; in evaluation in all of
    them, so that the answer depends on none.

    Args:
        backbone: a registered model's name, a user's "module:factory", or "released", the DGCNN
            behind the published frame.
        backbone_options: of its factory.
        pooling: "poses": the logits of the 24 poses are averaged. "blend": the published network;
            it mixes the 24 clouds, with weights chosen from them, into one, and sums the logits
            of all orders in which they can be given. A mixture of rotations is no rotation but a
            3×3 matrix; flat weights shrink the cloud to a point.
    """

    rotations: Tensor
    orders: Tensor

    def __init__(
        self,
        num_classes: int,
        backbone: str = "pointnet2-ssg",
        backbone_options: dict[str, Any] | None = None,
        pooling: Literal["poses", "blend"] = "poses",
    ) -> None:
        super().__init__()
        self.backbone = Backbone(num_classes, backbone, backbone_options or {}, TNetDGCNN)
        self.selector = Selector() if pooling == "blend" else None
        group = octahedral_group()
        self.register_buffer("rotations", group, persistent=False)
        self.register_buffer("orders", composed(group), persistent=False)

    def pose(self, canonical: Tensor, which: Tensor) -> tuple[Tensor, Tensor | None]:
        """Clouds (B,N,3) as the backbone gets them, and the selector's weights (B,24).

        Args:
            which: (B,) pose of each cloud, or order of its poses.
        """
        with torch.autocast(canonical.device.type, enabled=False):
            if self.selector is None:
                return canonical @ self.rotations[which].to(canonical.dtype), None
            ordered = self.rotations[self.orders[which]].to(canonical.dtype)
            poses = torch.einsum("bni,bgij->bnjg", canonical, ordered)
            weights = self.selector(poses).to(canonical.dtype)
            return canonical @ torch.einsum("bg,bgij->bij", weights, ordered), weights

    def forward(self, points: Tensor) -> Prediction:
        """(B,N,3) clouds in the camera frame → logits (B,K)."""
        canonical = as_weights(principal_frame(normalise(points, radius=1.0)), self)
        if self.training:
            which = torch.randint(POSES, (len(points),), device=points.device)
            return self.backbone(self.pose(canonical, which)[0])
        # One pose after the other: memory is that of the backbone.
        total: Tensor | None = None
        for which in torch.arange(POSES, device=points.device):
            logits = self.backbone(self.pose(canonical, which.expand(len(points)))[0]).class_logits
            total = logits if total is None else total + logits
        assert total is not None
        return Prediction(total / POSES if self.selector is None else total)


def from_published(state: Mapping[str, Tensor], model: nn.Module) -> dict[str, Tensor]:
    """The release's state dict → ours with ``backbone=released`` and ``pooling=blend``.

    Its trunk's ``bn1`` … ``bn5`` are never used.
    """
    prefixes = {"linearsel3": "selector.last"}
    for i in range(2):
        prefixes[f"linearsel{i + 1}"] = f"selector.layers.{i}.linear"
        prefixes[f"bnsel{i + 1}"] = f"selector.layers.{i}.norm"
    ours = "backbone.network"
    layers = {f"conv{i + 1}": f"{ours}.convs.{i}" for i in range(4)}
    layers["conv5"] = f"{ours}.embed"
    for i, layer in enumerate(("edge", "wide", "point")):
        layers[f"transform_net.conv{i + 1}"] = f"{ours}.tnet.{layer}"
    prefixes |= {f"{theirs}.0": f"{mine}.linear" for theirs, mine in layers.items()}
    prefixes |= {f"{theirs}.1": f"{mine}.norm" for theirs, mine in layers.items()}
    for name, i in (("linear1", 0), ("bn3", 1), ("linear2", 3), ("bn4", 4)):
        prefixes[f"transform_net.{name}"] = f"{ours}.tnet.cloud.{i}"
    prefixes["transform_net.transform"] = f"{ours}.tnet.last"
    for name, i in (("linear1", 0), ("bn6", 1), ("linear2", 4), ("bn7", 5), ("linear3", 8)):
        prefixes[name] = f"{ours}.head.{i}"
    ignored = tuple(f"bn{i}." for i in range(1, 6)) + ("transform_net.bn1.", "transform_net.bn2.")
    return tensors(state, model, prefixes, ignored=ignored)
