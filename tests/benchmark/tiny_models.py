"""Small models for tests of the harness, as a user would write theirs."""

from __future__ import annotations

import time

import torch
from torch import nn
from torch.nn.functional import cross_entropy

from partialbench.benchmark.prediction import Prediction

MODELS = __name__
STEERED = {"channels": 8, "width": 8, "poses": 60}
"""Options that make papnet-steered small."""

SMALL = {
    "preset": "smoke", "device": "cpu", "num_points": 64, "clouds": [64], "max_train_clouds": 200,
    "max_test_clouds": 200,
}  # fmt: skip
"""Arguments of ``run_eval`` under which they are trained in a second."""


class Bare(nn.Module):
    """Bare logits; batch norm and dropout, the two that break resuming."""

    def __init__(self, num_classes: int, width: int = 16) -> None:
        super().__init__()
        self.points = nn.Sequential(
            nn.Conv1d(3, width, 1), nn.BatchNorm1d(width), nn.ReLU(), nn.Conv1d(width, 64, 1)
        )
        self.head = nn.Sequential(nn.ReLU(), nn.Dropout(0.3), nn.Linear(64, num_classes))

    def forward(self, clouds: torch.Tensor) -> torch.Tensor:
        centred = clouds - clouds.mean(dim=1, keepdim=True)
        return self.head(self.points(centred.transpose(1, 2)).amax(dim=2))


class Posed(nn.Module):
    """Class and pose, with a loss of its own."""

    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.body = Bare(num_classes + 60)
        self.num_classes = num_classes

    def forward(self, clouds: torch.Tensor) -> Prediction:
        logits = self.body(clouds)
        return Prediction(logits[:, : self.num_classes], logits[:, self.num_classes :])

    def training_loss(self, batch):
        return cross_entropy(self(batch.points).class_logits, batch.label)


class Broken(Bare):
    """Turns NaN at the third training step."""

    steps = 0

    def forward(self, clouds: torch.Tensor) -> torch.Tensor:
        self.steps += self.training
        return super().forward(clouds) * (float("nan") if self.steps > 2 else 1.0)


class NoNorm(nn.Module):
    """Without batch statistics: what several processes must agree on exactly."""

    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.points = nn.Sequential(nn.Linear(3, 32), nn.ReLU(), nn.Linear(32, 64))
        self.head = nn.Linear(64, num_classes)

    def forward(self, clouds: torch.Tensor) -> torch.Tensor:
        centred = clouds - clouds.mean(dim=1, keepdim=True)
        return self.head(self.points(centred).amax(dim=1))


class Penalised(NoNorm):
    """With a penalty that is a sum over the batch, as PointNet's."""

    def forward(self, clouds: torch.Tensor) -> Prediction:
        logits = super().forward(clouds)
        return Prediction(logits, penalty=0.1 * (logits.square().sum(1) - 1).square().sum())


def wrong_shape(num_classes: int) -> nn.Module:
    return Bare(num_classes + 1)


def not_a_model(num_classes: int) -> int:
    return num_classes


class Interrupted(Bare):
    """Stops like Ctrl-C at a training step chosen from outside."""

    stop_at: int | None = None
    taken = 0

    def forward(self, clouds: torch.Tensor) -> torch.Tensor:
        if self.training:
            Interrupted.taken += 1
            if Interrupted.taken == Interrupted.stop_at:
                raise KeyboardInterrupt
        return super().forward(clouds)


class Slow(Bare):
    """Long enough a step to be killed within one."""

    def forward(self, clouds: torch.Tensor) -> torch.Tensor:
        time.sleep(0.1 * self.training)
        return super().forward(clouds)
