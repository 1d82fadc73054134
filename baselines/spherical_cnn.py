"""Spherical CNN: zonal convolutions of the cloud's extent as a function on the sphere.

Source: Esteves, Allen-Blanchette, Makadia & Daniilidis, "Learning SO(3) Equivariant Representations
with Spherical CNNs", ECCV 2018; daniilidis-group/spherical-cnn@6ee06fa. One branch with one input
channel, the paper table's 1×64².

The published input is ray-cast from a mesh. A cloud has no faces, so the function is our choice::

    f(ω) = max_i ‖p_i‖ · exp(κ·(ω·p_i/‖p_i‖ − 1))

the upper envelope of one bump per point, as high as the point is far, a few grid cells wide. It
turns with the cloud exactly, needs no binning and so no filling of holes, and stays near zero in
directions that were not seen.
"""

from __future__ import annotations

import itertools

import numpy as np
import torch
from torch import Tensor, nn

from baselines.points import normalise
from baselines.spherical_transform import SphericalTransform, colatitudes, directions
from partialbench.benchmark.prediction import Prediction

RESOLUTION = 64
WIDTHS = (16, 16, 32, 32, 64, 64, 128, 128)
POOL_AFTER = (3, 5, 7)  # layers, counted from one
ANCHORS = 8

# Half height two cells (5.6°) off the point's direction.
CONCENTRATION = float(np.log(2) / (1 - np.cos(2 * np.pi / RESOLUTION)))

# Bytes of point-by-direction products kept at a time.
_CHUNK_BYTES = 256 << 20


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
        towards = CONCENTRATION * points.float() / radius
        # The maximum of exponentials is the exponential of a maximum of linear forms in ω.
        offset = radius.log() - CONCENTRATION
        chunk = max(1, _CHUNK_BYTES // (4 * len(omega) * max(1, points.shape[1])))
        envelopes = [
            torch.baddbmm(o.transpose(1, 2), omega.expand(len(t), -1, -1), t.transpose(1, 2)).amax(
                -1
            )
            for t, o in zip(towards.split(chunk), offset.split(chunk), strict=True)
        ]
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
            coefficients = self.transform(x.to(self.anchors.dtype))  # (m,l,B,C_in)
            filters = torch.einsum("ioa,al->lio", self.anchors, self.interpolation)
            pairs = torch.view_as_real(coefficients).movedim(-1, 2)  # (m,l,2,B,C_in)
            mixed = pairs.flatten(2, 3) @ filters
            mixed = mixed.unflatten(2, (2, x.shape[0])).movedim(2, -1).contiguous()
            return self.transform.inverse(torch.view_as_complex(mixed))


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
        return self.activation(self.norm(self.convolution(x)) + self.shift)


class AreaPool(nn.Module):
    """2×2 mean weighted by the cells' areas: (B,C,n,n) → (B,C,n/2,n/2)."""

    fine: Tensor
    coarse: Tensor

    def __init__(self, n: int) -> None:
        super().__init__()
        self.register_buffer("fine", cell_areas(n), persistent=False)
        self.register_buffer("coarse", cell_areas(n // 2), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        return nn.functional.avg_pool2d(x * self.fine, 2) / self.coarse


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
