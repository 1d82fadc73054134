"""Voxelisation by hand, and the steerable CNN's published size."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from baselines.steerable import spectral
from baselines.steerable_cnn import SteerableCNN
from baselines.voxels import low_pass, occupancy


def test_occupancy_marks_the_voxel_of_each_point_and_leaves_out_the_rest() -> None:
    points = torch.tensor(
        [[[-1.0, -1.0, -1.0], [0.0, 0.49, -0.01], [0.0, 0.4, -0.02], [1.0, 0.0, 0.0]]]
    )
    grid = occupancy(points, 4)
    assert grid.shape == (1, 1, 4, 4, 4)
    # Cells of edge ½: 0 → index 2, 0.49 → 2, −0.01 → 1; x = 1 is outside.
    assert grid[0, 0].nonzero().tolist() == [[0, 0, 0], [2, 2, 1]]
    assert grid.sum() == 2


def test_low_pass_is_a_truncated_gaussian() -> None:
    volume = torch.rand(2, 1, 9, 8, 7, dtype=torch.float64)
    expected = [gaussian_filter(v, 0.9, mode="constant", radius=2) for v in volume[:, 0].numpy()]
    assert np.abs(low_pass(volume, 0.9, 2)[:, 0].numpy() - np.stack(expected)).max() < 1e-12


@pytest.mark.parametrize(("classes", "count"), [(55, 142_617), (40, 134_922), (15, 122_097)])
def test_parameter_count(classes: int, count: int) -> None:
    assert sum(p.numel() for p in SteerableCNN(classes).parameters()) == count


def test_volumes_have_the_published_edges() -> None:
    model = SteerableCNN(10).eval()
    edges = []
    for block in model.trunk:
        block.register_forward_hook(lambda _module, _input, out: edges.append(out.shape[-1]))
    with torch.no_grad():
        assert model(torch.randn(1, 100, 3)).class_logits.shape == (1, 10)
    assert edges == [34, 38, 21, 25, 15, 19, 12, 16]


def test_a_model_trains_after_another_was_evaluated() -> None:
    """What the first keeps for later volumes is no inference tensor, which autograd refuses."""
    spectral._stages.cache_clear()
    points, label = torch.randn(16, 50, 3), torch.arange(16) % 4
    evaluated, model = SteerableCNN(4, grid=8).eval(), SteerableCNN(4, grid=8).train()
    with torch.inference_mode():
        evaluated(points)
    assert spectral._stages.cache_info().currsize, "the case this is about"
    torch.nn.functional.cross_entropy(model(points).class_logits, label).backward()
    assert all(p.grad is not None for p in model.parameters())


@pytest.mark.slow
def test_four_clouds_are_overfitted() -> None:
    torch.manual_seed(0)
    model, label = SteerableCNN(4, grid=8), torch.arange(4)
    points = torch.randn(4, 100, 3) * torch.rand(4, 1, 3)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)
    for _ in range(60):
        loss = torch.nn.functional.cross_entropy(model.train()(points).class_logits, label)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    for module in model.modules():
        if hasattr(module, "momentum"):
            module.momentum = 1.0  # the running statistics become those of the next batch
    with torch.no_grad():
        model.train()(points)
        assert model.eval()(points).class_logits.argmax(1).tolist() == label.tolist()
