"""Muon against torch's own, and against AdamW for what is no matrix."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from torch import nn

from partialbench.benchmark.training.muon import RMS, Muon, orthogonalised
from partialbench.benchmark.training.optimizers import make_optimizer
from partialbench.registry import Recipe


def steps(parameter: nn.Parameter, optimizer: torch.optim.Optimizer, count: int = 20) -> None:
    generator = torch.Generator().manual_seed(3)
    for _ in range(count):
        parameter.grad = torch.randn(parameter.shape, generator=generator, dtype=parameter.dtype)
        optimizer.step()


@pytest.mark.parametrize("shape", [(8, 8), (5, 40), (40, 5), (1, 7)])
def test_singular_values_become_about_one_and_vectors_stay(shape: tuple[int, int]) -> None:
    torch.manual_seed(0)
    matrix = torch.randn(shape, dtype=torch.float64)
    U, S, V = torch.linalg.svd(matrix, full_matrices=False)
    found = U.mT @ orthogonalised(matrix) @ V.mT
    torch.testing.assert_close(found, torch.diag(found.diagonal()), atol=1e-9, rtol=0)
    # The polynomial lifts a value to one only within its reach: 0.03 of the norm and more.
    reached = S / S.norm() > 0.03
    assert found.diagonal()[reached].min() > 0.6
    assert found.diagonal().max() < 1.3


@pytest.mark.skipif(not hasattr(torch.optim, "Muon"), reason="torch.optim.Muon is torch 2.9's")
@pytest.mark.parametrize("shape", [(6, 30), (30, 6)])
def test_matrices_move_as_with_torchs_muon(shape: tuple[int, int]) -> None:
    torch.manual_seed(1)
    start = torch.randn(shape)
    ours, theirs = nn.Parameter(start.clone()), nn.Parameter(start.clone())
    steps(ours, Muon([ours], 0.01, 0.1))
    steps(theirs, torch.optim.Muon([theirs], 0.01, 0.1, adjust_lr_fn="match_rms_adamw"))
    moved = (theirs - start).norm()
    assert moved > 0.3
    # Theirs orthogonalises in bfloat16.
    assert (ours - theirs).norm() < 0.02 * moved


def test_all_else_moves_as_with_adamw() -> None:
    torch.manual_seed(2)
    start = torch.randn(9, dtype=torch.float64)
    ours, theirs = nn.Parameter(start.clone()), nn.Parameter(start.clone())
    steps(ours, Muon([ours], 0.01, 0.1))
    steps(theirs, torch.optim.AdamW([theirs], 0.01, weight_decay=0.1))
    assert (ours - start).norm() > 0.1
    torch.testing.assert_close(ours, theirs, atol=1e-12, rtol=0)


def test_a_kernel_is_the_matrix_of_its_flattened_inputs() -> None:
    torch.manual_seed(4)
    start = torch.randn(6, 3, 2, 2)
    kernel, matrix = nn.Parameter(start.clone()), nn.Parameter(start.flatten(1).clone())
    steps(kernel, Muon([kernel], 0.01))
    steps(matrix, Muon([matrix], 0.01))
    assert torch.equal(kernel.flatten(1), matrix)


def test_a_step_has_the_size_of_adamws() -> None:
    parameter = nn.Parameter(torch.zeros(64, 256))
    optimizer = make_optimizer(nn.ParameterList([parameter]), Recipe(optimizer="muon", lr=0.5))
    steps(parameter, optimizer, 1)
    size = parameter.square().mean().sqrt().item() / 0.5
    assert size == pytest.approx(RMS, rel=0.25)
    assert math.isfinite(size)


def test_a_saved_state_continues_exactly() -> None:
    torch.manual_seed(5)
    model = nn.Linear(4, 3)
    optimizer = make_optimizer(model, Recipe(optimizer="muon", lr=0.01, weight_decay=0.01))
    clouds = torch.randn(8, 4)

    def train(model: nn.Module, optimizer: torch.optim.Optimizer) -> None:
        optimizer.zero_grad()
        model(clouds).square().sum().backward()
        optimizer.step()

    train(model, optimizer)
    other = copy.deepcopy(model)
    again = make_optimizer(other, Recipe(optimizer="muon", lr=0.01, weight_decay=0.01))
    again.load_state_dict(copy.deepcopy(optimizer.state_dict()))
    train(model, optimizer)
    train(other, again)
    for a, b in zip(model.parameters(), other.parameters(), strict=True):
        assert torch.equal(a, b)


def test_a_parameter_without_gradient_stays() -> None:
    used, unused = nn.Parameter(torch.ones(2, 2)), nn.Parameter(torch.ones(3))
    optimizer = Muon([used, unused], 0.1, 0.1)
    used.grad = torch.eye(2)
    assert optimizer.step(lambda: 1.5) == 1.5
    assert not torch.equal(used, torch.ones(2, 2))
    assert torch.equal(unused, torch.ones(3))
