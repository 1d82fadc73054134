"""Steerable kernel bases: the solutions of κ(R·v) = D^o(R)·κ(v)·D^i(R)⁻¹ sampled on a voxel grid.

This is the kernel constraint of Weiler et al. 2018 (section 3; eq. 4 of the PAPNet paper). It
decouples: for each degree J ∈ [|l_i − l_o|, l_i + l_o] one angular solution is Q_J·Y_J(v/‖v‖), to
be multiplied by any radial function. Q_J are Clebsch–Gordan coefficients, taken from e3nn as
Wigner 3j symbols; the radial functions are Gaussian shells exp(−(‖v‖ − r_k)²/2σ²) with r_k = 0, 1,
2, … voxels, and J is cut off per shell because a grid cannot tell higher harmonics apart.
"""

from __future__ import annotations

import math
from functools import cache

import torch
from e3nn import o3
from torch import Tensor

SHELL_WIDTH = 0.6
"""σ in voxels. Source: se3cnn@546bc68, the value of its released models."""

# Highest J on shell k: se3cnn's "compromise" between Nyquist's bound and its conservative choice.
DEGREE_CUT_OFF = (0, 3, 5, 7, 9, 11)


@cache
def kernel_basis(l_in: int, l_out: int, size: int) -> tuple[Tensor, tuple[tuple[int, int], ...]]:
    """Basis of the kernels from degree ``l_in`` to ``l_out``, each element of unit norm.

    Args:
        size: edge of the cubic kernel in voxels, odd.

    Returns:
        (basis (n,2·l_out+1,2·l_in+1,size,size,size) float64 with spatial axes (x, y, z),
        the n elements' (shell k, degree J), ordered by shell, then degree).
    """
    if size % 2 == 0 or size < 1 or size // 2 >= len(DEGREE_CUT_OFF):
        raise ValueError(
            f"kernel size must be odd and at most {2 * len(DEGREE_CUT_OFF) - 1}, got {size}"
        )
    axis = torch.arange(size, dtype=torch.float64) - size // 2
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
    radius = grid.norm(dim=-1)
    elements, labels = [], []
    for k in range(size // 2 + 1):
        shell = torch.exp(-((radius - k) ** 2) / (2 * SHELL_WIDTH**2))
        for J in range(abs(l_in - l_out), min(l_in + l_out, DEGREE_CUT_OFF[k]) + 1):
            Y = o3.spherical_harmonics(J, grid, normalize=True, normalization="norm")
            if J > 0:  # a direction-dependent kernel has no value where there is no direction
                Y = Y * (radius > 0)[..., None]
            Q = o3.wigner_3j(l_out, l_in, J, dtype=torch.float64)
            element = torch.einsum("oij,xyzj,xyz->oixyz", Q, Y, shell)
            elements.append(element / element.norm())
            labels.append((k, J))
    return torch.stack(elements), tuple(labels)


def kernel_gain(l_out: int, elements: int, fields_in: int) -> float:
    """√((2·l_out+1) / (n·Σm_in)), the gain that keeps a field's scale with N(0,1) weights."""
    return math.sqrt((2 * l_out + 1) / (elements * fields_in))
