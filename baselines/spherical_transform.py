"""The spherical harmonic transform of band-limited functions on an equiangular grid.

Source: Driscoll & Healy, "Computing Fourier transforms and convolutions on the 2-sphere", Advances
in Applied Mathematics 1994. An n×n grid (n even) at colatitudes θ_j = πj/n and longitudes
φ_k = 2πk/n determines every function of degree below n/2 exactly. The harmonics Y_lm are the
orthonormal complex ones with the Condon–Shortley phase; a real function's are known from m ≥ 0.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import gammaln, lpmv
from torch import Tensor, nn


def colatitudes(n: int) -> NDArray[np.float64]:
    """θ_j = πj/n, (n,) radians; the first is the north pole, the south pole is not sampled."""
    return np.pi * np.arange(n) / n


def longitudes(n: int) -> NDArray[np.float64]:
    """φ_k = 2πk/n, (n,) radians."""
    return 2 * np.pi * np.arange(n) / n


def directions(n: int) -> NDArray[np.float64]:
    """(n,n,3) float64 unit vectors of the grid, θ along the rows: z is cos θ."""
    theta, phi = np.meshgrid(colatitudes(n), longitudes(n), indexing="ij")
    return np.stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1
    )


@cache
def quadrature_weights(n: int) -> NDArray[np.float64]:
    """w (n,), read-only: Σ_j w_j·p(cos θ_j) = ∫₋₁¹ p(t) dt for polynomials of degree below n.

    w_j = (4/n)·sin θ_j·Σ_{k<n/2} sin((2k+1)θ_j)/(2k+1) (Driscoll & Healy, theorem 3).
    """
    if n < 2 or n % 2:
        raise ValueError(f"the grid must have an even number of rows, got {n}")
    theta = colatitudes(n)
    odd = 2 * np.arange(n // 2) + 1
    weights = 4 / n * np.sin(theta) * (np.sin(np.outer(theta, odd)) / odd).sum(1)
    weights.setflags(write=False)
    return weights


@cache
def legendre(n: int) -> NDArray[np.float64]:
    """(m,l,j) orthonormal associated Legendre functions at the grid's cos θ_j, read-only.

    Y_lm(θ_j, φ) = legendre[m,l,j]·exp(imφ); entries with m > l are zero; m, l < n/2.
    """
    band = n // 2
    m, l = np.meshgrid(np.arange(band), np.arange(band), indexing="ij")  # noqa: E741
    log_norm = (np.log((2 * l + 1) / (4 * np.pi)) + gammaln(np.maximum(l - m, 0) + 1)) / 2
    log_norm = log_norm - gammaln(l + m + 1) / 2
    values = lpmv(m[..., None], l[..., None], np.cos(colatitudes(n)))
    table = np.where((m <= l)[..., None], np.exp(log_norm)[..., None] * values, 0.0)
    table.setflags(write=False)
    return table


class SphericalTransform(nn.Module):
    """Forward and inverse transform at one resolution, as matrix products along φ and along θ.

    A product along φ reads and writes each value once, in the order in which it lies; a fast
    transform would save multiplications and pay for them in moved memory.

    Args:
        n: rows and columns of the grid, even; degrees below n/2 are kept.
    """

    waves: Tensor
    back: Tensor
    analysis: Tensor
    synthesis: Tensor

    def __init__(self, n: int) -> None:
        super().__init__()
        self.n, self.band = n, n // 2
        table = legendre(n)
        angle = np.outer(np.arange(self.band), longitudes(n))
        waves = np.concatenate([np.cos(angle), -np.sin(angle)])  # (2·m,φ)
        # A real function's m < 0 repeat its m > 0.
        twice = np.where(np.arange(self.band) > 0, 2.0, 1.0)
        back = waves.T * np.tile(twice, 2)
        # ∫ over φ is a sum times 2π/n.
        analysis = table * quadrature_weights(n) * (2 * np.pi / n)
        constants = {
            "waves": waves, "back": back,
            # Once for the real and once for the imaginary parts.
            "analysis": np.concatenate([analysis] * 2),
            "synthesis": np.concatenate([table.transpose(0, 2, 1)] * 2),
        }  # fmt: skip
        for name, value in constants.items():
            self.register_buffer(name, torch.tensor(value).float(), persistent=False)

    def analyse(self, x: Tensor) -> Tensor:
        """Real functions (φ,θ,K) → (2,m,l,K), real and imaginary parts, m ≥ 0."""
        waves = self.waves.to(x.dtype) @ x.flatten(1)
        found = torch.bmm(self.analysis.to(x.dtype), waves.view(2 * self.band, self.n, -1))
        return found.view(2, self.band, self.band, -1)

    def synthesise(self, coefficients: Tensor) -> Tensor:
        """(2,m,l,K) → real functions (φ,θ,K)."""
        matrices = self.synthesis.to(coefficients.dtype)
        waves = torch.bmm(matrices, coefficients.flatten(0, 1))
        return (self.back.to(coefficients.dtype) @ waves.flatten(1)).view(self.n, self.n, -1)

    def forward(self, x: Tensor) -> Tensor:
        """Real functions (…,n,n), θ then φ → coefficients (m,l,…) complex, m ≥ 0."""
        columns = x.movedim((-1, -2), (0, 1)).reshape(self.n, self.n, -1)
        parts = self.analyse(columns).movedim(0, -1).contiguous()
        return torch.view_as_complex(parts).view(self.band, self.band, *x.shape[:-2])

    def inverse(self, coefficients: Tensor) -> Tensor:
        """Coefficients (m,l,…) complex → real functions (…,n,n)."""
        parts = torch.view_as_real(coefficients.resolve_conj()).movedim(-1, 0)
        x = self.synthesise(parts.reshape(2, self.band, self.band, -1))
        return x.view(self.n, self.n, *coefficients.shape[2:]).movedim((0, 1), (-1, -2))
