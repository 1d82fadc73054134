"""Vector neurons: layers on lists of vectors that turn with the cloud.

A feature is C vectors, (3,…,C) with the axis first: a layer mixes vectors by one matrix for all
three axes, so a rotation of the input is a rotation of the output. Source: Deng et al., Vector
Neurons, ICCV 2021; FlyingGiraffe/vnn@f3197e2.

On edges (point j seen from centre i) every matrix is taken per point, as in ``edges``: a layer on
[x_j − x_i, x_i] has the value a_j + c_i. What follows depends on the length of that sum and is
taken per edge, a few centres at a time so that it stays in a core's cache; no edge is kept.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from baselines.chunks import chunks
from baselines.points import flat_index, full_precision, knn
from baselines.shared_mlp import Normed

EPS = 1e-6
"""Added to a vector's length before its normalisation, and to a direction's squared length.

Below it they fade: the direction of a shorter vector counts for less. As published it is too small
for that, and one point's vector that happens to be near zero, pointing where rounding says, moves
what follows.
"""
WORKING_SET = 8
"""How many arrays of a chunk's vectors the nonlinearity has at a time; they share the cache."""

Values = tuple[Tensor, Tensor | None]
"""What a linear layer's values are made of: of points (3,P,C) alone; of edges, of points and of
centres (3,Q,C); of edges between positions, its weights (m,C) for the vectors of an edge."""


class Edges:
    """Which point j is seen from which centre i: rows of the vectors below.

    Attributes:
        index: (Q,k) point of each edge, among all clouds' points in one row.
        vectors: (3,Q,k,m) of edges between positions, else None.
    """

    def __init__(self, index: Tensor, vectors: Tensor | None = None) -> None:
        self.index = flat_index(index, index.shape[1]).flatten(0, 1)
        self.vectors = vectors


def position_edges(points: Tensor, index: Tensor, cross: bool = False) -> Edges:
    """Edges with the vectors x_j − x_i and x_i, or x_j × x_i as a third; no gradient.

    Of positions the difference is taken before the layer: after it, the digits would be lost in
    which near points differ.

    Args:
        points: (B,N,3).
        index: (B,N,k) neighbours.
    """
    edges = Edges(index)
    x = full_precision(points.detach()).flatten(0, 1)
    neighbour = x[edges.index]
    centre = x[:, None].expand_as(neighbour)
    vectors = [neighbour - centre, centre]
    vectors += [torch.linalg.cross(neighbour, centre, dim=-1)] if cross else []
    edges.vectors = torch.stack(vectors, dim=-1).permute(2, 0, 1, 3).contiguous()
    return edges


