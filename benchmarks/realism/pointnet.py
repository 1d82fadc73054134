"""A small PointNet for this measurement, and its training.

Source: Qi et al., PointNet, CVPR 2017, without the two transformer networks; narrower than the
paper's, so that a run takes minutes on one core. The project's own PointNet reads camera-frame
clouds under the protocol; this one answers one question about aligned complete clouds.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from benchmarks.realism.clouds import Clouds
from partialbench.dataset.categories import MODELNET40

log = logging.getLogger(__name__)

BATCH = 32
POINTS_A_STEP = 256
PEAK_RATE = 3e-3
LABEL_SMOOTHING = 0.1
MAX_YAW = np.radians(10.0)
MAX_SCALE = 1.25
JITTER = 0.01


class PointNet(nn.Module):
    """(B,N,3) aligned clouds → (B,40) logits: a shared MLP, the maximum over points, an MLP."""

    def __init__(self, widths: Sequence[int] = (64, 128, 256), hidden: int = 256):
        super().__init__()
        layers: list[nn.Module] = []
        for before, after in zip((3, *widths), widths, strict=False):
            layers += [nn.Linear(before, after, bias=False), nn.BatchNorm1d(after), nn.ReLU(True)]
        self.point = nn.Sequential(*layers)
        self.head = nn.Sequential(
            nn.Linear(widths[-1], hidden, bias=False), nn.BatchNorm1d(hidden), nn.ReLU(True),
            nn.Dropout(0.3), nn.Linear(hidden, len(MODELNET40)),
        )  # fmt: skip

    def forward(self, points: Tensor) -> Tensor:
        """(B,N,3) → (B,40)."""
        features = self.point(points.flatten(0, 1)).unflatten(0, points.shape[:2])
        return self.head(features.amax(dim=1))


def augment(points: Tensor, rng: torch.Generator) -> Tensor:
    """Scaled along each axis, turned a little about z, jittered, normalised again.

    Mild on purpose: the classes of aligned objects differ by proportions and by yaw.
    """
    B, N, _ = points.shape

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=rng) * 2 - 1

    points = points * MAX_SCALE ** uniform(B, 1, 3)
    angle = uniform(B) * MAX_YAW
    c, s, o, i = angle.cos(), angle.sin(), torch.zeros(B), torch.ones(B)
    turn = torch.stack([c, -s, o, s, c, o, o, o, i], dim=1).view(B, 3, 3)
    points = points @ turn.transpose(1, 2)
    points = points + torch.randn(B, N, 3, generator=rng).clamp(-3, 3) * JITTER
    points = points - (points.amin(dim=1, keepdim=True) + points.amax(dim=1, keepdim=True)) / 2
    return points / points.norm(dim=-1).amax(dim=1)[:, None, None]


def train(clouds: Clouds, epochs: int, seed: int) -> PointNet:
    """A PointNet trained by Adam under a one-cycle schedule, on 256 random points a step."""
    torch.manual_seed(seed)  # the weights and dropout draw from the global generator
    rng = torch.Generator().manual_seed(seed)
    model = PointNet()
    points, labels = torch.from_numpy(clouds.points), torch.from_numpy(clouds.labels)
    steps = len(labels) // BATCH
    optimiser = torch.optim.Adam(model.parameters(), lr=PEAK_RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, PEAK_RATE, total_steps=steps * epochs)
    loss_of = nn.CrossEntropyLoss(label_smoothing=LABEL_SMOOTHING)
    start = time.perf_counter()
    for epoch in range(epochs):
        order = torch.randperm(len(labels), generator=rng)
        correct = 0
        for rows in order[: steps * BATCH].view(steps, BATCH):
            some = torch.randperm(points.shape[1], generator=rng)[:POINTS_A_STEP]
            logits = model(augment(points[rows][:, some], rng))
            loss = loss_of(logits, labels[rows])
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
            schedule.step()
            correct += int((logits.argmax(dim=1) == labels[rows]).sum())
        log.info("epoch %d of %d: %.1f %% on its own training batches, %.0f s", epoch + 1, epochs,
                 100 * correct / (steps * BATCH), time.perf_counter() - start)  # fmt: skip
    return model.eval()


@torch.inference_mode()
def predict(model: PointNet, clouds: Clouds) -> NDArray[np.int64]:
    """(M,) the most probable labels, from all points."""
    batches = torch.from_numpy(clouds.points).split(64)
    return torch.cat([model(batch).argmax(dim=1) for batch in batches]).numpy()
