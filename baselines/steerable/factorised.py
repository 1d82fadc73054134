"""The steerable convolution as fixed basis first, learned mixing second.

With x_i the (m_i, 2l_i+1) fields of input degree i and w_oi the weights from degree i to o::

    y_oi[f, b] = basis_oi[b] ∗ x_i[f]           f < m_i, b < n_oi: nothing learned
    out_o[g]   = Σ_i Σ_f Σ_b w_oi[g, f, b]·y_oi[f, b]

The y are ten times larger than x, so they are made slab by slab, small enough to stay in the
cache, and made again in the backward pass rather than kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.grad import conv3d_input

from baselines.steerable.fields import Fields

# Bytes of intermediate results per slab: what a core's cache holds, and what a GPU has to spare.
_SLAB_BYTES = {"cpu": 16 << 20, "cuda": 1 << 30}


class Geometry(NamedTuple):
    """What is fixed about a layer; ``basis[o][i]`` is (n,2l_o+1,2l_i+1,s,s,s)."""

    fields_in: Fields
    fields_out: Fields
    basis: list[list[Tensor]]
    padding: int
    stride: int

    @property
    def size(self) -> int:
        return self.basis[0][0].shape[-1]

    def stacked(self, i: int, dtype: torch.dtype) -> Tensor:
        """All kernels that read input degree i, (Σ_o n_oi·(2l_o+1), 2l_i+1, s, s, s)."""
        return torch.cat([row[i].flatten(0, 1) for row in self.basis]).to(dtype)

    @property
    def mixed_rows(self) -> list[int]:
        """Rows that each output degree's weights mix: Σ_i m_i·n_oi."""
        degrees = self.fields_in.degrees
        return [
            sum(m * len(pair) for (_, m, _), pair in zip(degrees, row, strict=True))
            for row in self.basis
        ]

    @property
    def mixed_channels(self) -> int:
        """Channels between the two halves: the rows, each of 2l_o+1 components."""
        degrees = self.fields_out.degrees
        return sum(
            rows * (2 * degree + 1)
            for rows, (degree, _, _) in zip(self.mixed_rows, degrees, strict=True)
        )


