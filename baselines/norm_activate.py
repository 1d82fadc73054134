"""Batch norm and activation of a product's rows in few passes over them."""

from __future__ import annotations

from typing import Any

import torch
import torch.distributed as dist
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from baselines.chunks import chunks
from baselines.processes import pooled, world_size


class NormActivate(torch.autograd.Function):
    """Batch norm and leaky ReLU of y + centre, rows (R,C), y centred: its mean is ``centre``.

    apply(y, gain, bias, centre and constant (C,), w (R,) or None, count, eps, slope, parts) →
    the rows, and mean, variance and count over the values of all processes. Row r counts w_r times
    of ``count``; the rows of one of the ``parts`` are handled at a time, so that they stay in a
    cache. The norm cancels the constant, which therefore has a gradient of zero, or is None.
    """

    @staticmethod
    def forward(
        ctx: Any, y: Tensor, gain: Tensor, bias: Tensor, centre: Tensor, constant: Tensor | None,
        w: Tensor | None, count: int, eps: float, slope: float, parts: list[slice],
    ) -> tuple[Tensor, Tensor, Tensor, int | Tensor]:  # fmt: skip
        square = torch.zeros_like(centre)
        for part in parts:
            values = y[part].to(centre.dtype)
            square += column_sums(values * values, None if w is None else w[part])
        mean, var, total = pooled(centre, square / count, count)
        inverse = torch.rsqrt(var + eps)
        scale, off = gain * inverse, centre - mean
        shift = torch.addcmul(bias, scale, off)
        out = torch.empty_like(y)
        for part in parts:
            if y.dtype == scale.dtype:
                activate_(torch.addcmul(shift, y[part], scale, out=out[part]), slope)
            else:
                out[part] = activate_(torch.addcmul(shift, y[part], scale), slope)
        # Without an activation it is not needed, and the caller may write over it.
        ctx.save_for_backward(y, out if slope != 1 else None, scale, inverse, off, w)
        ctx.total, ctx.slope, ctx.constant = total, slope, constant is not None
        ctx.parts = parts
        mean = mean if constant is None else mean + constant
        ctx.mark_non_differentiable(mean, var)
        return out, mean, var, total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_out: Tensor, *_: Any) -> tuple[Tensor | None, ...]:
        y, out, scale, inverse, off, w = ctx.saved_tensors
        parts = ctx.parts
        d_y = torch.empty_like(y)
        sums = scale.new_zeros(2, len(scale))
        for part in parts:
            after = None if out is None else out[part]
            d = _before(d_out[part], after, ctx.slope, d_y[part])
            sums[0] += d.sum(dim=0, dtype=scale.dtype)
            sums[1] += (d.to(scale.dtype) * y[part]).sum(dim=0)
        sums[1] += off * sums[0]
        d_bias, d_gain = sums[0].clone(), sums[1] * inverse
        if world_size() > 1:
            dist.all_reduce(sums)
        # Mean and variance move with every row: less their share, one flat and one along y.
        along = scale * inverse.square() * sums[1] / ctx.total
        flat = scale * sums[0] / ctx.total + along * off
        for part in parts:
            share = torch.addcmul(flat, y[part], along)
            if w is not None:
                share.mul_(w[part, None])
            if y.dtype == scale.dtype:
                d_y[part].mul_(scale).sub_(share)
            else:
                d_y[part] = share.neg_().addcmul_(d_y[part].to(scale.dtype), scale)
        return (
            d_y, d_gain, d_bias, None, torch.zeros_like(scale) if ctx.constant else None, None,
            None, None, None, None,
        )  # fmt: skip


class PlainNormActivate(torch.autograd.Function):
    """The same of rows that count alike, in one process, y not centred.

    apply(y (R,C), gain, bias and constant (C,), eps, slope) → the rows, mean and variance of
    y + constant over them, cancelled as above. Arithmetic is in full precision.
    """

    @staticmethod
    def forward(
        ctx: Any, y: Tensor, gain: Tensor, bias: Tensor, constant: Tensor | None, eps: float,
        slope: float,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        out, mean, inverse = torch.native_batch_norm(y, gain, bias, None, None, True, 0.0, eps)
        activate_(out, slope)
        ctx.save_for_backward(y, out if slope != 1 else None, gain, mean, inverse)
        ctx.eps, ctx.slope, ctx.constant = eps, slope, constant is not None
        mean = mean if constant is None else mean + constant
        var = inverse.square().reciprocal_().sub_(eps).clamp_min_(0)
        ctx.mark_non_differentiable(mean, var)
        return out, mean, var

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_out: Tensor, *_: Any) -> tuple[Tensor | None, ...]:
        y, out, gain, mean, inverse = ctx.saved_tensors
        if out is not None:
            d_out = _before(d_out, out, ctx.slope, torch.empty_like(out))
        d_y, d_gain, d_bias = torch.ops.aten.native_batch_norm_backward(
            d_out, y, gain, None, None, mean, inverse, True, ctx.eps, [True, True, True]
        )
        d_constant = torch.zeros_like(d_bias) if ctx.constant else None
        return d_y, d_gain, d_bias, d_constant, None, None


def column_sums(values: Tensor, w: Tensor | None) -> Tensor:
    """(C,) of (R,C), row r taken w_r times; never in a half precision."""
    if values.element_size() >= 4:
        return values.sum(dim=0) if w is None else w.to(values.dtype) @ values
    total = torch.zeros(values.shape[1], device=values.device)
    for part in chunks(len(values), values.shape[1], values.device):
        total += column_sums(values[part].float(), None if w is None else w[part])
    return total


def activate_(values: Tensor, slope: float) -> Tensor:
    """Leaky ReLU in place; the slope is 1 for none."""
    if slope == 1:
        return values
    return F.leaky_relu_(values, slope) if slope else values.relu_()


def _before(d: Tensor, out: Tensor | None, slope: float, into: Tensor) -> Tensor:
    """The gradient before a leaky ReLU from that after it and its values, written to ``into``."""
    if out is None:
        return into.copy_(d)
    if slope:
        return torch.ops.aten.leaky_relu_backward.grad_input(d, out, slope, True, grad_input=into)
    return torch.ops.aten.threshold_backward.grad_input(d, out, 0, grad_input=into)
