"""The mean of a model's weights over the steps of a branch, and the statistics that belong to it.

Source: Izmailov et al., Averaging Weights Leads to Wider Optima and Better Generalization, UAI
2018: the plain mean, and batch norm's statistics taken anew, for those along the way are of other
weights.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

FRESH_BATCHES = 100
"""Batches over which statistics are taken anew. Each module keeps a running estimate of the last
ten or so; the mean of the estimates over these batches is of ten times as many."""
SETTLING = 20
"""The first of them, whose estimates are still of the weights before."""


class WeightMean:
    """The mean, so far, of the parameters of one model."""

    def __init__(self) -> None:
        self.count = 0
        self.mean: dict[str, Tensor] = {}

    @torch.no_grad()
    def add(self, model: nn.Module) -> None:
        """Counts the parameters as they are now."""
        self.count += 1
        for name, parameter in model.named_parameters():
            if name in self.mean:
                self.mean[name].lerp_(parameter, 1 / self.count)
            else:
                self.mean[name] = parameter.detach().clone()

    @torch.no_grad()
    def put_into(self, model: nn.Module) -> None:
        """Makes the mean the model's parameters."""
        for name, parameter in model.named_parameters():
            parameter.copy_(self.mean[name])

    def state(self) -> dict[str, Any]:
        """For a checkpoint, which has tensors on the CPU alone."""
        return {
            "averaged": self.count,
            "average": {name: tensor.cpu() for name, tensor in self.mean.items()},
        }

    def load(self, saved: Mapping[str, Any], model: nn.Module) -> None:
        """Goes on from what ``state`` gave."""
        self.count = saved["averaged"]
        devices = {name: parameter.device for name, parameter in model.named_parameters()}
        self.mean = {n: tensor.to(devices[n]).clone() for n, tensor in saved["average"].items()}


@torch.no_grad()
def refresh_statistics(model: nn.Module, passes: Iterable[Any]) -> None:
    """Takes every floating buffer to its mean over forward passes in training mode.

    Args:
        passes: each item of it is a pass done. Buffers that a pass does not change keep their
            value, and so do whole numbers, such as counts of batches.
    """
    buffers = {n: b for n, b in model.named_buffers() if b.is_floating_point()}
    sums = {name: torch.zeros_like(buffer) for name, buffer in buffers.items()}
    counted = 0
    for done, _ in enumerate(passes):
        if done >= SETTLING:
            counted += 1
            for name, buffer in model.named_buffers():
                if name in sums:
                    sums[name] += (buffer - sums[name]) / counted
    if counted:
        for name, buffer in model.named_buffers():
            if name in sums:
                buffer.copy_(sums[name])