class _Slabs:
    """Forward and adjoint of the fixed half on slabs of a padded input."""

    def __init__(self, geometry: Geometry, padded: Tensor) -> None:
        self.g, self.padded = geometry, padded
        self.kernels = [
            geometry.stacked(i, padded.dtype) for i in range(len(geometry.fields_in.degrees))
        ]
        s, stride = geometry.size, geometry.stride
        self.shape = tuple((n - s) // stride + 1 for n in padded.shape[2:])
        if min(self.shape) < 1:
            raise ValueError(f"volume {tuple(padded.shape[2:])} is smaller than the kernel ({s})")

    def __iter__(self) -> Iterator[tuple[slice, slice, slice]]:
        """(samples, output planes, input planes) that cover the output."""
        X, Y, Z = self.shape
        budget = _SLAB_BYTES["cpu" if self.padded.device.type == "cpu" else "cuda"]
        plane = self.g.mixed_channels * Y * Z * self.padded.element_size()
        planes = max(1, min(X, budget // plane))
        samples = max(1, budget // (plane * X)) if planes == X else 1
        for n in range(0, len(self.padded), samples):
            for a in range(0, X, planes):
                b = min(a + planes, X)
                start = a * self.g.stride
                stop = (b - 1) * self.g.stride + self.g.size
                yield slice(n, n + samples), slice(a, b), slice(start, stop)

    def expand(self, samples: slice, planes: slice) -> list[Tensor]:
        """y of one slab: per output degree (n, Σ_i m_i·n_oi, (2l_o+1)·voxels)."""
        per_input = []
        for kernel, (degree, m, channels) in zip(
            self.kernels, self.g.fields_in.degrees, strict=True
        ):
            part = self.padded[samples, channels, planes]
            fields = part.reshape(-1, 2 * degree + 1, *part.shape[2:])
            y = nn.functional.conv3d(fields, kernel, stride=self.g.stride)
            per_input.append(y.view(len(part), m, len(kernel), -1))
        voxels = per_input[0].shape[-1]
        offsets = [0] * len(per_input)
        outputs = []
        for row, rows, (l_out, _, _) in zip(
            self.g.basis, self.g.mixed_rows, self.g.fields_out.degrees, strict=True
        ):
            # One copy per piece, straight to where the mixing reads it.
            mixed = self.padded.new_empty(len(part), rows, (2 * l_out + 1) * voxels)
            start = 0
            for i, (y, pair) in enumerate(zip(per_input, row, strict=True)):
                width, stop = len(pair) * (2 * l_out + 1), start + y.shape[1] * len(pair)
                piece = y[:, :, offsets[i] : offsets[i] + width]
                mixed[:, start:stop].view(piece.shape).copy_(piece)
                offsets[i] += width
                start = stop
            outputs.append(mixed)
        return outputs

    def contract(self, grads: list[Tensor], into: Tensor, samples: slice, planes: slice) -> None:
        """Adjoint of ``expand``: add the gradient of y of one slab to the padded input's."""
        n, _, X, Y, Z = into[samples, :, planes].shape
        out_planes = (X - self.g.size) // self.g.stride + 1
        starts = [0] * len(grads)
        for i, (degree, m, channels) in enumerate(self.g.fields_in.degrees):
            pieces = []
            for o, (row, (l_out, _, _)) in enumerate(
                zip(self.g.basis, self.g.fields_out.degrees, strict=True)
            ):
                count = len(row[i])
                piece = grads[o][:, starts[o] : starts[o] + m * count]
                pieces.append(piece.reshape(n, m, count * (2 * l_out + 1), -1))
                starts[o] += m * count
            grad = torch.cat(pieces, dim=2).flatten(0, 1)
            grad = grad.view(*grad.shape[:2], out_planes, *self.shape[1:])
            back = conv3d_input(
                (n * m, 2 * degree + 1, X, Y, Z), self.kernels[i], grad, stride=self.g.stride
            )
            into[samples, channels, planes] += back.view(n, -1, X, Y, Z)


class FactorisedConvolution(torch.autograd.Function):
    """apply(x (B,C_in,X,Y,Z), geometry, *weights, one (m_o, Σ_i m_i·n_oi) per output degree)."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, geometry: Geometry, *weights: Tensor) -> Tensor:
        device = x.device.type
        dtype = torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else x.dtype
        ctx.geometry, ctx.dtypes = geometry, (x.dtype, [w.dtype for w in weights])
        with torch.autocast(device, enabled=False):
            weights = tuple(w.to(dtype) for w in weights)
            padded = nn.functional.pad(x.to(dtype), (geometry.padding,) * 6)
            slabs = _Slabs(geometry, padded)
            out = padded.new_empty(len(x), geometry.fields_out.channels, *slabs.shape)
            for samples, planes, read in slabs:
                for w, y, (_, _, channels) in zip(
                    weights, slabs.expand(samples, read), geometry.fields_out.degrees, strict=True
                ):
                    target = out[samples, channels, planes]
                    target.copy_((w @ y).view(target.shape))
        ctx.save_for_backward(padded, *weights)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (grad,) = grads
        padded, *weights = ctx.saved_tensors
        geometry: Geometry = ctx.geometry
        slabs = _Slabs(geometry, padded)
        need_x = ctx.needs_input_grad[0]
        grad_padded = torch.zeros_like(padded)
        grad_weights = [torch.zeros_like(w) for w in weights]
        with torch.autocast(padded.device.type, enabled=False):
            for samples, planes, read in slabs:
                grad_y = []
                for y, w, gw, (_, m, channels) in zip(
                    slabs.expand(samples, read),
                    weights,
                    grad_weights,
                    geometry.fields_out.degrees,
                    strict=True,
                ):
                    out = grad[samples, channels, planes].to(w.dtype)
                    out = out.reshape(len(out), m, -1)
                    gw += torch.einsum("nmv,nyv->my", out, y)
                    grad_y.append(w.T @ out)
                if need_x:
                    slabs.contract(grad_y, grad_padded, samples, read)
        p = geometry.padding
        inner = tuple(slice(p, n - p) for n in padded.shape[2:])
        x_dtype, w_dtypes = ctx.dtypes
        return (
            grad_padded[(slice(None), slice(None), *inner)].to(x_dtype) if need_x else None,
            None,
            *(g.to(t) for g, t in zip(grad_weights, w_dtypes, strict=True)),
        )
