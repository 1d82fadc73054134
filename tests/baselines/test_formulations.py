"""Whole networks equal their straightforward published formulation, training included.

In double precision, so that no near tie between two neighbours or two maxima hides an error.

The formulations are those the benchmark measures against: every edge made before its layer, batch
norm on all of them, channels first.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
import torch
from torch import Tensor, nn

from baselines.pointnet2 import SetAbstraction
from baselines.points import normalise
from partialbench import registry

FORMULATIONS = Path(__file__).parents[2] / "benchmarks" / "reference_points.py"


@pytest.fixture(scope="module")
def formulations() -> ModuleType:
    spec = importlib.util.spec_from_file_location("reference_points", FORMULATIONS)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def in_published_order(module: nn.Module) -> Iterator[nn.Module]:
    """The layers that have parameters, each scale's first layer before its others."""
    if isinstance(module, SetAbstraction):
        for first, rest in zip(module.first, module.rest, strict=True):
            yield from in_published_order(first)
            yield from in_published_order(rest)
    elif isinstance(module, nn.Linear | nn.Conv1d | nn.Conv2d | nn.modules.batchnorm._BatchNorm):
        yield module
    else:
        for child in module.children():
            yield from in_published_order(child)


def without_dropout(model: nn.Module) -> nn.Module:
    for module in model.modules():
        if isinstance(module, nn.Dropout):
            module.p = 0.0
    return model


@pytest.mark.parametrize(
    "name",
    [
        "pointnet",
        "dgcnn",
        "pointnet2-ssg",
        pytest.param("pointnet2-msg", marks=pytest.mark.slow),
        "tnet-pointnet2",
        "itnet-pointnet2",
    ],
)
def test_training_and_evaluation_agree(name: str, formulations: ModuleType) -> None:
    """Logits in training and then in evaluation, every gradient, and running statistics."""
    torch.manual_seed(0)
    ours = without_dropout(registry.create(name, 10)).double()
    theirs = without_dropout(formulations.REFERENCES[name](10)).double()
    with torch.no_grad():
        for parameter in ours.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
    pairs = list(zip(in_published_order(ours), in_published_order(theirs), strict=True))
    for mine, yours in pairs:
        shapes = {k: v.shape for k, v in yours.state_dict().items()}
        yours.load_state_dict({k: v.view(shapes[k]) for k, v in mine.state_dict().items()})
    points = torch.randn(3, 1024, 3) * torch.rand(3, 1, 3) + torch.tensor([0, 0, 3.0])
    points = normalise(points.double())

    def logits(model: nn.Module) -> Tensor:
        out = model(points)
        return out if isinstance(out, Tensor) else out.class_logits

    a, b = logits(ours), logits(theirs)
    assert float((b - b.roll(1, dims=0)).abs().max()) > 0.1 * float(b.abs().max())
    torch.testing.assert_close(a, b, atol=1e-8, rtol=1e-8)
    for out in (a, b):
        nn.functional.cross_entropy(out, torch.arange(3)).backward()
    for mine, yours in pairs:
        expected = dict(yours.named_parameters())
        for key, parameter in mine.named_parameters():
            assert parameter.grad is not None
            gradient = expected[key].grad
            assert gradient is not None
            gradient = gradient.view_as(parameter)
            torch.testing.assert_close(parameter.grad, gradient, atol=1e-7, rtol=1e-7)
        for key, buffer in mine.named_buffers():
            expected_buffer = dict(yours.named_buffers())[key]
            torch.testing.assert_close(buffer, expected_buffer, atol=1e-9, rtol=1e-9)
    with torch.no_grad():
        torch.testing.assert_close(logits(ours.eval()), logits(theirs.eval()), atol=1e-8, rtol=1e-8)
