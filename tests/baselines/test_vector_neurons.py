"""Vector-neuron layers equal their definition on every edge, gradients and statistics included."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from baselines.points import gather, knn
from baselines.vector_neurons import (
    EPS,
    Edges,
    VectorBatchNorm,
    VectorEdgeConv,
    VectorFrame,
    VectorReLU,
    as_vectors,
    in_frame,
    position_edges,
)
from partialbench.geometry.rotations import haar_rotations


def by_definition(layer: VectorReLU, v: Tensor, norm: nn.BatchNorm1d) -> Tensor:
    """(…,3,C) → (…,3,C_out), as published: p = BN(W·v), d = U·v, the leaky mean of both cases."""
    q, d = layer.linear(v), layer.direction(v)
    n = q.norm(dim=-2) + EPS
    p = q / n[..., None, :] * norm(n.flatten(0, -2)).view_as(n)[..., None, :]
    dot = (p * d).sum(dim=-2, keepdim=True)
    square = d.square().sum(dim=-2, keepdim=True)
    turned = torch.where(dot >= 0, p, p - dot / (square + EPS) * d)
    return layer.slope * p + (1 - layer.slope) * turned


def features(channels: int) -> Tensor:
    return torch.randn(2, 30, 3, channels, dtype=torch.float64)


def agree(layer: VectorReLU, ours: Tensor, theirs: Tensor, inputs: list[Tensor]) -> None:
    torch.testing.assert_close(ours, theirs)
    weights = torch.randn_like(ours)
    wanted = [*inputs, layer.linear.weight, layer.direction.weight, *layer.norm.parameters()]
    a = torch.autograd.grad((ours * weights).sum(), wanted)
    b = torch.autograd.grad((theirs * weights).sum(), wanted)
    for mine, expected in zip(a, b, strict=True):
        assert expected.any()
        torch.testing.assert_close(mine, expected)


def twin(layer: VectorReLU) -> nn.BatchNorm1d:
    """Another norm of the same affine parameters, so that each moves its own statistics."""
    with torch.no_grad():
        layer.norm.weight.uniform_(-1, 1)  # a negative scale turns vectors round
        layer.norm.bias.normal_()
    norm = nn.BatchNorm1d(layer.norm.num_features).double()
    norm.weight, norm.bias = layer.norm.weight, layer.norm.bias
    return norm.train(layer.training)


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("shared", [False, True])
def test_a_layer_of_points_is_as_defined(training: bool, shared: bool) -> None:
    layer = VectorReLU(9, 6, 0.2, shared).double().train(training)
    norm = twin(layer)
    v, context = features(5).requires_grad_(), features(4)[:, :1].requires_grad_()
    theirs = by_definition(layer, torch.cat([v, context.expand(-1, 30, -1, -1)], dim=-1), norm)
    ours = layer(v.permute(2, 0, 1, 3), context.permute(2, 0, 1, 3)).permute(1, 2, 0, 3)
    agree(layer, ours, theirs, [v, context])
    torch.testing.assert_close(layer.norm.running_mean, norm.running_mean)
    torch.testing.assert_close(layer.norm.running_var, norm.running_var)


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize(("positions", "cross"), [(False, False), (True, False), (True, True)])
def test_a_layer_of_edges_is_as_defined(training: bool, positions: bool, cross: bool) -> None:
    channels = 1 if positions else 4
    layer = VectorEdgeConv(channels, 6, 0.0, cross).double().train(training)
    norm = twin(layer)
    v = features(channels)
    index = knn(v.flatten(2), 7)
    edges = position_edges(v[..., 0], index, cross) if positions else Edges(index)
    v.requires_grad_(not positions)
    neighbour = gather(v.flatten(2), index).unflatten(-1, v.shape[2:])
    centre = v[:, :, None].expand_as(neighbour)
    parts = [neighbour - centre, centre]
    parts += [torch.linalg.cross(neighbour, centre, dim=-2)] if cross else []
    theirs = by_definition(layer, torch.cat(parts, dim=-1), norm).mean(dim=2)
    ours = layer(v.permute(2, 0, 1, 3), edges).permute(1, 2, 0, 3)
    agree(layer, ours, theirs, [] if positions else [v])
    torch.testing.assert_close(layer.norm.running_mean, norm.running_mean)
    torch.testing.assert_close(layer.norm.running_var, norm.running_var)


def test_chunks_make_no_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    layer = VectorEdgeConv(1, 6, 0.2, cross=True).double()
    points = features(1)[..., 0]
    edges = position_edges(points, knn(points, 7), cross=True)
    whole = layer(as_vectors(points), edges)
    whole.square().sum().backward()
    gradient = layer.linear.weight.grad
    layer.zero_grad()
    monkeypatch.setattr("baselines.chunks.CHUNK", 8 * 3 * 7 * 6 * 4)
    parts = layer(as_vectors(points), edges)
    parts.square().sum().backward()
    torch.testing.assert_close(parts, whole)
    assert gradient is not None
    torch.testing.assert_close(layer.linear.weight.grad, gradient)


def test_vectors_turn_and_their_products_do_not(rng: np.random.Generator) -> None:
    torch.set_default_dtype(torch.float64)
    try:
        conv, norm = VectorEdgeConv(1, 8, 0.0, cross=True), VectorBatchNorm(8)
        frame = VectorFrame(16, 0.2)
    finally:
        torch.set_default_dtype(torch.float32)
    points = features(1)[..., 0]
    R = torch.from_numpy(haar_rotations(rng, 1)[0])
    results = []
    for p in (points, points @ R.T):
        v = norm(conv(as_vectors(p), position_edges(p, knn(p, 7), cross=True)))
        mean = v.mean(dim=2, keepdim=True)
        f = frame(v, mean)
        results.append((v, f, in_frame(v, f)))
    (v, f, products), (v_turned, f_turned, same) = results
    torch.testing.assert_close(torch.einsum("ij,jbnc->ibnc", R, v), v_turned)
    torch.testing.assert_close(torch.einsum("ij,jbnc->ibnc", R, f), f_turned)
    torch.testing.assert_close(same, products)
    expected = torch.einsum("abnc,abni->bnci", v, f).flatten(2)
    torch.testing.assert_close(products, expected)


def test_vectors_of_no_length_have_finite_gradients() -> None:
    """Repeated points make edges of no length; their norm has no slope."""
    points = torch.zeros(1, 12, 3)
    points[:, 6:] = torch.randn(1, 6, 3)
    conv, norm = VectorEdgeConv(1, 4, 0.0, cross=True), VectorBatchNorm(4)
    out = norm(conv(as_vectors(points), position_edges(points, knn(points, 5), cross=True)))
    out.square().sum().backward()
    for parameter in conv.parameters():
        assert parameter.grad is not None
        assert parameter.grad.isfinite().all()
