"""PointNet with its input and feature transforms.

Source: Qi et al., PointNet, CVPR 2017; charlesq34/pointnet@2618f72 (TensorFlow).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from baselines.points import as_weights, full_precision, normalise
from baselines.shared_mlp import SharedMLP, head
from partialbench.benchmark.prediction import Prediction

PENALTY = 0.001
"""Weight of the feature transform's orthogonality term."""


class TransformNet(nn.Module):
    """A small PointNet that predicts a transform's numbers from a cloud: a T-Net.

    Shared MLP C-64-128-1024, maximum, 512-256, linear. The last layer starts with zero weights and
    the bias ``initial``, so that training begins at that transform whatever the cloud.

    Args:
        inputs: channels of a point.
        initial: (D,) the D numbers to start from.
    """

    def __init__(self, inputs: int, initial: Tensor) -> None:
        super().__init__()
        self.mlp = SharedMLP(inputs, 64, 128, 1024)
        self.head = head(1024, 512, 256, len(initial), dropout=(0.0, 0.0))
        last = self.head[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        with torch.no_grad():
            last.bias.copy_(initial)

    def forward(self, points: Tensor) -> Tensor:
        """(B,N,C) → (B,D)."""
        return self.head(self.mlp.max(points))


def orthogonality_penalty(transform: Tensor) -> Tensor:
    """½·Σ ‖T·Tᵀ − I‖²_F over the batch, for transforms (B,C,C).

    Summed, not averaged, over the batch: the release applies TensorFlow's l2_loss to all of it.
    """
    transform = full_precision(transform)
    identity = torch.eye(transform.shape[-1], device=transform.device, dtype=transform.dtype)
    return (transform @ transform.mT - identity).square().sum() / 2


class PointNet(nn.Module):
    """PointNet's classifier.

    Input T-Net 3×3; 64-64; feature T-Net 64×64; 64-128-1024; maximum; 512-256-K with dropout 0.3
    twice. Layers before a batch norm keep their bias, as released. The orthogonality term of the
    feature transform comes back as ``Prediction.penalty``, weighted by ``PENALTY``.
    """

    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.input_transform = TransformNet(3, torch.eye(3).flatten())
        self.mlp1 = SharedMLP(3, 64, 64)
        self.feature_transform = TransformNet(64, torch.eye(64).flatten())
        self.mlp2 = SharedMLP(64, 64, 128, 1024)
        self.head = head(1024, 512, 256, num_classes, dropout=(0.3, 0.3))

    def forward(self, points: Tensor) -> Prediction:
        """(B,N,3) clouds in the camera frame → logits (B,K) and the penalty."""
        points = as_weights(normalise(points), self)
        turn = self.input_transform(points).view(-1, 3, 3)
        with torch.autocast(points.device.type, enabled=False):
            turned = points @ turn
        x = self.mlp1(turned)
        transform = self.feature_transform(x).view(-1, 64, 64)
        logits = self.head(self.mlp2.max(x @ transform))
        with torch.autocast(points.device.type, enabled=False):
            penalty = PENALTY * orthogonality_penalty(transform)
        return Prediction(logits, penalty=penalty)
