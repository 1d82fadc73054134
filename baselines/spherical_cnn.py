"""Spherical CNN: zonal convolutions of the cloud's extent as a function on the sphere.

Source: Esteves, Allen-Blanchette, Makadia & Daniilidis, "Learning SO(3) Equivariant Representations
with Spherical CNNs", ECCV 2018; daniilidis-group/spherical-cnn@6ee06fa. One branch with one input
channel, the paper table's 1×64².

The published input is ray-cast from a mesh. A cloud has no faces, so the function is our choice::

    f(ω) = max_i ‖p_i‖ · exp(κ·(ω·p_i/‖p_i‖ − 1))

the upper envelope of one bump per point, as high as the point is far, a few grid cells wide. It
turns with the cloud exactly, needs no binning and so no filling of holes, and stays near zero in
directions that were not seen.

Functions are (B,C,n,n) tensors that lie in memory as (φ,θ,B,C): every stage is then a product or a
pass over what is there, and nothing is moved.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from baselines.chunks import chunks
from baselines.points import normalise
from baselines.spherical_transform import SphericalTransform, colatitudes, directions
from partialbench.benchmark.prediction import Prediction

RESOLUTION = 64
WIDTHS = (16, 16, 32, 32, 64, 64, 128, 128)
POOL_AFTER = (3, 5, 7)  # layers, counted from one
ANCHORS = 8

# Half height two cells (5.6°) off the point's direction.
CONCENTRATION = float(np.log(2) / (1 - np.cos(2 * np.pi / RESOLUTION)))

# Bytes of point-by-direction products kept at a time; on a CPU (True) what a cache holds.
_CHUNK_BYTES = {True: 4 << 20, False: 256 << 20}


def extent(points: Tensor, n: int = RESOLUTION) -> Tensor:
    """The spherical function f above on the n×n grid.

    Args:
        points: (B,N,3), about the origin.

    Returns:
        (B,n,n) float32, θ along the rows. No gradient flows to the points.
    """
    with torch.no_grad(), torch.autocast(points.device.type, enabled=False):
        omega = torch.as_tensor(directions(n).reshape(-1, 3), dtype=torch.float32)
        omega = omega.to(points.device)
        radius = points.float().norm(dim=-1, keepdim=True).clamp_min(1e-9)
        # The maximum of exponentials is the exponential of a maximum of linear forms in (ω, 1).
        omega = nn.functional.pad(omega, (0, 1), value=1.0)
        offset = radius.log() - CONCENTRATION
        forms = torch.cat([CONCENTRATION * points.float() / radius, offset], dim=-1)
        chunk = max(
            1, _CHUNK_BYTES[points.device.type == "cpu"] // (4 * len(omega) * points.shape[1])
        )
        envelopes = [(omega @ part.mT).amax(-1) for part in forms.split(chunk)]
        return torch.cat(envelopes).exp().view(len(points), n, n)


def cell_areas(n: int) -> Tensor:
    """(n,1) float32, sin(θ_j + half a cell): each row's cell area up to a factor."""
    return torch.tensor(np.sin(colatitudes(n) + np.pi / n / 2), dtype=torch.float32)[:, None]


