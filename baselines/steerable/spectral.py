"""Convolution of small volumes in the frequency domain, for CPUs.

A convolution is a product at every frequency: with ^ the discrete Fourier transform over N³ voxels,
ŷ(ω) = K̂(ω)·x̂(ω), where K̂(ω) is one matrix, channels to channels. A volume of 9³ padded for 5³ taps
needs 1,183 such products of complex matrices (N = 13, half of the spectrum, as x is real) where the
sum over taps multiplies 274,625 matrices and vectors.

Volumes and kernels are small, so each axis is transformed by a matrix product, which reads no more
than the volume and writes no more than the output: no padding is stored. The stages are laid out so
that each one's result is, without moving a value, what the next reads::

    x (X,Y,Z,M) ──A₁──▶ (h,2,Y,Z·M) ──A₂──▶ (h,N,2,Z,M) ──A₃──▶ x̂ (h,N,N,2,M)

with h = N//2 + 1 frequencies of the first axis and 2 the real and imaginary parts. The inverse runs
the other way, and the gradients are the same stages transposed.

A stride S > 1 splits the volume and the kernel into S³ interleaved ones, so that the products are
of N³/S³ frequencies and S³ times the channels: what is not part of the output is not computed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from baselines.steerable.factorised import Geometry


@dataclass(frozen=True)
class Plan:
    """Sizes of one convolution on cubes.

    Attributes:
        edge, size, padding, stride: of the input, the kernel and the convolution.
    """

    edge: int
    size: int
    padding: int
    stride: int

    @property
    def out(self) -> int:
        """Edge of the output."""
        return (self.edge + 2 * self.padding - self.size) // self.stride + 1

    @property
    def part(self) -> int:
        """Edge of the interleaved parts of the input."""
        return -(-self.edge // self.stride)

    @property
    def shifts(self) -> range:
        """τ of the kernel's parts: for tap S·τ + r + p, r < S, y(u) reads x at S·(u + τ) + r."""
        first = -self.padding // self.stride
        return range(first, (self.size - 1 - self.padding) // self.stride + 1)

    @property
    def period(self) -> int:
        """N: the least at which no output reads a voxel one period off."""
        return max(self.part - self.shifts[0], self.out + max(self.shifts[-1], 0))

    @property
    def frequencies(self) -> int:
        """h·N·N."""
        return (self.period // 2 + 1) * self.period**2

    def spectrum_size(self, channels_in: int, channels_out: int) -> int:
        """Numbers in K̂."""
        return 2 * self.frequencies * self.stride**3 * channels_in * channels_out

    def work(self, channels_in: int, channels_out: int) -> int:
        """Multiplications for one volume: products and transforms."""

        def transform(edge: int) -> int:
            N, h = self.period, self.period // 2 + 1
            return 2 * h * edge**3 + 4 * h * N * edge**2 + 4 * h * N * N * edge

        transforms = channels_in * self.stride**3 * transform(self.part)
        transforms += channels_out * transform(self.out)
        return 2 * self.spectrum_size(channels_in, channels_out) + transforms

    def kernel_work(self, channels_in: int, channels_out: int) -> int:
        """What the kernel's own transform takes, as so many multiplications (it moves memory)."""
        return 25 * self.spectrum_size(channels_in, channels_out)

    def dense_work(self, channels_in: int, channels_out: int) -> int:
        """Multiplications of the sum over taps for one volume."""
        return self.size**3 * self.out**3 * channels_in * channels_out


class _Stage(NamedTuple):
    """Matrices of a transform: ``first`` (2h,X) of the first axis, ``others`` (2N,2X)."""

    first: Tensor
    others: Tensor

    def adjoint(self) -> _Stage:
        return _Stage(self.first.T.contiguous(), self.others.T.contiguous())


class _Stages(NamedTuple):
    volume: _Stage
    kernel: _Stage
    inverse: _Stage


@lru_cache(maxsize=64)
@torch.inference_mode(False)  # Kept for trainings to come, which save them for their backward pass.
def _stages(plan: Plan, dtype: torch.dtype, device: torch.device) -> _Stages:
    """The volume's transform, the kernel's, and the inverse's first (U,2h) and others (2U,2N)."""
    N = plan.period
    h = N // 2 + 1
    k = 2 * math.pi / N * torch.arange(N).double()

    def forward(sign: int, positions: range) -> _Stage:
        """Σ_j x_j·exp(sign·i·ω·j); rows (frequency, part), columns (part, position)."""
        angle = torch.outer(k, torch.tensor(positions).double())
        cos, sin = angle.cos(), sign * angle.sin()
        first = torch.stack([cos[:h], sin[:h]], dim=1).flatten(0, 1)
        real, imaginary = torch.cat([cos, -sin], dim=1), torch.cat([sin, cos], dim=1)
        return _Stage(first, torch.stack([real, imaginary], dim=1).flatten(0, 1))

    back = forward(-1, range(plan.out))
    # Frequencies k and N−k are conjugate: one stands for both, but 0 and N/2 are their own.
    count = torch.full((h, 1), 2 / N, dtype=torch.float64)
    count[0] = 1 / N
    if N % 2 == 0:
        count[-1] = 1 / N
    inverse = _Stage(back.first.T * count.repeat_interleave(2), back.others.T / N)
    stages = forward(-1, range(plan.part)), forward(1, plan.shifts), inverse
    return _Stages(*(_Stage(*(t.contiguous().to(device, dtype) for t in s)) for s in stages))


def _each(matrix: Tensor, batch: Tensor) -> Tensor:
    """matrix (R,C) · batch (n,C,M) → (n,R,M)."""
    return torch.bmm(matrix.expand(len(batch), -1, -1), batch)


def _analyse(x: Tensor, stage: _Stage) -> Tensor:
    """(X,X,X,M) → (h·N·N,2,M), the stage's matrices (2h,X) and (2N,2X)."""
    X, M = x.shape[0], x.shape[-1]
    h, N = len(stage.first) // 2, len(stage.others) // 2
    x = stage.first @ x.reshape(X, -1)
    x = _each(stage.others, x.view(h, 2 * X, X * M))
    return _each(stage.others, x.view(h * N, 2 * X, M)).view(h * N * N, 2, M)


def _synthesise(y: Tensor, stage: _Stage) -> Tensor:
    """(h·N·N,2,M) → (U,U,U,M), the stage's matrices (U,2h) and (2U,2N)."""
    U, M = len(stage.first), y.shape[-1]
    h, N = stage.first.shape[1] // 2, stage.others.shape[1] // 2
    y = _each(stage.others, y.reshape(h * N, 2 * N, M))
    y = _each(stage.others, y.view(h, 2 * N, U * M))
    return (stage.first @ y.view(2 * h, U * U * M)).view(U, U, U, M)


def _interleaved(x: Tensor, plan: Plan) -> Tensor:
    """(B,C,X,X,X) → (X/S,X/S,X/S,B·S³·C): the parts r of every voxel S·j + r, side by side."""
    S, n = plan.stride, plan.part
    if S > 1:
        x = pad(x, (0, S * n - plan.edge) * 3)
    x = x.reshape(*x.shape[:2], n, S, n, S, n, S)
    return x.permute(2, 4, 6, 0, 3, 5, 7, 1).reshape(n, n, n, -1)


def _reassembled(parts: Tensor, batch: int, plan: Plan) -> Tensor:
    """The inverse of ``_interleaved``."""
    S, n = plan.stride, plan.part
    x = parts.view(n, n, n, batch, S, S, S, -1).permute(3, 7, 0, 4, 1, 5, 2, 6)
    x = x.reshape(batch, -1, S * n, S * n, S * n)
    return x[..., : plan.edge, : plan.edge, : plan.edge]


def _interleaved_kernel(kernel: Tensor, plan: Plan) -> Tensor:
    """(C_out,C_in,s,s,s) → (T,T,T,S³·C_in·C_out) over the T shifts."""
    S, T = plan.stride, len(plan.shifts)
    if S > 1:
        before = -plan.padding - S * plan.shifts[0]
        kernel = pad(kernel, (before, S * T - before - plan.size) * 3)
    kernel = kernel.reshape(*kernel.shape[:2], T, S, T, S, T, S)
    return kernel.permute(2, 4, 6, 3, 5, 7, 1, 0).reshape(T, T, T, -1)


class _Convolve(torch.autograd.Function):
    """apply(x (B,C_in,X,X,X), K̂ (F,2·S³·C_in,C_out), plan) → (B,C_out,U,U,U)."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, kernel: Tensor, plan: Plan) -> Tensor:
        stages = _stages(plan, x.dtype, x.device)
        spectrum = _analyse(_interleaved(x, plan), stages.volume).unflatten(2, (len(x), -1))
        # (Re, −Im) and (Im, Re) against (Re; Im) of K̂: both parts of ŷ in one real product.
        real, imaginary = spectrum.unbind(1)
        upper = torch.stack([real, -imaginary], dim=2)
        rows = torch.stack([upper, spectrum.flip(1).transpose(1, 2)], dim=1)
        rows = rows.view(len(rows), 2 * len(x), -1)
        ctx.save_for_backward(rows, kernel)
        ctx.plan = plan
        y = torch.bmm(rows, kernel).view(len(rows), 2, -1)
        out = _synthesise(y, stages.inverse)
        return out.unflatten(3, (len(x), -1)).permute(3, 4, 0, 1, 2)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, d_out: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        rows, kernel = ctx.saved_tensors
        plan: Plan = ctx.plan
        stages = _stages(plan, d_out.dtype, d_out.device)
        d_y = d_out.permute(2, 3, 4, 0, 1).reshape(plan.out, plan.out, plan.out, -1)
        d_y = _analyse(d_y, stages.inverse.adjoint()).view(len(rows), 2 * len(d_out), -1)
        d_kernel = torch.bmm(rows.mT, d_y) if ctx.needs_input_grad[1] else None
        d_x = None
        if ctx.needs_input_grad[0]:
            d_rows = torch.bmm(d_y, kernel.mT).view(len(rows), 2, len(d_out), 2, -1)
            real = d_rows[:, 0, :, 0] + d_rows[:, 1, :, 1]
            imaginary = d_rows[:, 1, :, 0] - d_rows[:, 0, :, 1]
            d_spectrum = torch.stack([real, imaginary], dim=1).flatten(2)
            d_x = _synthesise(d_spectrum, stages.volume.adjoint())
            d_x = _reassembled(d_x, len(d_out), plan)
        return d_x, d_kernel, None


def transform(kernel: Tensor, plan: Plan) -> Tensor:
    """K̂ (F,2·S³·C_in,C_out) of a kernel (C_out,C_in,s,s,s), with gradient."""
    stages = _stages(plan, kernel.dtype, kernel.device)
    spectrum = _analyse(_interleaved_kernel(kernel, plan), stages.kernel)
    return spectrum.view(plan.frequencies, -1, len(kernel))


def convolve(x: Tensor, spectrum: Tensor, plan: Plan) -> Tensor:
    """``conv3d`` of a cube (B,C_in,X,X,X) → (B,C_out,U,U,U), the kernel given by its K̂."""
    return _Convolve.apply(x, spectrum, plan)


def convolve_factorised(x: Tensor, geometry: Geometry, weights: list[Tensor], plan: Plan) -> Tensor:
    """The steerable convolution of a cube: its basis in the frequency domain, then the mixing.

    Where few fields become many scalars, the basis makes fewer volumes than come out.

    Args:
        x: (B,C_in,X,X,X).
        weights: one (m_o,Σ_i m_i·n_oi) per output degree.

    Returns:
        (B,C_out,U,U,U).
    """
    per_input = []
    for i, (degree, m, channels) in enumerate(geometry.fields_in.degrees):
        fields = x[:, channels].reshape(-1, 2 * degree + 1, *x.shape[2:])
        kernel = geometry.stacked(i, x.dtype)
        y = convolve(fields, transform(kernel, plan), plan)
        # As it lies in memory: (U,U,U,B·m,Σ_o n·(2l_o+1)).
        per_input.append(y.permute(2, 3, 4, 0, 1).unflatten(3, (-1, m)))
    outputs = []
    starts = [0] * len(per_input)
    for row, weight, (l_out, _, _) in zip(
        geometry.basis, weights, geometry.fields_out.degrees, strict=True
    ):
        pieces = []
        for i, (y, pair) in enumerate(zip(per_input, row, strict=True)):
            width = len(pair) * (2 * l_out + 1)
            piece = y[..., starts[i] : starts[i] + width].unflatten(-1, (len(pair), -1))
            pieces.append(piece.permute(0, 1, 2, 3, 6, 4, 5).flatten(5))
            starts[i] += width
        mixed = torch.cat(pieces, dim=-1) @ weight.T
        # (U,U,U,B,2l_o+1,m_o) → (B,m_o·(2l_o+1),U,U,U)
        outputs.append(mixed.permute(3, 5, 4, 0, 1, 2).flatten(1, 2))
    return torch.cat(outputs, dim=1) if len(outputs) > 1 else outputs[0]