class _Layer:
    """A linear layer's values on points (P) or edges (Q of k), a few rows at a time."""

    def __init__(self, values: Values, edges: Edges | None) -> None:
        self.first, self.centre = values
        self.edges = edges

    def parts(self, channels: int) -> list[slice]:
        rows = self.first.shape[1] if self.edges is None else len(self.edges.index)
        each = 1 if self.edges is None else self.edges.index.shape[1]
        return chunks(rows, WORKING_SET * 3 * each * channels, self.first.device)

    def values(self, part: slice) -> Tensor:
        """(3,q,k,C) of the edges of some centres; (3,q,1,C) of points."""
        if self.edges is None:
            return self.first[:, part, None]
        if self.edges.vectors is not None:
            return self.edges.vectors[:, part] @ self.first
        assert self.centre is not None
        index = self.edges.index[part]
        y = self.first.index_select(1, index.flatten()).unflatten(1, index.shape)
        return y.add_(self.centre[:, part, None])

    def zeros(self) -> Values:
        """Gradients to add to."""
        return (
            torch.zeros_like(self.first),
            None if self.centre is None else torch.zeros_like(self.centre),
        )

    def add(self, to: Values, d_y: Tensor, part: slice) -> None:
        """Adds the gradient d_y (3,q,k,C) of ``values(part)`` to that of what it is made of."""
        d_first, d_centre = to
        if self.edges is None:
            d_first[:, part] += d_y[:, :, 0]
        elif self.edges.vectors is not None:
            d_first.addmm_(self.edges.vectors[:, part].flatten(0, 2).T, d_y.flatten(0, 2))
        else:
            assert d_centre is not None
            flat = self.edges.index[part].flatten()
            for axis in range(3):
                d_first[axis].index_add_(0, flat, d_y[axis].flatten(0, 1))
            d_centre[:, part] += d_y.sum(dim=2)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Scalar product over the first axis, (3,…,C), (3,…,C or 1) → (…,C)."""
    # torch's reductions over an axis of three are a hundred times slower.
    return (a[0] * b[0]).addcmul_(a[1], b[1]).addcmul_(a[2], b[2])


class _LengthMoments(torch.autograd.Function):
    """Mean and variance (C,) of |q| over all rows."""

    @staticmethod
    def forward(
        ctx: Any, q: Tensor, q_centre: Tensor | None, edges: Edges | None
    ) -> tuple[Tensor, Tensor]:
        layer = _Layer((q, q_centre), edges)
        channels = q.shape[-1]
        count, mean = 0, q.new_zeros(channels)
        square = q.new_zeros(channels)
        for part in layer.parts(channels):
            y = layer.values(part)
            length = _dot(y, y).sqrt_().flatten(0, 1)
            # Pairwise (Chan et al.): squares about the mean of a chunk lose no digits.
            n, m = len(length), length.mean(dim=0)
            square += (length - m).square_().sum(dim=0)
            square += (m - mean).square() * (count * n / (count + n))
            mean += (m - mean) * (n / (count + n))
            count += n
        # The mean is an output: as an attribute of ctx it would keep ctx, and all of a step's
        # edges, for ever.
        ctx.save_for_backward(q, q_centre, mean)
        ctx.edges, ctx.count = edges, count
        return mean, square / count

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_mean: Tensor, d_var: Tensor) -> tuple[Tensor | None, ...]:
        q, q_centre, mean = ctx.saved_tensors
        layer = _Layer((q, q_centre), ctx.edges)
        to = layer.zeros()
        d_mean, d_var = d_mean / ctx.count, 2 * d_var / ctx.count
        offset = d_mean - d_var * mean
        for part in layer.parts(len(d_mean)):
            y = layer.values(part)
            length = _dot(y, y).sqrt_()
            # (d_mean + d_var·(length − mean))/length; a vector of no length has no direction.
            slope = (offset / length.clamp_min(1e-30)).add_(d_var)
            slope.masked_fill_(length == 0, 0)
            layer.add(to, y * slope, part)
        return (*to, None)


class _Nonlinearity(torch.autograd.Function):
    """The mean over each row's edges of (1 − κ)·p + κ·(p, without its part against d).

    p = q·(scale + shift/n) with n = |q| + ε is the normalised vector, d the direction: where
    ⟨p,d⟩ < 0 the second is p − ⟨p,d⟩/(|d|² + ε)·d, else p. κ is 1 less the leaky slope.
    """

    @staticmethod
    def forward(
        ctx: Any,
        q: Tensor,
        q_centre: Tensor | None,
        d: Tensor,
        d_centre: Tensor | None,
        scale: Tensor,
        shift: Tensor,
        edges: Edges | None,
        kappa: float,
        eps: float,
    ) -> Tensor:
        ctx.save_for_backward(q, q_centre, d, d_centre, scale, shift)
        ctx.edges, ctx.kappa, ctx.eps = edges, kappa, eps
        along, across = _Layer((q, q_centre), edges), _Layer((d, d_centre), edges)
        rows = q.shape[1] if edges is None else len(edges.index)
        out = q.new_zeros(3, rows, len(scale))
        for part in along.parts(len(scale)):
            y, z = along.values(part), across.values(part)
            gain = shift / _dot(y, y).sqrt_().add_(eps) + scale
            against = (_dot(y, z) * gain).clamp_max_(0)
            against.div_(_dot(z, z).add_(eps)).mul_(-kappa)
            for axis in range(3):
                value = (y[axis] * gain).addcmul_(against, z[axis])
                torch.mean(value, dim=1, out=out[axis, part])
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_out: Tensor) -> tuple[Tensor | None, ...]:
        q, q_centre, d, d_centre, scale, shift = ctx.saved_tensors
        edges, kappa, eps = ctx.edges, ctx.kappa, ctx.eps
        along, across = _Layer((q, q_centre), edges), _Layer((d, d_centre), edges)
        to_along, to_across = along.zeros(), across.zeros()
        d_scale, d_shift = torch.zeros_like(scale), torch.zeros_like(shift)
        d_out = d_out / (1 if edges is None else edges.index.shape[1])
        for part in along.parts(len(scale)):
            y, z, g = along.values(part), across.values(part), d_out[:, part, None]
            length = _dot(y, y).sqrt_()
            inverse = (length + eps).reciprocal_()
            gain = inverse * shift + scale
            inner, square = _dot(y, z), _dot(z, z).add_(eps)
            ratio = (inner * gain).clamp_max_(0).div_(square)  # r of out = gain·q − κ·r·d
            # Nothing flows through r where it is clamped.
            d_ratio = _dot(z, g).mul_(ratio < 0).mul_(-kappa).div_(square)
            d_gain = _dot(y, g).addcmul_(d_ratio, inner)
            d_inner = d_ratio * gain
            d_square = d_ratio.mul_(ratio).mul_(-2)
            d_scale += d_gain.sum(dim=(0, 1))
            d_gain.mul_(inverse)
            d_shift += d_gain.sum(dim=(0, 1))
            d_length = d_gain.mul_(inverse).mul_(shift).neg_().div_(length.clamp_min(1e-30))
            ratio.mul_(-kappa)
            d_y = (gain * g).addcmul_(d_inner, z).addcmul_(d_length, y)
            d_z = (ratio * g).addcmul_(d_inner, y).addcmul_(d_square, z)
            if z.shape[-1] != y.shape[-1]:
                d_z = d_z.sum(dim=-1, keepdim=True)
            along.add(to_along, d_y, part)
            across.add(to_across, d_z, part)
        return (*to_along, *to_across, d_scale, d_shift, None, None, None)


def as_vectors(points: Tensor) -> Tensor:
    """(B,N,3) points → (3,B,N,1): one vector a point."""
    return points.permute(2, 0, 1)[..., None]


def vector_knn(v: Tensor, k: int) -> Tensor:
    """(3,B,N,C) → (B,N,k): each point's k nearest by all 3·C numbers, itself included."""
    flat = v.detach().permute(1, 2, 3, 0).flatten(2)
    # In float32 the distances of features, by a matrix product, lose the digits that tell near
    # neighbours apart: turned clouds would choose others.
    return knn(flat.double() if flat.shape[-1] > 4 else flat, k)


