"""Models that wait for their device: for a value, for a place, for a tensor on the host; and one
that does not."""

from __future__ import annotations

import functools

import torch


class Waiting(torch.nn.Module):
    def __init__(self, num_classes: int, how: str) -> None:
        super().__init__()
        self.how, self.layer = how, torch.nn.Linear(3, num_classes)

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        if self.how == "value" and float(points.sum()) > 0:
            return self.layer(points[:, 0])
        if self.how == "place":
            return self.layer(points[points[..., 0] > 0][: len(points)])
        if self.how == "host":
            return self.layer(points.cpu().to(points.device).amax(dim=1))
        return self.layer(points.amax(dim=1))


value, place, host, never = (
    functools.partial(Waiting, how=how) for how in ("value", "place", "host", "never")
)
