"""The maximum over neighbours of a layer on what an edge has and what its point has, joined.

Of y_ij = W·[l_ij, f_j] + b = W₁·l_ij + g_j the second product is taken once a point. Batch norm's
statistics follow from those of l and g and their covariance,

    Cov(l, g) = Σ_j S_j·(g_j − ḡ)ᵀ / E,   S_j = Σ_{i: j ∈ N(i)} (l_ij − l̄)

over the E edges, so that y is made once, in a core's cache, for its maximum alone.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from baselines.chunks import chunks
from baselines.maximum import maximum
from baselines.points import flat_index, full_precision
from baselines.shared_mlp import NormLinear, moments


class _JoinedMax(torch.autograd.Function):
    """max over n of x·weightᵀ + g[index]: (G,n,L), (C,L), (P,C), (G,n) → (G,C).

    One edge alone decides each output; the backward pass visits those.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, g: Tensor, index: Tensor) -> Tensor:
        groups, size, _ = x.shape
        top = x.new_zeros(groups, len(weight))
        rank = torch.zeros(groups, len(weight), dtype=torch.int32, device=x.device)
        for part in chunks(groups, size * len(weight), x.device):
            y = g.index_select(0, index[part].flatten())
            y = y.addmm_(x[part].flatten(0, 1), weight.T).unflatten(0, (-1, size))
            maximum(y, top[part], rank[part] if any(ctx.needs_input_grad) else None)
        ctx.save_for_backward(x, weight, index, rank)
        ctx.points = len(g)
        return top

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_top: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        x, weight, index, rank = ctx.saved_tensors
        groups, size, channels = x.shape
        rows = x.flatten(0, 1)
        d_rows, d_weight = torch.zeros_like(rows), torch.zeros_like(weight)
        first = torch.arange(0, groups * size, size, device=x.device)[:, None]
        for part in chunks(groups, weight.numel(), x.device):
            flat = (rank[part] + first[part]).flatten()
            share = d_top[part, :, None]
            chosen = rows.index_select(0, flat).view(-1, *weight.shape)
            d_weight += chosen.mul_(share).sum(dim=0)
            d_rows.index_add_(0, flat, (share * weight).view(-1, channels))
        d_g = d_top.new_zeros(ctx.points, len(weight))
        d_g.scatter_add_(0, index.gather(1, rank.long()), d_top)
        return d_rows.view_as(x), d_weight, d_g, None


class JoinedMax(NormLinear):
    """max over j ∈ N(i) of BN(W·[l_ij, f_j] + b).

    Args:
        edge, point: channels of l and of f.
    """

    def __init__(self, edge: int, point: int, outputs: int, bias: bool = True) -> None:
        super().__init__(edge + point, outputs, bias=bias)
        self.edge = edge

    def forward(self, edges: Tensor, f: Tensor, index: Tensor) -> Tensor:  # type: ignore[override]
        """(B,S,n,L), (B,N,C), (B,S,n) → (B,S,C_out), without activation."""
        weight = self.linear.weight.split([self.edge, f.shape[-1]], dim=1)
        return self._maximum(edges, f, index, *weight)

    def about_centres(self, edges: Tensor, f: Tensor) -> Tensor:
        """max over j of BN(W·[h_ij − f_i, f_i]): (B,N,n,C), (B,N,C) → (B,N,C_out)."""
        relative, own = self.linear.weight.chunk(2, dim=1)
        index = torch.arange(f.shape[1], device=f.device)[None, :, None].expand(edges.shape[:3])
        return self._maximum(edges, f, index, relative, own - relative, own=True)

    def _maximum(
        self,
        edges: Tensor,
        f: Tensor,
        index: Tensor,
        weight: Tensor,
        of_point: Tensor,
        own: bool = False,
    ) -> Tensor:
        with torch.autocast(edges.device.type, enabled=False):
            flat = flat_index(index, f.shape[1]).flatten(0, 1)
            x = full_precision(edges).flatten(0, 1)
            g = F.linear(full_precision(f).flatten(0, 1), of_point, self.linear.bias)
            found = self._moments(x, g, weight, None if own else flat) if self.training else None
            scale, shift = self.scale_and_shift(found, index.numel())
            top = _JoinedMax.apply(x, scale[:, None] * weight, g * scale + shift, flat)
        return top.unflatten(0, index.shape[:2])

    @staticmethod
    def _moments(
        x: Tensor, g: Tensor, weight: Tensor, index: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Mean and variance (C_out,) of x·weightᵀ + g[index] over the edges (G,n,L).

        Without an index each group's point is its own.
        """
        size, count = x.shape[1], x.shape[0] * x.shape[1]
        mean, covariance = moments(x.flatten(0, 1))
        if index is None:
            sums, degree = x.sum(dim=1), g.new_full((), float(size))
        else:
            rows, ones = index.flatten(), g.new_ones(1).expand(count)
            degree = g.new_zeros(len(g)).index_add_(0, rows, ones)[:, None]
            sums = x.new_zeros(len(g), x.shape[2]).index_add(0, rows, x.flatten(0, 1))
        g_mean = (degree * g).sum(dim=0) / count
        g = g - g_mean
        cross = (sums - degree * mean).T @ g / count
        var = ((weight @ covariance) * weight + 2 * cross.T * weight).sum(dim=1)
        var = var + (degree * g * g).sum(dim=0) / count
        return F.linear(mean, weight) + g_mean, var.clamp_min(0)
