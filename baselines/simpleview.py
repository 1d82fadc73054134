"""SimpleView: six depth images of the cloud through one small ResNet.

Source: Goyal, Law, Liu, Newell & Deng, "Revisiting Point Cloud Shape Classification with a Simple
and Effective Baseline", ICML 2021; princeton-vl/SimpleView@64c6dfe (architecture and constants).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from baselines import published
from baselines.points import normalise
from partialbench.benchmark.prediction import Prediction
from partialbench.errors import InputError

IMAGE = 128
CAMERA_DISTANCE = 1.4
FEATURES = 16

# Euler angles (x, y, z) in degrees of R = Rx·Ry·Rz; the camera sees Rᵀ applied to row vectors.
_VIEWS_DEG = ((0, 0, 90), (90, 0, 90), (180, 0, 90), (270, 0, 90), (0, -90, 90), (0, 90, 90))


def view_rotations() -> Tensor:
    """(6,3,3) float32 rotations that take points (columns) into each view's frame."""
    R = Rotation.from_euler("XYZ", _VIEWS_DEG, degrees=True).as_matrix()
    return torch.as_tensor(np.round(R), dtype=torch.float32)


@torch.no_grad()
def depth_images(points: Tensor, size: int = IMAGE) -> Tensor:
    """Six perspective depth images of each cloud, seen along the axes.

    The camera is 1.4 from the origin with a field of view of 90°: z = p_z + 1.4, u = x/z, v = y/z,
    and [−1, 1] spans the image. Every point fills one pixel; where several fall into one, the pixel
    is the harmonic mean of their z. Points outside the image are left out.

    Args:
        points: (B,N,3) in the unit ball.
        size: image edge in pixels.

    Returns:
        (B,6,size,size) float32, rows along u, columns along v; 0 where there is no point.
    """
    with torch.autocast(points.device.type, enabled=False):
        views = view_rotations().to(points.device)
        seen = torch.einsum("vij,bnj->bvni", views, points.float())
        z = seen[..., 2] + CAMERA_DISTANCE
        pixel = torch.ceil((seen[..., :2] / z[..., None] + 1) * (size / 2) - 0.5).long()
        inside = ((pixel >= 0) & (pixel < size)).all(-1) & (z > 0)
        index = (pixel[..., 0] * size + pixel[..., 1]).where(inside, 0)
        inverse_z = torch.zeros(*z.shape[:2], size * size, device=z.device)
        count = torch.zeros_like(inverse_z)
        inverse_z.scatter_add_(2, index, torch.where(inside, 1 / z, 0.0))
        count.scatter_add_(2, index, inside.float())
        depth = torch.where(count > 0, count / inverse_z.clamp_min(1e-12), 0.0)
    return depth.view(*depth.shape[:2], size, size)


class BasicBlock(nn.Module):
    """He et al.'s residual block of two 3×3 convolutions; the second batch norm starts at zero."""

    def __init__(self, channels_in: int, channels_out: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels_in, channels_out, 3, stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(channels_out)
        self.conv2 = nn.Conv2d(channels_out, channels_out, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(channels_out)
        nn.init.zeros_(self.bn2.weight)
        self.downsample: nn.Module = nn.Identity()
        if stride != 1 or channels_in != channels_out:
            self.downsample = nn.Sequential(
                nn.Conv2d(channels_in, channels_out, 1, stride, bias=False),
                nn.BatchNorm2d(channels_out),
            )

    def forward(self, x: Tensor) -> Tensor:
        y = torch.relu(self.bn1(self.conv1(x)))
        return torch.relu(self.bn2(self.conv2(y)) + self.downsample(x))


class SimpleView(nn.Module):
    """Six depth images → ResNet18 with 16 features and no max-pool → one head over all views.

    Args:
        image: edge of the images in pixels; the weights fit any.
    """

    def __init__(self, num_classes: int, *, image: int = IMAGE) -> None:
        super().__init__()
        if image < 1:
            raise InputError(f"image must be positive, got {image}")
        self.image = image
        widths = [FEATURES * 2**i for i in range(4)]
        layers = [
            nn.Sequential(BasicBlock(a, b, stride), BasicBlock(b, b, 1))
            for (a, b), stride in zip(
                itertools.pairwise([FEATURES, *widths]), (1, 2, 2, 2), strict=True
            )
        ]
        self.trunk = nn.Sequential(
            nn.Conv2d(1, FEATURES, 3, padding=1, bias=False),
            nn.BatchNorm2d(FEATURES),
            nn.ReLU(inplace=True),
            *layers,
        )
        self.feature_norm = nn.BatchNorm1d(widths[-1])
        self.head = nn.Sequential(
            nn.Dropout(0.5),
            nn.Linear(len(_VIEWS_DEG) * widths[-1], 128),
            nn.BatchNorm1d(128),
            nn.ReLU(inplace=True),
            nn.Dropout(0.5),
            nn.Linear(128, num_classes),
        )
        for module in self.trunk.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        # Channels last in memory, weights and images alike: faster on CPU and GPU.
        self.trunk.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, points: Tensor) -> Prediction:
        """(B,N,3) clouds, any scale and position → class logits (B,K)."""
        images = depth_images(normalise(points), self.image)
        views = images.flatten(0, 1)[:, None].contiguous(memory_format=torch.channels_last)
        features = self.feature_norm(self.trunk(views).mean((2, 3)))
        return Prediction(self.head(features.view(len(points), -1)))


def from_published(state: Mapping[str, Tensor], model: nn.Module) -> dict[str, Tensor]:
    """princeton-vl/SimpleView's ``MVModel`` (resnet18, 16 features) → our state."""
    prefixes = {
        "final_fc.model.0.bn": "feature_norm",
        "final_fc.model.3": "head.1",
        "final_fc.model.4": "head.2",
        "final_fc.model.7": "head.5",
    }
    for name in model.state_dict():
        layer = name.rpartition(".")[0]
        if layer.startswith("trunk."):
            prefixes[layer.replace("trunk.", "img_model.", 1)] = layer
    return published.tensors(state, model, prefixes)
