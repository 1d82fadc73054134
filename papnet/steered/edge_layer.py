"""One layer over the edges to the nearest neighbours, with its batch norm folded into the weights.

An edge's value y_ij = W·e_ij + a_j + c_i has one part that is its own and one of either end. Its
mean and variance over all edges follow from sums over points, so batch norm's scale s and shift t
are known before y is; the layer is then max_j(s·y_ij + t − penalty_ij), taken a few points at a
time, and no value of an edge is kept. The results are those of the plain layer with
``nn.BatchNorm1d``, gradients and running statistics included, up to rounding. With e centred,

    var(y) = diag(W·Cov(e)·Wᵀ) + var(a_j + c_i) + 2/E · Σ_j a_j·(W·F_j) + 2/E · Σ_i c_i·(W·T_i)

where F_j sums e over the E edges that end in j and T_i over those that start at i.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from baselines.chunks import chunks
from baselines.edges import edge_moments
from baselines.maximum import maximum, spread
from baselines.points import flat_index, full_precision
from baselines.shared_mlp import Normed, accumulate, accumulator, autocast


class Edges(NamedTuple):
    """The edges of a batch of B clouds of N points, P = B·N, without gradient.

    Attributes:
        neighbours: (B,N,k) int64, within the cloud.
        flat: (P,k) int64, the same among all points of the batch.
        features: (P,k,F).
        penalty: (P,k) ≥ 0, see ``geometry.Geometry``.
        mean, covariance: (F,) and (F,F) of the features over all edges; None outside training.
        ending, starting: (P,F), sums of the centred features over the edges that end in a point
            and that start at it; None outside training.
    """

    neighbours: Tensor
    flat: Tensor
    features: Tensor
    penalty: Tensor
    mean: Tensor | None
    covariance: Tensor | None
    ending: Tensor | None
    starting: Tensor | None


@torch.no_grad()
def collect_edges(index: Tensor, features: Tensor, penalty: Tensor, moments: bool) -> Edges:
    """Edges from (B,N,k) neighbours, (B,N,k,F) features and (B,N,k) penalties.

    Args:
        moments: whether a layer in training will ask for those of the features.
    """
    flat = flat_index(index, index.shape[1]).flatten(0, 1)
    rows, penalty = features.flatten(0, 1), penalty.flatten(0, 1)
    if not moments:
        return Edges(index, flat, rows, penalty, None, None, None, None)
    with torch.autocast(features.device.type, enabled=False):
        mean = rows.mean((0, 1))
        centred = rows - mean
        every = centred.flatten(0, 1)
        ending = torch.zeros_like(centred[:, 0]).index_add_(0, flat.flatten(), every)
        covariance = every.mT @ every / len(every)
        return Edges(index, flat, rows, penalty, mean, covariance, ending, centred.sum(1))


class _EdgeMax(torch.autograd.Function):
    """max over k of W·e + a[index] − penalty, (P,C); e (P,k,F), W (C,F), a (P,C), index (P,k).

    Of equal maxima the first counts. One edge alone decides each output, so the gradient of a goes
    to P·C points and that of W is a product with a matrix that is made a few rows at a time.
    """

    @staticmethod
    def forward(
        ctx: Any, e: Tensor, weight: Tensor, a: Tensor, index: Tensor, penalty: Tensor
    ) -> Tensor:
        points, k = index.shape
        needs_index = any(ctx.needs_input_grad)
        top = a.new_zeros(points, len(weight))
        chosen = torch.zeros(points, len(weight), dtype=torch.int32, device=a.device)
        for part in chunks(points, k * len(weight), e.device):
            y = a.index_select(0, index[part].flatten()).view(-1, k, len(weight))
            y.flatten(0, 1).addmm_(e[part].flatten(0, 1), weight.T)
            y.sub_(penalty[part, :, None])
            maximum(y, top[part], chosen[part] if needs_index else None)
        ctx.save_for_backward(e, weight, index, chosen)
        return top

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_top: Tensor) -> tuple[None, Tensor, Tensor, None, None]:
        e, weight, index, chosen = ctx.saved_tensors
        (points, k), outputs = index.shape, len(weight)
        chosen = chosen.long()
        d_a = torch.zeros_like(d_top).scatter_add_(0, index.gather(1, chosen), d_top)
        d_weight = accumulator(weight)
        for part in chunks(points, k * outputs, e.device):
            d_y = spread(d_top[part], chosen[part], k)
            accumulate(d_weight, d_y.flatten(0, 1).T, e[part].flatten(0, 1))
        return None, d_weight, d_a, None, None


class EdgeLayer(Normed):
    """max over neighbours j of ReLU(BN(W·e_ij + A·x_j + C·x_i) − penalty_ij).

    Args:
        inputs: channels of x.
        edge_features: channels of e.
        outputs: of the layer.
    """

    def __init__(self, inputs: int, edge_features: int, outputs: int) -> None:
        super().__init__(edge_features, outputs, bias=False)
        self.ends = nn.Linear(inputs, 2 * outputs, bias=False)

    def forward(self, x: Tensor, edges: Edges) -> Tensor:
        """(B,N,C) → (B,N,C_out)."""
        c, a = self.ends(x).chunk(2, dim=-1)
        with torch.autocast(x.device.type, enabled=False):
            weight, a, c = self.linear.weight, full_precision(a), full_precision(c)
            moments = self._moments(weight, a, c, edges) if self.norm.training else None
            scale, shift = self.scale_and_shift(moments, edges.flat.numel())
            a, c, weight = scale * a, scale * c + shift, scale[:, None] * weight
        e, weight, rows, penalty = autocast(edges.features, weight, a.flatten(0, 1), edges.penalty)
        top = _EdgeMax.apply(e, weight, rows, edges.flat, penalty)
        return F.relu(top.view_as(a) + c)

    def _moments(self, weight: Tensor, a: Tensor, c: Tensor, edges: Edges) -> tuple[Tensor, Tensor]:
        """Mean and variance (C_out,) of y over all edges of the batch."""
        assert edges.mean is not None
        assert edges.covariance is not None
        assert edges.ending is not None
        assert edges.starting is not None
        mean, var = edge_moments(a, c, edges.neighbours)
        crossed = a.flatten(0, 1).mT @ edges.ending + c.flatten(0, 1).mT @ edges.starting
        along = weight @ edges.covariance + (2 / edges.flat.numel()) * crossed
        return mean + weight @ edges.mean, (var + (along * weight).sum(1)).clamp_min(0)
