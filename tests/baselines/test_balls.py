"""Balls without their padding: the same entries, counted as often."""

from __future__ import annotations

import pytest
import torch

from baselines.balls import LENGTHS, _padded, without_padding
from baselines.points import _first_ranked, ball_query, distances, flat_index
from baselines.shared_mlp import SharedMLP


def entries(index: torch.Tensor, number: int) -> list[dict[int, int]]:
    """How often each ball of the padded index holds each point."""
    flat = flat_index(index, number).flatten(0, 1)
    return [{int(p): int((ball == p).sum()) for p in ball.unique()} for ball in flat]


@pytest.mark.parametrize("nearest", [False, True])
@pytest.mark.parametrize("count", [7, 32, 128])
def test_every_entry_counts_as_often_as_it_was_padded(count: int, nearest: bool) -> None:
    points = torch.rand(3, 50, 3)
    index = ball_query(points[:, :20], points, 0.4, count, nearest)
    balls = without_padding(index, 50)
    expected = entries(index, 50)
    found: list[dict[int, int]] = [{} for _ in expected]
    for point, centre, weight in zip(balls.point, balls.centre, balls.weight, strict=True):
        if weight:
            assert int(point) not in found[centre]
            found[centre][int(point)] = int(weight)
    assert found == expected
    assert sum(n * length for n, length in balls.blocks) == len(balls.point)
    assert len(balls.blocks) <= LENGTHS


@pytest.mark.parametrize("count", [7, 80])
def test_balls_as_other_devices_find_them_are_the_same(count: int) -> None:
    points = torch.rand(3, 50, 3)
    index = ball_query(points[:, :20], points, 0.4, count)
    inside = distances(points[:, :20], points) <= 0.4
    assert torch.equal(_first_ranked(inside, count, 0.4), index)
    balls = _padded(index, flat_index(index, 50).flatten(0, 1))
    found: list[dict[int, int]] = [{} for _ in range(60)]
    for point, centre, weight in zip(balls.point, balls.centre, balls.weight, strict=True):
        if weight:
            assert int(point) not in found[centre]
            found[centre][int(point)] = int(weight)
    assert found == entries(index, 50)
    assert balls.blocks == ((60, count),)


def test_full_balls_are_one_block_and_rows_are_never_more_than_padded() -> None:
    index = torch.arange(8).expand(2, 5, 8)
    balls = without_padding(index, 8)
    assert balls.blocks == ((10, 8),)
    assert bool((balls.weight == 1).all())
    lone = without_padding(torch.full((1, 4, 32), 3), 8)
    assert lone.blocks == ((4, 2),)
    assert lone.weight.view(4, 2).tolist() == [[32, 0]] * 4


@pytest.mark.parametrize("width", [8, 20], ids=["by covariances", "from the rows"])
def test_layers_see_what_they_would_see_of_the_padded_balls(width: int) -> None:
    """Values, gradients and running statistics, in double precision."""
    torch.manual_seed(0)
    points = torch.rand(2, 60, 3, dtype=torch.float64)
    features = torch.randn(120, 5, dtype=torch.float64)
    index = ball_query(points[:, :25], points, 0.3, 24)
    balls = without_padding(index, 60)
    padded = flat_index(index, 60).flatten(0, 1)
    results = []
    for dense in (True, False):
        torch.manual_seed(1)
        mlp, x = SharedMLP(5, width, 8, 6).double(), features.clone().requires_grad_()
        y = mlp.max(x[padded]) if dense else mlp.max_in_balls(x[balls.point], balls)
        (y * torch.linspace(-1, 1, 6, dtype=y.dtype)).sum().backward()
        statistics = [b.double() for b in mlp.buffers()]
        results.append([y, x.grad, *(p.grad for p in mlp.parameters()), *statistics])
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b, atol=1e-9, rtol=1e-9)
