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
    """Forward and inverse transform at one resolution, as matrix products after an FFT over φ.

    Args:
        n: rows and columns of the grid, even; degrees below n/2 are kept.
    """

    analysis: Tensor
    synthesis: Tensor

    def __init__(self, n: int) -> None:
        super().__init__()
        self.n, self.band = n, n // 2
        table = legendre(n)
        # ∫ over φ is a sum times 2π/n.
        analysis = table * quadrature_weights(n) * (2 * np.pi / n)
        self.register_buffer("analysis", torch.tensor(analysis).float(), persistent=False)
        synthesis = table.transpose(0, 2, 1)
        self.register_buffer("synthesis", torch.tensor(synthesis).float(), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """Real functions (…,n,n), θ then φ → coefficients (m,l,…) complex, m ≥ 0."""
        waves = torch.fft.rfft(x, dim=-1)[..., : self.band]  # (…,θ,m)
        waves = waves.movedim((-1, -2), (0, 1))  # (m,θ,…)
        return _multiply(self.analysis.to(x.dtype), waves)

    def inverse(self, coefficients: Tensor) -> Tensor:
        """Coefficients (m,l,…) complex → real functions (…,n,n)."""
        waves = _multiply(self.synthesis.to(coefficients.real.dtype), coefficients)
        waves = waves.movedim((0, 1), (-1, -2))
        return torch.fft.irfft(waves * self.n, n=self.n, dim=-1)


def _multiply(matrix: Tensor, waves: Tensor) -> Tensor:
    """(m,a,b) real × (m,b,…) complex → (m,a,…), as one real product."""
    pairs = torch.view_as_real(waves.resolve_conj())
    product = matrix @ pairs.reshape(*pairs.shape[:2], -1)
    return torch.view_as_complex(product.view(*product.shape[:2], *pairs.shape[2:]))
