"""What the channels of a feature volume are: copies of the irreducible representations of SO(3)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from e3nn import o3
from torch import Tensor


@dataclass(frozen=True)
class Fields:
    """A stack of fields: ``multiplicities[l]`` fields of degree l, each of 2l+1 channels.

    Channels are ordered by degree, then field, then component, as e3nn orders
    "4x0e+4x1e+…". The paper's tuple (8,4,2) is ``Fields((8, 4, 2))``.
    """

    multiplicities: tuple[int, ...]

    def __post_init__(self) -> None:
        if not self.multiplicities or min(self.multiplicities) < 0 or not self.count:
            raise ValueError(
                f"multiplicities must be non-negative and not all zero, got {self.multiplicities}"
            )

    @property
    def count(self) -> int:
        """Number of fields."""
        return sum(self.multiplicities)

    @property
    def channels(self) -> int:
        """Number of channels, Σ_l m_l·(2l+1)."""
        return sum(m * (2 * degree + 1) for degree, m in enumerate(self.multiplicities))

    @property
    def degrees(self) -> list[tuple[int, int, slice]]:
        """(degree, multiplicity, channel slice) of every degree that is present."""
        present, start = [], 0
        for degree, m in enumerate(self.multiplicities):
            stop = start + m * (2 * degree + 1)
            if m:
                present.append((degree, m, slice(start, stop)))
            start = stop
        return present

    def wigner(self, rotation: Tensor) -> dict[int, Tensor]:
        """Each present degree's Wigner matrix D^l(R): {l: (…,2l+1,2l+1)} in ``rotation``'s dtype.

        Args:
            rotation: (…,3,3). No gradient flows to it.
        """
        return {degree: wigner_matrix(degree, rotation) for degree, _, _ in self.degrees}

    def rotate_components(self, field: Tensor, wigner: dict[int, Tensor]) -> Tensor:
        """ρ(R) applied to channels alone, the volume left where it is.

        Args:
            field: (B,C,…) with C = ``channels``.
            wigner: {l: (2l+1,2l+1) or (B,2l+1,2l+1)}, as from ``wigner``.

        Returns:
            (B,C,…).
        """
        if field.shape[1] != self.channels:
            raise ValueError(
                f"field has {field.shape[1]} channels, {self} has {self.channels}; "
                f"expected shape (B,{self.channels},…)"
            )
        parts = []
        for degree, m, channels in self.degrees:
            part = field[:, channels].reshape(len(field), m, 2 * degree + 1, -1)
            if degree:
                matrix = wigner[degree].to(field.dtype)
                part = (matrix[:, None] if matrix.dim() == 3 else matrix) @ part
            parts.append(part.reshape(len(field), m * (2 * degree + 1), *field.shape[2:]))
        return torch.cat(parts, dim=1)


@lru_cache(maxsize=32)
def _probes(degree: int) -> tuple[Tensor, Tensor]:
    """Fixed directions p and the pseudo-inverse of Y_l(p), float64."""
    generator = torch.Generator().manual_seed(degree)
    p = torch.randn(4 * (2 * degree + 1), 3, generator=generator, dtype=torch.float64)
    p = torch.nn.functional.normalize(p, dim=1)
    return p, torch.linalg.pinv(_harmonics(degree, p))


def _harmonics(degree: int, directions: Tensor) -> Tensor:
    return o3.spherical_harmonics(degree, directions, normalize=True, normalization="norm")


def wigner_matrix(degree: int, rotation: Tensor) -> Tensor:
    """D^l(R) in e3nn's basis, (…,2l+1,2l+1), from its definition Y_l(R·p) = D^l(R)·Y_l(p).

    Solved in float64 over fixed directions p; e3nn's own route through Euler angles loses half of
    the digits at β = 0, where R is near a turn about y. The result carries no gradient.
    """
    if degree == 0:
        return rotation.new_ones(*rotation.shape[:-2], 1, 1)
    p, inverse = (t.to(rotation.device) for t in _probes(degree))
    with torch.no_grad():
        turned = torch.einsum("...ij,kj->...ki", rotation.detach().double(), p)
        return (inverse @ _harmonics(degree, turned)).transpose(-1, -2).to(rotation.dtype)
