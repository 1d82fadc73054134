"""The folded edge layer against the plain one: values, gradients, running statistics."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from baselines.chunks import chunks
from baselines.points import gather
from papnet.steered import edge_layer
from papnet.steered.edge_layer import EdgeLayer, collect_edges

CLOUDS, POINTS, NEIGHBOURS, INPUTS, FEATURES, OUTPUTS = 3, 50, 9, 6, 5, 8


def plain(layer: EdgeLayer, x: Tensor, index: Tensor, features: Tensor, penalty: Tensor) -> Tensor:
    """The layer as it is written, every edge kept."""
    here, there = layer.ends(x).chunk(2, dim=-1)
    y = layer.linear(features) + gather(there, index) + here[:, :, None]
    y = layer.norm(y.flatten(0, 2)).view_as(y) - penalty[..., None]
    return F.relu(y.amax(2))


@pytest.fixture
def inputs() -> tuple[Tensor, ...]:
    generator = torch.Generator().manual_seed(2)
    index = torch.randint(POINTS, (CLOUDS, POINTS, NEIGHBOURS), generator=generator)
    x = torch.randn(CLOUDS, POINTS, INPUTS, generator=generator, dtype=torch.float64)
    # Off centre, and larger where a point is looked at often: the cross terms must matter.
    features = torch.randn(*index.shape, FEATURES, generator=generator, dtype=torch.float64) + 3
    features = features + gather(x, index)[..., :FEATURES] + x[:, :, None, :FEATURES]
    penalty = torch.rand(*index.shape, generator=generator, dtype=torch.float64)
    return x, index, features, penalty


def layer_of(negative: bool) -> EdgeLayer:
    torch.manual_seed(0)
    layer = EdgeLayer(INPUTS, FEATURES, OUTPUTS).double()
    with torch.no_grad():
        layer.norm.bias.normal_()
        if negative:
            layer.norm.weight.copy_(torch.linspace(-2, 2, OUTPUTS))
    return layer


@pytest.mark.parametrize("negative", [False, True], ids=["scales above 0", "of either sign"])
@pytest.mark.parametrize("step", [1 << 20, 7 * NEIGHBOURS * OUTPUTS], ids=["at once", "in parts"])
def test_training_is_that_of_the_plain_layer(
    inputs: tuple[Tensor, ...], negative: bool, step: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("baselines.chunks.CHUNK", step)
    parts = len(edge_layer.chunks(CLOUDS * POINTS, NEIGHBOURS * OUTPUTS, torch.device("cpu")))
    assert edge_layer.chunks is chunks
    assert (parts > 1) == (step < 1 << 20)
    x, index, features, penalty = inputs
    weight = torch.randn(CLOUDS, POINTS, OUTPUTS, dtype=torch.float64)
    results = []
    for folded in (False, True):
        layer, given = layer_of(negative), x.clone().requires_grad_()
        for _ in range(2):
            if folded:
                edges = collect_edges(index, features, penalty, moments=True)
                y = layer(given, edges)
            else:
                y = plain(layer, given, index, features, penalty)
        (y * weight).sum().backward()
        gradients = [given.grad, *(p.grad for p in layer.parameters())]
        results.append([y, *gradients, *layer.buffers()])
    assert (results[0][0] > 0).float().mean() > 0.3, "a dead layer would show nothing"
    torch.testing.assert_close(results[1], results[0], atol=1e-10, rtol=1e-9)


def test_evaluation_is_that_of_the_plain_layer(inputs: tuple[Tensor, ...]) -> None:
    x, index, features, penalty = inputs
    layer = layer_of(negative=True)
    plain(layer, x, index, features, penalty)
    layer.eval()
    edges = collect_edges(index, features, penalty, moments=False)
    assert edges.ending is None
    torch.testing.assert_close(layer(x, edges), plain(layer, x, index, features, penalty))


def test_a_penalised_neighbour_is_not_chosen(inputs: tuple[Tensor, ...]) -> None:
    x, index, features, penalty = inputs
    layer = layer_of(negative=False).eval()
    barred = penalty.clone()
    barred[..., 1:] = 1e4
    first_only = collect_edges(index[..., :1], features[..., :1, :], penalty[..., :1], False)
    torch.testing.assert_close(
        layer(x, collect_edges(index, features, barred, False)), layer(x, first_only)
    )