class ZonalConvolution(nn.Module):
    """ĉ_lm = Σ_channels 2π·√(4π/(2l+1))·f̂_lm·ĥ_l, with ĥ linear between few learned anchors.

    Convolution on the sphere with a zonal filter; interpolating its spectrum between ``ANCHORS``
    values over l ∈ [0, n/2) keeps it smooth, and so the filter local.
    """

    interpolation: Tensor

    def __init__(self, channels_in: int, channels_out: int, n: int) -> None:
        super().__init__()
        self.transform = SphericalTransform(n)
        band = n // 2
        anchors = min(ANCHORS, band)
        std = 2 / (2 * np.pi * np.sqrt(band * channels_in))
        self.anchors = nn.Parameter(torch.empty(channels_in, channels_out, anchors))
        nn.init.trunc_normal_(self.anchors, std=std, a=-2 * std, b=2 * std)
        at = np.linspace(0, anchors - 1, band)
        hats = np.maximum(0, 1 - np.abs(at - np.arange(anchors)[:, None]))
        gain = 2 * np.pi * np.sqrt(4 * np.pi / (2 * np.arange(band) + 1))
        interpolation = torch.tensor(hats * gain, dtype=torch.float32)
        self.register_buffer("interpolation", interpolation, persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """(B,C_in,n,n) → (B,C_out,n,n)."""
        # Transforms lose too much in half precision.
        with torch.autocast(x.device.type, enabled=False):
            columns = x.to(self.anchors.dtype).permute(3, 2, 0, 1)
            coefficients = self.transform.analyse(columns.flatten(2))  # (2,m,l,B·C_in)
            filters = torch.einsum("ioa,al->lio", self.anchors, self.interpolation)
            mixed = coefficients.unflatten(3, (len(x), -1)) @ filters
            y = self.transform.synthesise(mixed.flatten(3))
            return y.unflatten(2, (len(x), -1)).permute(2, 3, 1, 0)


class _ShiftedPReLU(torch.autograd.Function):
    """PReLU of x + shift, rows (R,C), shift and slope (C,)."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, shift: Tensor, slope: Tensor) -> Tensor:
        out = torch.empty_like(x)
        for part in chunks(len(x), 8 * x.shape[1], x.device):
            z = torch.add(x[part], shift, out=out[part])
            z.addcmul_(z.clamp_max(0), slope - 1)
        ctx.save_for_backward(x, shift, slope)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_out: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x, shift, slope = ctx.saved_tensors
        d_x, d_shift, d_slope = (
            torch.empty_like(x),
            torch.zeros_like(shift),
            torch.zeros_like(slope),
        )
        for part in chunks(len(x), 8 * x.shape[1], x.device):
            d, z = d_out[part], x[part] + shift
            positive = torch.ops.aten.threshold_backward(d, z, 0)
            torch.addcmul(positive, d - positive, slope, out=d_x[part])
            d_shift += d_x[part].sum(dim=0)
            d_slope += z.clamp_max_(0).mul_(d).sum(dim=0)
        return d_x, d_shift, d_slope


class Block(nn.Module):
    """Zonal convolution, batch norm with a shift but no scale, per-channel PReLU."""

    def __init__(self, channels_in: int, channels_out: int, n: int) -> None:
        super().__init__()
        self.convolution = ZonalConvolution(channels_in, channels_out, n)
        self.norm = nn.BatchNorm2d(channels_out, eps=1e-3, affine=False)
        self.shift = nn.Parameter(torch.zeros(channels_out, 1, 1))
        self.activation = nn.PReLU(channels_out, init=0.1)

    def forward(self, x: Tensor) -> Tensor:
        """(B,C_in,n,n) → (B,C_out,n,n)."""
        y = self.convolution(x).permute(3, 2, 0, 1)
        rows = self.norm(y.reshape(-1, y.shape[3], 1, 1)).view(-1, y.shape[3])
        rows = _ShiftedPReLU.apply(rows, self.shift.flatten(), self.activation.weight)
        return rows.view(y.shape).permute(2, 3, 1, 0)


class AreaPool(nn.Module):
    """2×2 mean weighted by the cells' areas: (B,C,n,n) → (B,C,n/2,n/2)."""

    upper: Tensor
    lower: Tensor

    def __init__(self, n: int) -> None:
        super().__init__()
        share = cell_areas(n) / (4 * cell_areas(n // 2).repeat_interleave(2, dim=0))
        self.register_buffer("upper", share[0::2, :, None], persistent=False)
        self.register_buffer("lower", share[1::2, :, None], persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        pairs = x.permute(3, 2, 0, 1).unflatten(0, (-1, 2)).unbind(1)  # of φ
        upper, lower = (pairs[0] + pairs[1]).unflatten(1, (-1, 2)).unbind(2)  # of θ
        return torch.addcmul(upper * self.upper, lower, self.lower).permute(2, 3, 1, 0)


class SphericalCNN(nn.Module):
    """Eight zonal convolutions from 64² to 8², an area-weighted mean, one linear layer."""

    areas: Tensor

    def __init__(self, num_classes: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        n = RESOLUTION
        for i, (a, b) in enumerate(itertools.pairwise((1, *WIDTHS)), start=1):
            layers.append(Block(a, b, n))
            if i in POOL_AFTER:
                layers.append(AreaPool(n))
                n //= 2
        self.layers = nn.Sequential(*layers)
        self.register_buffer("areas", cell_areas(n), persistent=False)
        self.classifier = nn.Linear(WIDTHS[-1], num_classes)

    def forward(self, points: Tensor) -> Prediction:
        """(B,N,3) clouds, any scale and position → class logits (B,K)."""
        x = self.layers(extent(normalise(points))[:, None])
        return Prediction(self.classifier((x * self.areas).mean((2, 3))))
