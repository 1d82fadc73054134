"""No model's training step waits for the device it runs on."""

from __future__ import annotations

import pytest
import torch

from benchmarks import host_sync
from partialbench import registry


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(registry.cards()))
def test_no_model_waits(name: str) -> None:
    assert host_sync.first_wait(name) is None


class Waiting(torch.nn.Module):
    """Asks for a value, for a place or for a tensor on the host."""

    def __init__(self, how: str) -> None:
        super().__init__()
        self.how, self.layer = how, torch.nn.Linear(3, host_sync.NUM_CLASSES)

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        if self.how == "value" and float(points.sum()) > 0:
            return self.layer(points[:, 0])
        if self.how == "place":
            return self.layer(points[points[..., 0] > 0][: len(points)])
        if self.how == "host":
            return self.layer(points.cpu().to(points.device).amax(dim=1))
        return self.layer(points.amax(dim=1))


@pytest.mark.parametrize("how", ["value", "place", "host"])
def test_what_waits_is_found(how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "create", lambda name, classes: Waiting(how))
    found = host_sync.first_wait("waiting")
    assert found is not None
    assert "test_host_sync.py" in found


def test_a_model_that_does_not_wait_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "create", lambda name, classes: Waiting("not"))
    assert host_sync.first_wait("waiting") is None
