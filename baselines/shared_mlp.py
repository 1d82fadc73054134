"""A linear layer shared by all points, with batch norm, in as few passes over memory as it takes.

The published networks normalise y = W·x + b over every point (or edge) of the batch. The mean and
variance of y follow from those of x:

    mean(y) = W·mean(x) + b,      var(y) = diag(W·Cov(x)·Wᵀ)

so the norm's scale and shift are known before y is, and fold into the weights: one matrix product
gives the normalised value, and a maximum over points can be taken without keeping y. Cov(x) costs
C_in² multiplications a row and its gradient as many again; where y has few channels for that and is
kept anyway, its variance is summed from y itself, which comes out of the product centred
(``norm_activate``). The results are those of ``nn.Linear`` followed by ``nn.BatchNorm1d``,
gradients and running statistics included, up to rounding.

Layout: channels last, (…,C).
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from baselines.balls import Balls
from baselines.chunks import chunks
from baselines.maximum import kept_max, maximum, spread
from baselines.norm_activate import NormActivate, PlainNormActivate, activate_, column_sums
from baselines.points import autocast_dtype, full_precision
from baselines.processes import pooled, world_size

COVARIANCE_BELOW = 13
"""Squared input channels per output channel up to which a covariance of inputs is the cheaper way
to the variances of outputs that are kept. From three layer sizes on one core with AVX-512."""
FEW_INPUTS = 8
"""Inputs up to which a product stays in full precision: nothing is gained there."""
KEPT_BELOW = 150
"""Multiplications for a covariance of inputs and its gradient, for each value of the output, up to
which a maximum's outputs are not kept."""
FEW_ROWS = {False: 64, True: 128}
"""Rows a group, in full and in half precision, up to which the gradient of a maximum is a product
with a matrix of mostly zeros rather than a visit to the chosen rows."""


class _Moments(torch.autograd.Function):
    """Mean (C,) and covariance (C,C) over the rows of (R,C), row r counting w_r times of M = Σw."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, count: int, w: Tensor | None) -> tuple[Tensor, Tensor]:
        channels = x.shape[1]
        mean = column_sums(x, w) / count
        # In a half precision the products are of its numbers, their sums are not.
        centre = mean.to(x.dtype)
        covariance = torch.zeros(channels, channels, dtype=mean.dtype, device=x.device)
        for part in chunks(len(x), channels, x.device):
            centred = x[part] - centre
            weighted = centred if w is None else centred * w[part, None].to(x.dtype)
            accumulate(covariance, weighted.T, centred)
        ctx.save_for_backward(x, centre, w)
        ctx.count = count
        off = mean - centre
        return mean, covariance / count - off[:, None] * off

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_mean: Tensor, d_covariance: Tensor) -> tuple[Tensor, None, None]:
        x, centre, w = ctx.saved_tensors
        # d/dx of Σ w(x−m)(x−m)ᵀ/M; the term through the mean vanishes, as Σ w(x−m) does.
        map_x, flat = (d_covariance + d_covariance.T) / ctx.count, d_mean / ctx.count
        if x.dtype == map_x.dtype:
            d_x = torch.addmm(flat - centre @ map_x, x, map_x)
            return d_x if w is None else d_x.mul_(w[:, None]), None, None
        d_x, map_x, flat = torch.empty_like(x), map_x.to(x.dtype), flat.to(x.dtype)
        for part in chunks(len(x), x.shape[1], x.device):
            torch.addmm(flat, x[part] - centre, map_x, out=d_x[part])
            if w is not None:
                d_x[part].mul_(w[part, None].to(x.dtype))
        return d_x, None, None


def moments(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (C,) and covariance (C,C), divided by the count, of rows (R,C)."""
    return _Moments.apply(rows, len(rows), None)


def accumulator(weight: Tensor) -> Tensor:
    """Zeros for a gradient of ``weight`` that is summed part by part, never in a half precision."""
    return torch.zeros_like(weight, dtype=torch.promote_types(weight.dtype, torch.float32))


