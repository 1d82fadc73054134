"""T-Net before PointNet++: the cloud is first multiplied by a 3×3 matrix predicted from it.

The paper compares with this pair but releases no code for it. Ours: PointNet's input transform as
it-net has it, nine free numbers without translation or orthogonality penalty, on the normalised
cloud; PointNet++ with single-scale grouping after it; the class loss alone supervises both.

Source: Qi et al., PointNet, CVPR 2017; wentaoyuan/it-net@55e654b (t_net.py).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from baselines.pointnet import TransformNet
from baselines.pointnet2 import PointNet2
from baselines.points import as_weights, normalise
from partialbench.benchmark.prediction import Prediction


class TNetPointNet2(nn.Module):
    """PointNet++ (SSG) on clouds multiplied by a T-Net's matrix, which starts at the identity."""

    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.transform = TransformNet(3, torch.eye(3).flatten())
        self.classifier = PointNet2(num_classes)

    def forward(self, points: Tensor) -> Prediction:
        """(B,N,3) clouds in the camera frame → logits (B,K)."""
        points = as_weights(normalise(points), self)
        # The matrix moves every point, and neighbourhoods change with it: no half precision here.
        with torch.autocast(points.device.type, enabled=False):
            turned = points @ self.transform(points).view(-1, 3, 3)
        return Prediction(self.classifier.classify(turned))
