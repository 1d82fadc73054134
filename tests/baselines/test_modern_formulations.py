"""The modern networks equal their published formulation, training included.

In double precision, so that no near tie between two neighbours or two maxima hides an error.
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import cast

import pytest
import torch
from torch import Tensor, nn

from baselines.points import normalise
from partialbench import registry

FOLDER = Path(__file__).parents[2] / "benchmarks"
NAMES = {
    "vn-pointnet": "reference_invariant",
    "vn-dgcnn": "reference_invariant",
    "pointmlp-elite": "reference_backbones",
    "pointnext-s": "reference_backbones",
    "pct": "reference_backbones",
}
"""And the file of each one's formulation."""


@functools.cache
def formulations(stem: str) -> dict[str, Callable[[int], nn.Module]]:
    spec = importlib.util.spec_from_file_location(stem, FOLDER / f"{stem}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return cast(dict[str, Callable[[int], nn.Module]], module.REFERENCES)


def layers(model: nn.Module) -> list[nn.Module]:
    """Those that have parameters of their own, in the order both name them in."""
    return [m for m in model.modules() if any(True for _ in m.parameters(recurse=False))]


def without_dropout(model: nn.Module) -> nn.Module:
    for module in model.modules():
        if isinstance(module, nn.Dropout):
            module.p = 0.0
    return model


@pytest.mark.parametrize("name", NAMES)
def test_training_and_evaluation_agree(name: str) -> None:
    """Logits in training and then in evaluation, every gradient, and running statistics."""
    torch.manual_seed(0)
    options = dict(registry.card(name).published_options)
    if "quirks" in options:  # the formulations sample small clouds as the rows do
        options["quirks"] = options["quirks"].removesuffix("+counts")
    ours = without_dropout(registry.create(name, 10, **options)).double()
    theirs = without_dropout(formulations(NAMES[name])[name](10)).double()
    with torch.no_grad():
        for parameter in ours.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
    pairs = list(zip(layers(ours), layers(theirs), strict=True))
    for mine, yours in pairs:
        shapes = {k: v.shape for k, v in yours.state_dict().items()}
        yours.load_state_dict({k: v.view(shapes[k]) for k, v in mine.state_dict().items()})
    points = torch.randn(3, 256, 3) * torch.rand(3, 1, 3) + torch.tensor([0, 0, 3.0])
    points = normalise(points.double(), radius=1.0)

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
            gradient = expected[key].grad
            assert gradient is not None
            torch.testing.assert_close(
                parameter.grad, gradient.view_as(parameter), atol=1e-7, rtol=1e-7
            )
        for key, buffer in mine.named_buffers():
            expected_buffer = dict(yours.named_buffers())[key]
            torch.testing.assert_close(buffer, expected_buffer, atol=1e-9, rtol=1e-9)
    with torch.no_grad():
        torch.testing.assert_close(logits(ours.eval()), logits(theirs.eval()), atol=1e-8, rtol=1e-8)
