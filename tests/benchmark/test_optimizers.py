"""Optimisers take the steps that torch's plain ones take, and go on from their states."""

from __future__ import annotations

import copy
import dataclasses

import pytest
import torch
from torch import nn

from partialbench.benchmark.training.optimizers import as_made, make_optimizer
from partialbench.registry import Recipe


def recipe(name: str) -> Recipe:
    return dataclasses.replace(Recipe(), optimizer=name, lr=0.01, weight_decay=0.1)


def steps(model: nn.Module, optimizer: torch.optim.Optimizer, seed: int, count: int = 3) -> None:
    generator = torch.Generator().manual_seed(seed)
    for _ in range(count):
        optimizer.zero_grad(set_to_none=True)
        x = torch.randn(8, 3, 6, 6, generator=generator)
        model(x).square().mean().backward()
        optimizer.step()


def convolution() -> nn.Module:
    torch.manual_seed(0)
    model = nn.Sequential(nn.Conv2d(3, 5, 3), nn.ReLU(), nn.Conv2d(5, 4, 3))
    return model.to(memory_format=torch.channels_last)


@pytest.mark.parametrize("name", ["adam", "adamw"])
def test_a_plain_state_is_gone_on_with(name: str) -> None:
    plain, ours = convolution(), convolution()
    kind = torch.optim.Adam if name == "adam" else torch.optim.AdamW
    reference = kind(plain.parameters(), lr=0.01, weight_decay=0.1)
    steps(plain, reference, seed=1)
    optimizer = make_optimizer(ours, recipe(name))
    ours.load_state_dict(plain.state_dict())
    optimizer.load_state_dict(as_made(copy.deepcopy(reference.state_dict()), optimizer))
    assert all(group["fused"] for group in optimizer.param_groups)
    steps(plain, reference, seed=2)
    steps(ours, optimizer, seed=2)
    for a, b in zip(plain.parameters(), ours.parameters(), strict=True):
        torch.testing.assert_close(a, b, atol=1e-6, rtol=1e-5)


def test_complex_weights_are_optimised_too() -> None:
    model = nn.Linear(3, 2, dtype=torch.complex64)
    before = model.weight.detach().clone()
    optimizer = make_optimizer(model, recipe("adamw"))
    model(torch.ones(1, 3, dtype=torch.complex64)).abs().sum().backward()
    optimizer.step()
    assert not torch.equal(before, model.weight)
