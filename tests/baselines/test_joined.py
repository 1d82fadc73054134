"""The maximum over joined edge and point channels equals its definition, training included."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from baselines.joined import JoinedMax
from baselines.points import gather, knn


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("about_centres", [False, True])
def test_it_is_as_defined(training: bool, about_centres: bool) -> None:
    width = 5 if about_centres else 4
    layer = JoinedMax(5, width, 7).double().train(training)
    with torch.no_grad():
        layer.norm.weight.uniform_(-1, 1)
        layer.norm.bias.normal_()
    norm = nn.BatchNorm1d(7).double().train(training)
    norm.weight, norm.bias = layer.norm.weight, layer.norm.bias
    f = torch.randn(2, 20, width, dtype=torch.float64, requires_grad=True)
    edges = torch.randn(2, 20, 6, 5, dtype=torch.float64, requires_grad=True)
    index = knn(f.detach(), 6)
    if about_centres:
        centre = f[:, :, None].expand(-1, -1, 6, -1)
        joined, ours = torch.cat([edges - centre, centre], dim=-1), layer.about_centres(edges, f)
    else:
        joined, ours = torch.cat([edges, gather(f, index)], dim=-1), layer(edges, f, index)
    y = norm(layer.linear(joined).flatten(0, 2)).unflatten(0, (2, 20, 6))
    theirs = y.amax(dim=2)
    torch.testing.assert_close(ours, theirs)
    weights = torch.randn_like(ours)
    wanted = [f, edges, layer.linear.weight, layer.norm.weight, layer.norm.bias]
    a = torch.autograd.grad((ours * weights).sum(), wanted)
    b = torch.autograd.grad((theirs * weights).sum(), wanted)
    for mine, expected in zip(a, b, strict=True):
        assert expected.any()
        torch.testing.assert_close(mine, expected)
    torch.testing.assert_close(layer.norm.running_mean, norm.running_mean)
    torch.testing.assert_close(layer.norm.running_var, norm.running_var)
