"""IT-Net before PointNet++: a rigid transform refined over iterations, then the classifier.

The paper compares with this pair but releases no code for it. Ours: IT-Net as its release
classifies (two iterations, class loss alone), on the normalised cloud, with PointNet++ (SSG) in the
classifier's place.

Source: Yuan et al., Iterative Transformer Network for 3D Point Cloud, 2018;
wentaoyuan/it-net@55e654b.
"""

from __future__ import annotations

import roma
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from baselines.pointnet import TransformNet
from baselines.pointnet2 import PointNet2
from baselines.points import as_weights, normalise
from partialbench import given
from partialbench.benchmark.prediction import Prediction


class ITNetPointNet2(nn.Module):
    """PointNet++ (SSG) on clouds moved by an iterated rigid transform, the identity at first.

    One T-Net predicts a quaternion (w, x, y, z), normalised here, and a translation, in every
    iteration: T ← T_Δ·T, points ← R·p + t.

    Args:
        iterations: 2, as the release classifies.

    Raises:
        InputError: no iteration, which would be PointNet++ with weights that nothing trains.
    """

    def __init__(self, num_classes: int, iterations: int = 2) -> None:
        super().__init__()
        self.iterations = given.whole_number(iterations, "iterations", least=1)
        self.transform = TransformNet(3, torch.tensor([1.0, 0, 0, 0, 0, 0, 0]))
        self.classifier = PointNet2(num_classes)

    def pose(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """R (B,3,3) and t (B,3) after all iterations, for normalised clouds (B,N,3).

        The points that enter an iteration carry no gradient, as published: it reaches earlier
        iterations only through the product of the transforms.
        """
        R = torch.eye(3, device=points.device, dtype=points.dtype).expand(len(points), 3, 3)
        t = points.new_zeros(len(points), 3)
        for _ in range(self.iterations):
            moved = (points @ R.mT + t[:, None]).detach()
            numbers = self.transform(moved)
            wxyz = F.normalize(numbers[:, :4], dim=1)
            R_step = roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(wxyz))
            R, t = R_step @ R, (R_step @ t[..., None])[..., 0] + numbers[:, 4:]
        return R, t

    def forward(self, points: Tensor) -> Prediction:
        """(B,N,3) clouds in the camera frame → logits (B,K)."""
        points = as_weights(normalise(points), self)
        # The pose moves every point, and neighbourhoods change with it: no half precision here.
        with torch.autocast(points.device.type, enabled=False):
            R, t = self.pose(points)
            moved = points @ R.mT + t[:, None]
        return Prediction(self.classifier.classify(moved))