def accumulate(total: Tensor, a: Tensor, b: Tensor) -> None:
    """Adds a·b to an ``accumulator``."""
    if b.shape[1] < len(a):
        total += (b.T @ a.T).T  # see ``_FewInputsLinear``
    elif a.dtype == total.dtype:
        total.addmm_(a, b)
    else:
        total += a @ b


class _LinearMax(torch.autograd.Function):
    """max over n of x (G,n,C_in) · weightᵀ + bias → (G,C_out), never kept before the maximum.

    One point alone decides each output. Of large groups the backward pass visits those G·C_out
    points; of small ones it multiplies by the matrix of G·n rows that is zero but for them.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        groups, size, _ = x.shape
        needs_index = any(ctx.needs_input_grad)
        top = x.new_zeros(groups, len(weight))
        index = torch.zeros(groups, len(weight), dtype=torch.int32, device=x.device)
        for part in chunks(groups, size * len(weight), x.device):
            y = F.linear(x[part], weight, bias)
            maximum(y, top[part], index[part] if needs_index else None)
        ctx.save_for_backward(x, weight, index)
        return top

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_top: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x, weight, index = ctx.saved_tensors
        groups, size, channels = x.shape
        rows = x.flatten(0, 1)
        d_weight = accumulator(weight)
        if size <= FEW_ROWS[x.element_size() < 4]:
            d_x = torch.empty_like(x)
            for part in chunks(groups, size * len(weight), x.device):
                flat = spread(d_top[part], index[part], size).flatten(0, 1)
                accumulate(d_weight, flat.T, x[part].flatten(0, 1))
                torch.mm(flat, weight, out=d_x[part].flatten(0, 1))
            return d_x, d_weight, d_top.sum(dim=0)
        d_rows = torch.zeros_like(rows)
        first = torch.arange(0, groups * size, size, device=x.device)[:, None]
        for part in chunks(groups, weight.numel(), x.device):
            flat = (index[part] + first[part]).flatten()
            share = d_top[part, :, None]
            chosen = rows.index_select(0, flat).view(-1, *weight.shape)
            d_weight += chosen.mul_(share).sum(dim=0)
            d_rows.index_add_(0, flat, (share * weight).view(-1, channels))
        return d_rows.view_as(x), d_weight, d_top.sum(dim=0)


def autocast(*tensors: Tensor) -> tuple[Tensor, ...]:
    """The tensors in the dtype that autocast would give a matrix product here."""
    return tuple(t.to(autocast_dtype(t)) for t in tensors)


class _FewInputsLinear(torch.autograd.Function):
    """``F.linear`` of rows (R,C_in), whose weight's gradient is (xᵀ·d_y)ᵀ instead of d_yᵀ·x.

    The same sums; but a product of many rows that leaves few columns runs, on a CPU, at a tenth of
    the speed of one that leaves few rows.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        ctx.save_for_backward(x, weight)
        ctx.has_bias = bias is not None
        return F.linear(x, weight, bias)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_y: Tensor) -> tuple[Tensor | None, Tensor, Tensor | None]:
        x, weight = ctx.saved_tensors
        d_x = d_y @ weight if ctx.needs_input_grad[0] else None
        return d_x, (x.T @ d_y).T, d_y.sum(0) if ctx.has_bias else None


def linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """``F.linear``, but few inputs are multiplied in full precision whatever autocast says.

    They are coordinates, or what is as exact, of which a half precision would leave two digits; the
    values leave in autocast's dtype all the same.
    """
    if x.shape[-1] > FEW_INPUTS:
        return F.linear(x, weight, bias)
    with torch.autocast(x.device.type, enabled=False):
        y = _FewInputsLinear.apply(x.reshape(-1, x.shape[-1]).to(weight.dtype), weight, bias)
    return autocast(y)[0].view(*x.shape[:-1], -1)