class VectorLinear(nn.Linear):
    """Mixes vectors, (3,…,C) → (3,…,C_out), in their precision or its weights', the higher one."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, bias=False)

    def forward(self, v: Tensor) -> Tensor:
        return F.linear(v, self.weight.to(torch.promote_types(v.dtype, self.weight.dtype)))


class VectorBatchNorm(nn.Module):
    """v/n·BN(n) with n = |v| + eps, (3,…,C) → the same; a negative BN(n) turns v round."""

    def __init__(self, channels: int, eps: float = EPS) -> None:
        super().__init__()
        self.eps = eps
        self.norm = nn.BatchNorm1d(channels)

    def forward(self, v: Tensor) -> Tensor:
        with torch.autocast(v.device.type, enabled=False):
            v = full_precision(v)
            square = v[0].square() + v[1].square() + v[2].square()
            # The root has no slope at 0.
            length = torch.where(square > 0, square.clamp_min(1e-30).sqrt(), 0.0) + self.eps
            return v * (
                self.norm(length.flatten(0, -2).to(self.norm.weight.dtype)).view_as(length) / length
            )


class VectorReLU(Normed):
    """(Leaky) ReLU of normalised vectors W·v against directions U·v, as in ``_Nonlinearity``.

    Args:
        inputs, outputs: vectors.
        slope: of the leaky ReLU; 0 for none.
        shared: whether all outputs have one direction.
        eps: see ``EPS``.
    """

    def __init__(
        self, inputs: int, outputs: int, slope: float, shared: bool = False, eps: float = EPS
    ) -> None:
        super().__init__(inputs, outputs, bias=False)
        self.direction = nn.Linear(inputs, 1 if shared else outputs, bias=False)
        self.slope, self.eps = slope, eps

    def forward(self, v: Tensor, context: Tensor | None = None) -> Tensor:
        """(3,B,N,C) → (3,B,N,C_out).

        Args:
            v: vectors of points, or (3,B,C) of clouds.
            context: (3,B,1,C') of each cloud, as if appended to every point's vectors.
        """
        mine = v.shape[-1]
        y = []
        for weight in self._weights(v.dtype):
            value = F.linear(v, weight[:, :mine])
            if context is not None:
                value = value + F.linear(context, weight[:, mine:])
            y.append(full_precision(value).flatten(1, -2))
        q, d = y
        return self._activated((q, None), (d, None), None).unflatten(1, v.shape[1:-1])

    def _weights(self, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """W and U in the precision of the vectors, if it is higher."""
        dtype = torch.promote_types(dtype, self.linear.weight.dtype)
        return self.linear.weight.to(dtype), self.direction.weight.to(dtype)

    def _activated(self, q: Values, d: Values, edges: Edges | None) -> Tensor:
        """The values that W and U make → (3,Q,C)."""
        with torch.autocast(q[0].device.type, enabled=False):
            moments = None
            if self.norm.training:
                mean, var = _LengthMoments.apply(*q, edges)
                moments = mean + self.eps, var
            count = q[0].shape[1] if edges is None else edges.index.numel()
            scale, shift = (x.to(q[0].dtype) for x in self.scale_and_shift(moments, count))
            return _Nonlinearity.apply(*q, *d, scale, shift, edges, 1 - self.slope, self.eps)


class VectorEdgeConv(VectorReLU):
    """The mean over j ∈ N(i) of ``VectorReLU`` on [x_j − x_i, x_i], or with x_j × x_i as a third.

    Args:
        inputs, outputs: vectors of a point.
        cross: whether x_j × x_i is an input; of one vector a point, the position. It is what tells
            a shape from its mirror image.
        eps: see ``EPS``.
    """

    def __init__(
        self, inputs: int, outputs: int, slope: float, cross: bool = False, eps: float = EPS
    ) -> None:
        super().__init__(3 if cross else 2 * inputs, outputs, slope, eps=eps)

    def forward(self, v: Tensor, edges: Edges) -> Tensor:  # type: ignore[override]
        """(3,B,N,C) → (3,B,N,C_out); of ``position_edges`` only the shape of v counts."""
        n = v.shape[-1]
        made: list[Values] = []
        for weight in self._weights(v.dtype):
            if edges.vectors is not None:
                made.append((weight.T, None))
                continue
            relative, own = weight[:, :n], weight[:, n:]
            values = F.linear(v, relative), F.linear(v, own - relative)
            point, centre = (full_precision(value).flatten(1, 2) for value in values)
            made.append((point, centre))
        q, d = made
        return self._activated(q, d, edges).unflatten(1, v.shape[1:3])


class VectorFrame(nn.Module):
    """Three vectors of each point, by which its others are expressed: no rotation is left in them.

    The vectors are neither of unit length nor at right angles.
    """

    def __init__(self, channels: int, slope: float) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            [
                VectorReLU(channels, channels // 2, slope),
                VectorReLU(channels // 2, channels // 4, slope),
            ]
        )
        self.last = VectorLinear(channels // 4, 3)

    def forward(self, v: Tensor, context: Tensor) -> Tensor:
        """(3,B,N,C'), (3,B,1,C − C') of the cloud → frame (3,B,N,3)."""
        first, second = self.layers
        return self.last(second(first(v, context)))


def in_frame(v: Tensor, frame: Tensor) -> Tensor:
    """Scalar products (B,N,3·C), vector by vector, of (3,B,N,C) with a frame (3,B,N,3)."""
    products = [
        v[0] * frame[0, ..., i, None]
        + v[1] * frame[1, ..., i, None]
        + v[2] * frame[2, ..., i, None]
        for i in range(3)
    ]
    return torch.stack(products, dim=-1).flatten(2)
