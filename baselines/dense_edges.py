"""Values of every edge of a fixed number of neighbours, where a maximum alone does not do.

As in ``edges``, a linear layer on an edge is a_j + c_i, its product taken once a point. What is
kept is the layer's activated output, which the next layer needs; its maximum is taken without
keeping the next one's.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from baselines.chunks import chunks
from baselines.edges import edge_moments
from baselines.maximum import maximum, spread
from baselines.points import flat_index, full_precision
from baselines.shared_mlp import Normed, autocast


class _ActivatedEdges(torch.autograd.Function):
    """(Leaky) ReLU of a[index] + c, of every edge; a (P,C), c (Q,C), index (Q,n) → (Q,n,C)."""

    @staticmethod
    def forward(ctx: Any, a: Tensor, c: Tensor, index: Tensor, slope: float) -> Tensor:
        edges = a.new_empty(*index.shape, a.shape[1])
        for part in chunks(len(index), edges[0].numel(), a.device):
            rows = edges[part]
            torch.index_select(a, 0, index[part].flatten(), out=rows.view(-1, a.shape[1]))
            rows.add_(c[part, None])
            if slope:
                F.leaky_relu_(rows, slope)
            else:
                rows.relu_()
        ctx.save_for_backward(edges, index)
        ctx.points, ctx.slope = len(a), slope
        return edges

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_edges: Tensor) -> tuple[Tensor, Tensor, None, None]:
        edges, index = ctx.saved_tensors
        channels = edges.shape[-1]
        d_a, d_c = edges.new_zeros(ctx.points, channels), edges.new_empty(len(edges), channels)
        for part in chunks(len(index), edges[0].numel(), edges.device):
            # The activation keeps the sign.
            share = torch.ops.aten.leaky_relu_backward(d_edges[part], edges[part], ctx.slope, True)
            torch.sum(share, dim=1, out=d_c[part])
            d_a.index_add_(0, index[part].flatten(), share.flatten(0, 1))
        return d_a, d_c, None, None


def activated_edges(layer: Normed, a: Tensor, c: Tensor, index: Tensor, slope: float) -> Tensor:
    """(Leaky) ReLU of the batch norm of a layer's values a_j + c_i.

    Args:
        layer: whose norm; it says nothing about how a and c come about.
        a: (B,N,C) values of points, in full precision: near points' digits cancel in the sum.
        c: (B,S,C) values of centres, so too.
        index: (B,S,n) neighbours of each centre.

    Returns:
        (B,S,n,C) in full precision.
    """
    with torch.autocast(a.device.type, enabled=False):
        moments = edge_moments(a, c, index) if layer.norm.training else None
        scale, shift = layer.scale_and_shift(moments, index.numel())
        flat = flat_index(index, a.shape[1]).flatten(0, 1)
        a, c = (a * scale).flatten(0, 1), (c * scale + shift).flatten(0, 1)
        return _ActivatedEdges.apply(a, c, flat, slope).unflatten(0, index.shape[:2])


class EdgeLayer(Normed):
    """ReLU(BN(W·[f_j − f_i, f_i])) of every edge."""

    def __init__(self, inputs: int, outputs: int, slope: float = 0.0) -> None:
        super().__init__(2 * inputs, outputs, bias=False)
        self.slope = slope

    def forward(self, f: Tensor, centres: Tensor, index: Tensor) -> Tensor:
        """(B,N,C), (B,S,C), (B,S,n) → (B,S,n,C_out)."""
        relative, own = self.linear.weight.chunk(2, dim=1)
        with torch.autocast(f.device.type, enabled=False):
            a = F.linear(full_precision(f), relative)
            c = F.linear(full_precision(centres), own - relative)
        return activated_edges(self, a, c, index, self.slope)


class NarrowLinear(Normed):
    """ReLU(BN(W·x)) where W has fewer outputs than inputs.

    The moments are then those of the product: those of x would cost more than it.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """(…,C) → (…,C_out)."""
        y = F.linear(x, self.linear.weight).flatten(0, -2)
        with torch.autocast(y.device.type, enabled=False):
            full = y.to(self.linear.weight.dtype)
            moments = None
            if self.norm.training:
                var, mean = torch.var_mean(full, dim=0, correction=0)
                moments = mean, var
            scale, shift = self.scale_and_shift(moments, len(full))
            z = F.relu_(torch.addcmul(shift, full, scale))
        return z.to(y.dtype).view(*x.shape[:-1], -1)


class _ResidualMax(torch.autograd.Function):
    """max over n of x + h·weightᵀ: (G,n,C), (G,n,H), (C,H) → (G,C)."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, h: Tensor, weight: Tensor) -> Tensor:
        groups, size, channels = x.shape
        top = x.new_zeros(groups, channels)
        rank = torch.zeros(groups, channels, dtype=torch.int32, device=x.device)
        for part in chunks(groups, size * channels, x.device):
            y = torch.addmm(x[part].flatten(0, 1), h[part].flatten(0, 1), weight.T)
            maximum(y.unflatten(0, (-1, size)), top[part], rank[part])
        ctx.save_for_backward(h, weight, rank)
        return top

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_top: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        h, weight, rank = ctx.saved_tensors
        d_x = spread(d_top, rank, h.shape[1])
        rows = d_x.flatten(0, 1)
        return d_x, (rows @ weight).view_as(h), rows.T @ h.flatten(0, 1)


def residual_max(x: Tensor, h: Tensor, weight: Tensor) -> Tensor:
    """(…,n,C), (…,n,H), (C,H) → (…,C): the maximum over n of x + h·weightᵀ, never kept."""
    x, h, weight = autocast(x, h, weight)
    groups = x.reshape(-1, *x.shape[-2:]), h.reshape(-1, *h.shape[-2:])
    return _ResidualMax.apply(*groups, weight).view(*x.shape[:-2], -1)
