"""Local reference axes: the direction in which a neighbourhood is thinnest, as a normal is.

Source: Zhang et al., RIConv++, IJCV 2022; cszyzhang/riconv2@70d9297 (weights, and that the scatter
is about the point). No gradient: axes are geometry.
"""

from __future__ import annotations

import torch
from torch import Tensor

from baselines.points import require_sound
from partialbench.errors import InputError

LEAST_OF_AXES = 4
"""Neighbours, the point itself included, that say which way is thinnest: the farthest has no weight
and the point itself no length, and of fewer than two others every axis across is as thin."""


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Scalar products of (…,3) vectors."""
    return (a * b).sum(dim=-1)


def unit(vectors: Tensor) -> Tensor:
    """Vectors (…,3) of length 1; those of no length remain so."""
    length = torch.linalg.vector_norm(vectors, dim=-1, keepdim=True)
    return vectors / length.masked_fill(length == 0, 1)


def as_normals(normals: Tensor, points: Tensor) -> Tensor:
    """The normals of clouds (B,N,3), (B,N,3) of any length, as float64 of length 1 or 0.

    Raises:
        InputError: for another shape or dtype, or normals that are not finite; on other devices
            than the CPU torch's own error for the last.
    """
    if normals.shape != points.shape or not normals.is_floating_point():
        raise InputError(
            f"normals must be a floating tensor of the clouds' own shape {tuple(points.shape)}, "
            f"one for each point; got {tuple(normals.shape)} {normals.dtype}"
        )
    finite = normals.isfinite().all(dim=-1).flatten()
    require_sound(
        finite, "normals are not finite",
        lambda _: f"{int((~finite).sum())} of {len(finite)} normals are NaN or infinite",
    )  # fmt: skip
    return unit(normals.double())


def require_signs(orient: str, quirks: frozenset[str]) -> None:
    """Raises ``InputError`` where axes are to be turned to the camera and to be left unturned."""
    if orient == "camera" and "signs" in quirks:
        raise InputError(
            "orient=camera turns local axes, which quirks=signs leaves as they come; give one"
        )


@torch.no_grad()
def local_axes(relative: Tensor) -> Tensor:
    """The axis of each point, of no particular sign.

    It is the eigenvector of the smallest eigenvalue of Σ w_j·r_j·r_jᵀ, r_j neighbour j as seen from
    the point and w_j = (r_max − |r_j|)/Σ(r_max − |r|), which is 1 where all are equally far.

    Args:
        relative: (…,n,3) neighbours less their point.

    Returns:
        (…,3) unit vectors.
    """
    length = torch.linalg.vector_norm(relative, dim=-1)
    weight = length.amax(dim=-1, keepdim=True) - length
    total = weight.sum(dim=-1, keepdim=True)
    weight = torch.where(total > 0, weight / total, 1.0)
    scatter = (weight[..., None] * relative).mT @ relative
    return torch.linalg.eigh(scatter).eigenvectors[..., 0]


def facing(axes: Tensor, direction: Tensor) -> Tensor:
    """The axes (…,3), turned round where they point against the direction (…,3)."""
    return torch.where(dot(axes, direction)[..., None] < 0, -axes, axes)
