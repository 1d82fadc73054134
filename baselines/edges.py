"""Layers on edges (point j seen from centre i) computed per point, not per edge.

A linear layer on cat(u_j − v_i, w) splits into a value of the point and one of the centre,
y_ij = a_j + c_i, so its product is taken once a point instead of once an edge; and because batch
norm is a scale and a shift a channel, the maximum over neighbours needs a_j alone. Batch norm's
statistics remain those over all edges, exactly:

    Σ_ij (a_j + c_i)² = Σ_j deg_j·a_j² + 2·Σ_i c_i·S_i + n·Σ_i c_i²,   S_i = Σ_{j ∈ N(i)} a_j

with deg_j the number of neighbourhoods that hold j.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from baselines.balls import Balls
from baselines.chunks import chunks
from baselines.maximum import maximum
from baselines.points import autocast_dtype, flat_index, full_precision


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
    """max over n of a[index]; a (P,C), index (Q,n) → (Q,C). Of equal ones the first counts."""

    @staticmethod
    def forward(ctx: Any, a: Tensor, index: Tensor) -> Tensor:
        top = a.new_empty(len(index), a.shape[1])
        rank = torch.zeros(top.shape, dtype=torch.int32, device=a.device)
        for part in chunks(len(index), index.shape[1] * a.shape[1], a.device):
            edges = a.index_select(0, index[part].flatten())
            wanted = rank[part] if ctx.needs_input_grad[0] else None
            maximum(edges.view(-1, index.shape[1], a.shape[1]), top[part], wanted)
        ctx.save_for_backward(index, rank)
        ctx.points = len(a)
        return top

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_top: Tensor) -> tuple[Tensor, None]:
        index, rank = ctx.saved_tensors
        share = full_precision(d_top)
        d_a = share.new_zeros(ctx.points, share.shape[1])
        d_a.scatter_add_(0, index.gather(1, rank.long()), share)
        return d_a.to(d_top.dtype), None


class _EdgeReLU(torch.autograd.Function):
    """ReLU of a[point] + c[centre] in ``dtype``, a row for each edge of balls.

    a (P,C), c (Q,C) → (R,C). The sum is in the precision of a and c, where the digits of near
    points cancel.
    """

    @staticmethod
    def forward(ctx: Any, a: Tensor, c: Tensor, balls: Balls, dtype: torch.dtype) -> Tensor:
        channels = a.shape[1]
        edges = torch.empty(len(balls.point), channels, dtype=dtype, device=a.device)
        sorted_c = torch.empty_like(c).index_copy_(0, balls.place, c)
        for rows, which, length in _parts(balls, channels, a.device):
            sums = a.index_select(0, balls.point[rows]).view(-1, length, channels)
            edges[rows] = sums.add_(sorted_c[which, None]).relu_().flatten(0, 1)
        ctx.save_for_backward(edges)
        ctx.balls, ctx.points, ctx.full = balls, len(a), a.dtype
        return edges

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_edges: Tensor) -> tuple[Tensor, Tensor, None, None]:
        (edges,) = ctx.saved_tensors
        balls: Balls = ctx.balls
        channels = edges.shape[1]
        d_a = torch.zeros(ctx.points, channels, dtype=ctx.full, device=edges.device)
        d_c = d_a.new_empty(len(balls.place), channels)
        for rows, which, length in _parts(balls, channels, edges.device):
            share = torch.ops.aten.threshold_backward(d_edges[rows], edges[rows], 0).to(ctx.full)
            torch.sum(share.view(-1, length, channels), dim=1, out=d_c[which])
            d_a.index_add_(0, balls.point[rows], share)
        return d_a, d_c.index_select(0, balls.place), None, None


def _parts(balls: Balls, channels: int, device: torch.device) -> Iterator[tuple[slice, slice, int]]:
    """A few balls of one length at a time: their rows, their places in the order, the length."""
    row = place = 0
    for count, length in balls.blocks:
        for part in chunks(count, length * channels, device):
            first, last = part.start, part.stop
            yield (
                slice(row + first * length, row + last * length),
                slice(place + first, place + last),
                length,
            )
        row, place = row + count * length, place + count


def edge_relu(a: Tensor, c: Tensor, balls: Balls) -> Tensor:
    """ReLU of a_j + c_i for every row of the balls: (B,N,C), (B,S,C) → (R,C).

    The values come in full precision; the rows leave in what autocast gives products here.
    """
    a, c = a.flatten(0, 1), c.flatten(0, 1)
    return _EdgeReLU.apply(a, c, balls, autocast_dtype(a))


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