def linear_max(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """(…,n,C_in) → (…,C_out): the maximum over n of x·weightᵀ + bias."""
    if x.shape[-1] > FEW_INPUTS:
        x, weight, bias = autocast(x, weight, bias)
    else:
        x = x.to(weight.dtype)
    groups = x.reshape(-1, *x.shape[-2:])
    with torch.autocast(x.device.type, enabled=False):
        return _LinearMax.apply(groups, weight, bias).view(*x.shape[:-2], -1)


class Normed(nn.Module):
    """A linear layer and the batch norm of its values, for subclasses to compute in their own way.

    Args:
        inputs, outputs: channels.
        bias: whether the linear layer has one, as in the publication; batch norm cancels it.
    """

    def __init__(self, inputs: int, outputs: int, bias: bool = True) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs, bias=bias)
        self.norm = nn.BatchNorm1d(outputs)

    def scale_and_shift(
        self, moments: tuple[Tensor, Tensor] | None, count: int
    ) -> tuple[Tensor, Tensor]:
        """s and t (C_out,) such that batch norm maps a value y of the linear layer to s·y + t.

        Args:
            moments: mean and variance (C_out,) of y over the batch, the variance divided by the
                count; they move the running statistics. None, in evaluation, uses those instead.
                Of several processes each gives those of its share.
            count: how many values the moments are of.
        """
        norm = self.norm
        assert norm.running_mean is not None
        assert norm.running_var is not None
        if moments is None:
            mean, var = norm.running_mean, norm.running_var
        else:
            mean, var, total = pooled(*moments, count)
            self._track(mean, var, total)
        scale = norm.weight * torch.rsqrt(var + norm.eps)
        return scale, norm.bias - scale * mean

    @torch.no_grad()
    def _track(self, mean: Tensor, var: Tensor, count: int | Tensor) -> None:
        norm = self.norm
        # Two processes have two values at least; to look at the tensor would wait for the device.
        if isinstance(count, int) and count < 2:
            raise ValueError(
                f"batch norm needs more than one value a channel in training, got {count}"
            )
        assert norm.running_mean is not None
        assert norm.running_var is not None
        assert norm.num_batches_tracked is not None
        assert norm.momentum is not None
        norm.num_batches_tracked += 1
        norm.running_mean.lerp_(mean, norm.momentum)
        norm.running_var.lerp_(var * (count / (count - 1)), norm.momentum)


class NormLinear(Normed):
    """``nn.Linear`` and ``nn.BatchNorm1d`` over all leading dimensions, as one matrix product."""

    def folded(self, x: Tensor, balls: Balls | None = None) -> tuple[Tensor, Tensor]:
        """Weight (C_out,C_in) and bias (C_out,) such that x·weightᵀ + bias is the layer's value.

        Args:
            x: (…,C_in).
            balls: what the rows of x (R,C_in) are, if they do not count alike.
        """
        weight, bias = self.linear.weight, self.linear.bias
        with torch.autocast(x.device.type, enabled=False):
            rows = x.reshape(-1, x.shape[-1])
            count = len(rows) if balls is None else balls.index.numel()
            moments = None
            if self.norm.training:
                w = None if balls is None else balls.weight.to(weight.dtype)
                x_mean, covariance = _Moments.apply(rows, count, w)
                var = ((weight @ covariance) * weight).sum(dim=1).clamp_min(0)
                moments = F.linear(x_mean, weight, bias), var
            scale, shift = self.scale_and_shift(moments, count)
            if bias is not None:
                shift = torch.addcmul(shift, scale, bias)
            return scale[:, None] * weight, shift

    def forward(self, x: Tensor, balls: Balls | None = None, slope: float = 1.0) -> Tensor:
        """(…,C_in) → (…,C_out), normalised, then leaky ReLU; ``balls`` as for ``folded``.

        Args:
            slope: of the leaky ReLU, 0 for a ReLU, 1 for none.
        """
        inputs, outputs = x.shape[-1], len(self.linear.weight)
        if not self.norm.training or inputs**2 <= COVARIANCE_BELOW * outputs:
            y = linear(x.reshape(-1, inputs), *self.folded(x, balls))
            # On rows: in place on a view autograd copies the gradient.
            return activate_(y, slope).view(*x.shape[:-1], outputs)
        rows = x.reshape(-1, inputs)
        weight, bias, norm = self.linear.weight, self.linear.bias, self.norm
        if balls is None and world_size() == 1:
            y, count = linear(rows, weight), len(rows)
            out, mean, var = PlainNormActivate.apply(
                y, norm.weight, norm.bias, bias, norm.eps, slope
            )
            self._track(mean, var, count)
            return out.view(*x.shape[:-1], outputs)
        count = len(rows) if balls is None else balls.index.numel()
        with torch.no_grad(), torch.autocast(x.device.type, enabled=False):
            w = None if balls is None else balls.weight.to(weight.dtype)
            centre = weight @ (column_sums(rows, w) / count)
        # The norm cancels whatever is constant: no gradient goes there, and the bias has none.
        y = linear(rows, weight, -centre)
        with torch.autocast(x.device.type, enabled=False):
            out, mean, var, total = NormActivate.apply(
                y, norm.weight, norm.bias, centre, bias, w, count, norm.eps, slope,
                chunks(len(y), 8 * outputs, y.device),  # several operands share a cache
            )  # fmt: skip
        self._track(mean, var, total)
        return out.view(*x.shape[:-1], outputs)

    def max(self, x: Tensor) -> Tensor:
        """(…,n,C_in) → (…,C_out): the largest normalised value over n.

        A rising activation may follow the maximum instead of preceding it: it picks the same point.
        """
        inputs, outputs = x.shape[-1], len(self.linear.weight)
        rows = x.numel() // inputs
        covariance = inputs**2 * (2 * rows + 3 * outputs) if self.norm.training else 0
        if covariance > KEPT_BELOW * rows * outputs:
            return kept_max(self(x))
        return linear_max(x, *self.folded(x))

    def max_in_balls(self, x: Tensor, balls: Balls) -> Tensor:
        """Rows (R,C_in) → (Q,C_out): the same over each ball."""
        weight, bias = self.folded(x, balls)
        blocks = x.split([number * length for number, length in balls.blocks])
        tops = [
            linear_max(block.unflatten(0, shape), weight, bias)
            for block, shape in zip(blocks, balls.blocks, strict=True)
        ]
        return torch.cat(tops).index_select(0, balls.place)


