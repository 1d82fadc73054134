"""View, sphere and voxel models equal the formulations they are measured against."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest
import torch
from torch import nn

from papnet.model import PAPNet
from partialbench import registry
from partialbench.benchmark.prediction import Batch

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


def formulations(stem: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(stem, BENCHMARKS / f"{stem}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def compare_gradients(a: nn.Module, b: nn.Module, tolerance: float) -> None:
    expected = dict(b.named_parameters())
    for name, parameter in a.named_parameters():
        # The floor is for biases that a following batch norm cancels: theirs is rounding only.
        gradient = expected[name].grad
        assert parameter.grad is not None
        assert gradient is not None
        if not gradient.numel():
            continue
        worst = (parameter.grad - gradient).abs().max()
        assert worst <= tolerance * gradient.abs().max().clamp_min(1e-2), name


@pytest.mark.parametrize(
    ("stem", "name"),
    [
        ("reference_views", "simpleview"),
        ("reference_views", "spherical-cnn"),
        pytest.param("reference_volumes", "steerable-cnn", marks=pytest.mark.slow),
    ],
)
def test_logits_and_gradients_agree(stem: str, name: str) -> None:
    torch.manual_seed(0)
    ours = registry.create(name, 10)
    theirs = formulations(stem).REFERENCES[name](10)
    for model in (ours, theirs):
        for module in model.modules():
            if isinstance(module, nn.Dropout):
                module.p = 0.0
    theirs.load_state_dict(ours.state_dict())
    if name == "simpleview":
        # Its other memory layout sums in another order, which a batch norm over three clouds blows
        # up; the formulation is what is compared here.
        theirs.trunk.to(memory_format=torch.channels_last)
    points = torch.randn(3, 300, 3) * torch.rand(3, 1, 3)
    for model in (ours, theirs):
        out = model.train()(points).class_logits
        nn.functional.cross_entropy(out, torch.arange(3)).backward()
    compare_gradients(ours, theirs, 2e-3)
    with torch.no_grad():
        a, b = (model.eval()(points).class_logits for model in (ours, theirs))
    assert (a[0] - a[1]).abs().max() > 1e-3
    assert (a - b).abs().max() < 1e-4


def test_papnet_agrees_with_the_formulation_of_the_release() -> None:
    torch.manual_seed(0)
    volumes = formulations("reference_volumes")
    ours = PAPNet(10, k=4, grid=32)
    theirs = volumes.released_papnet(10)
    theirs.k, theirs.grid = 4, 32
    theirs.load_state_dict(ours.state_dict())
    points = torch.randn(4, 200, 3) * torch.rand(4, 1, 3)
    R = torch.linalg.qr(torch.randn(4, 3, 3)).Q
    R = R * torch.linalg.det(R)[:, None, None]
    for model in (ours, theirs):
        torch.manual_seed(1)  # the noise on the pose
        loss = model.train().training_loss(Batch(points, torch.arange(4), R, R))
        loss.backward()
    compare_gradients(ours, theirs, 2e-3)
    with torch.no_grad():
        a, b = (model.eval()(points) for model in (ours, theirs))
    assert (a.class_logits - b.class_logits).abs().max() < 1e-5
    assert a.pose_logits is not None
    assert b.pose_logits is not None
    assert (a.pose_logits - b.pose_logits).abs().max() < 1e-5
