"""Layers on edges (point j seen from centre i) computed per point, not per edge.

A linear layer on cat(u_j − v_i, w) splits into a value of the point and one of the centre,
y_ij = a_j + c_i, so its product is taken once a point instead of once an edge; and because batch
norm is a scale and a shift a channel, the maximum over neighbours needs a_j alone. Batch norm's
statistics remain those over all edges, exactly:

    Σ_ij (a_j + c_i)² = Σ_j deg_j·a_j² + 2·Σ_i c_i·S_i + n·Σ_i c_i²,   S_i = Σ_{j ∈ N(i)} a_j

with deg_j the number of neighbourhoods that hold j.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from baselines.balls import Balls
from baselines.points import flat_index, full_precision
from baselines.shared_mlp import chunks


class _EdgeMoments(torch.autograd.Function):
    """Mean and variance (B,C) of a[index] + c over each cloud's edges.

    a (B,N,C), c (B,S,C), index (B·S,n) into all clouds' points in one row.
    """

    @staticmethod
    def forward(ctx: Any, a: Tensor, c: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
        n, edges = index.shape[1], c.shape[1] * index.shape[1]
        # Centred first: the three sums then have little to cancel.
        a_mean, c_mean = a.mean(dim=1), c.mean(dim=1)
        a, c = a - a_mean[:, None], c - c_mean[:, None]
        # Not bincount, which waits for the device to tell the largest index.
        ones = a.new_ones(1).expand(index.numel())
        degree = a.new_zeros(a.shape[:2].numel()).scatter_add_(0, index.flatten(), ones)
        degree = degree.view(*a.shape[:2], 1)
        neighbours = F.embedding_bag(index, a.flatten(0, 1), mode="sum").view_as(c)
        mean = (degree * a).sum(dim=1) / edges
        square = (degree * a * a).sum(dim=1) + (c * (2 * neighbours + n * c)).sum(dim=1)
        ctx.save_for_backward(a, c, index, degree, neighbours, mean)
        return mean + a_mean + c_mean, (square / edges - mean * mean).clamp_min(0)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_mean: Tensor, d_var: Tensor) -> tuple[Tensor, Tensor, None]:
        a, c, index, degree, neighbours, mean = ctx.saved_tensors
        n, edges = index.shape[1], c.shape[1] * index.shape[1]
        # The transposed neighbourhoods: edges sorted by point, so that each point owns a run.
        order = torch.argsort(index.flatten(), stable=True)
        start = degree.flatten().long().cumsum(0) - degree.flatten().long()
        centres = F.embedding_bag(order // n, c.flatten(0, 1), start, mode="sum").view_as(a)
        d_mean, d_var, mean = (d_mean / edges)[:, None], (2 * d_var / edges)[:, None], mean[:, None]
        d_a = degree * d_mean + d_var * (degree * (a - mean) + centres)
        d_c = n * d_mean + d_var * (neighbours + n * (c - mean))
        return d_a, d_c, None


class _NeighbourMax(torch.autograd.Function):
    """max over n of a[index]; a (P,C), index (Q,n) → (Q,C). Equal maxima share the gradient."""

    @staticmethod
    def forward(ctx: Any, a: Tensor, index: Tensor) -> Tensor:
        top = a.new_zeros(len(index), a.shape[1])
        for part in chunks(len(index), index.shape[1] * a.shape[1], a.device):
            edges = a.index_select(0, index[part].flatten())
            torch.amax(edges.view(-1, index.shape[1], a.shape[1]), dim=1, out=top[part])
        ctx.save_for_backward(a, index, top)
        return top

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_top: Tensor) -> tuple[Tensor, None]:
        a, index, top = ctx.saved_tensors
        d_a = torch.zeros_like(a)
        for part in chunks(len(index), index.shape[1] * a.shape[1], a.device):
            flat = index[part].flatten()
            edges = a.index_select(0, flat).view(-1, index.shape[1], a.shape[1])
            hit = (edges == top[part, None]).to(a.dtype)
            share = d_top[part] / hit.sum(dim=1).clamp_min(1)
            d_a.index_add_(0, flat, hit.mul_(share[:, None]).flatten(0, 1))
        return d_a, None


class _EdgeReLU(torch.autograd.Function):
    """ReLU of a[point] + c[centre], a row for each edge; a (P,C), c (Q,C), (R,), (R,) → (R,C)."""

    @staticmethod
    def forward(ctx: Any, a: Tensor, c: Tensor, point: Tensor, centre: Tensor) -> Tensor:
        edges = a.index_select(0, point)
        for part in chunks(len(edges), edges.shape[1], edges.device):
            edges[part].add_(c.index_select(0, centre[part])).relu_()
        ctx.save_for_backward(edges, point, centre)
        ctx.rows = len(a), len(c)
        return edges

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_edges: Tensor) -> tuple[Tensor, Tensor, None, None]:
        edges, point, centre = ctx.saved_tensors
        d_edges = torch.ops.aten.threshold_backward(d_edges, edges, 0)
        d_a, d_c = (edges.new_zeros(rows, edges.shape[1]) for rows in ctx.rows)
        d_a.index_add_(0, point, d_edges)
        d_c.index_add_(0, centre, d_edges)
        return d_a, d_c, None, None


def edge_relu(a: Tensor, c: Tensor, balls: Balls) -> Tensor:
    """ReLU of a_j + c_i for every row of the balls: (B,N,C), (B,S,C) → (R,C)."""
    return _EdgeReLU.apply(a.flatten(0, 1), c.flatten(0, 1), balls.point, balls.centre)


def cloud_edge_moments(a: Tensor, c: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and variance (B,C) of a_j + c_i over the edges of each cloud, the variance over their
    count.

    Args:
        a: (B,N,C) values of points.
        c: (B,S,C) values of centres.
        index: (B,S,n) neighbours of each centre.
    """
    with torch.autocast(a.device.type, enabled=False):
        flat = flat_index(index, a.shape[1]).flatten(0, 1)
        return _EdgeMoments.apply(full_precision(a), full_precision(c), flat)


def edge_moments(a: Tensor, c: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    """The same (C,) over all edges of a batch."""
    with torch.autocast(a.device.type, enabled=False):
        means, variances = cloud_edge_moments(a, c, index)
        mean = means.mean(dim=0)
        return mean, (variances + (means - mean).square()).mean(dim=0)


def neighbour_max(a: Tensor, index: Tensor) -> Tensor:
    """(B,N,C) values, (B,S,n) neighbours → (B,S,C): the largest value among the neighbours."""
    flat = flat_index(index, a.shape[1]).flatten(0, 1)
    return _NeighbourMax.apply(a.flatten(0, 1), flat).view(*index.shape[:2], -1)