class SharedMLP(nn.ModuleList):
    """The shared MLP a-b-c-…: a ``NormLinear`` a step, each followed by ReLU."""

    def __init__(self, *channels: int, bias: bool = True) -> None:
        super().__init__(NormLinear(a, b, bias) for a, b in pairwise(channels))

    def forward(self, x: Tensor) -> Tensor:
        """(…,C) → (…,C_out)."""
        return activated(self, x)

    def max(self, x: Tensor) -> Tensor:
        """(…,n,C) → (…,C_out): the maximum over n of the last layer's outputs."""
        *inner, last = self
        assert isinstance(last, NormLinear)
        return F.relu_(last.max(activated(inner, x)))

    def max_in_balls(self, x: Tensor, balls: Balls) -> Tensor:
        """Rows (R,C) → (Q,C_out): the same over each ball."""
        *inner, last = self
        for layer in inner:
            x = layer(x, balls, slope=0.0)
        assert isinstance(last, NormLinear)
        return F.relu_(last.max_in_balls(x, balls))


def activated(layers: Iterable[nn.Module], x: Tensor, slope: float = 0.0) -> Tensor:
    """Layers with (leaky) ReLU after each, (…,C) → (…,C_out)."""
    rows = x.reshape(-1, x.shape[-1])
    for layer in layers:
        rows = layer(rows, slope=slope)
    return rows.view(*x.shape[:-1], -1)


class FullPrecision(nn.Sequential):
    """Layers in full precision whatever autocast says: they see one row a cloud and cost little."""

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(full_precision(x))


def head(*channels: int, dropout: tuple[float, ...]) -> nn.Sequential:
    """Fully connected layers with batch norm and ReLU, the last one linear alone.

    Args:
        dropout: rate after each hidden layer's ReLU.
    """
    *hidden, outputs = channels
    layers: list[nn.Module] = []
    for (a, b), rate in zip(pairwise(hidden), dropout, strict=True):
        layers += [nn.Linear(a, b), nn.BatchNorm1d(b), nn.ReLU(inplace=True)]
        layers += [nn.Dropout(rate)] if rate else []
    return FullPrecision(*layers, nn.Linear(hidden[-1], outputs))
