"""The sparse first layer is the dense one, value and gradient."""

from __future__ import annotations

import pytest
import torch

from baselines.steerable import Fields, GatedBlock
from baselines.voxels import occupancy
from papnet.first_layer import pooled_first_layer
from papnet.parts import pool


@pytest.mark.parametrize("training", [True, False])
def test_equals_the_dense_layer(training: bool) -> None:
    torch.manual_seed(0)
    sparse = GatedBlock(Fields((1,)), Fields((2, 1, 1)), 3, padding=1).train(training).double()
    with torch.no_grad():
        for parameter in sparse.parameters():
            parameter.normal_()
    dense = GatedBlock(Fields((1,)), Fields((2, 1, 1)), 3, padding=1).train(training).double()
    dense.load_state_dict(sparse.state_dict())
    # Clouds of different size, one of them in the corners, where the padding is.
    points = 2 * torch.rand(3, 20, 3) - 1
    points[1] = points[1].sign() * 0.99
    points[2] *= 0.1
    volume = occupancy(points, 16).double()
    a, b = pooled_first_layer(sparse, volume), pool(dense(volume))
    assert torch.allclose(a, b, atol=1e-12)
    weight = torch.rand_like(a)
    (a * weight).sum().backward()
    (b * weight).sum().backward()
    for one, other in zip(sparse.parameters(), dense.parameters(), strict=True):
        assert torch.allclose(one.grad, other.grad, atol=1e-9)
    for one, other in zip(sparse.buffers(), dense.buffers(), strict=True):
        assert torch.allclose(one, other)


def test_an_empty_volume_gives_the_background() -> None:
    block = GatedBlock(Fields((1,)), Fields((2, 1)), 3, padding=1).eval()
    volume = torch.zeros(1, 1, 8, 8, 8)
    assert torch.allclose(pooled_first_layer(block, volume), pool(block(volume)), atol=1e-7)


@pytest.mark.parametrize("edge", [4, 16], ids=["every voxel", "some voxels"])
def test_rows_for_all_that_points_could_reach_change_nothing(edge: int) -> None:
    torch.manual_seed(0)
    block = GatedBlock(Fields((1,)), Fields((2, 1, 1)), 3, padding=1).double()
    volume = occupancy(2 * torch.rand(3, 20, 3) - 1, edge).double()
    expected, found = (pooled_first_layer(block, volume, points) for points in (None, 20))
    torch.testing.assert_close(found, expected)
    weight = torch.rand_like(expected)
    parameters = [p for p in block.parameters() if p.numel()]
    gradients = [torch.autograd.grad((y * weight).sum(), parameters) for y in (expected, found)]
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other)
