"""Rotating a feature volume: (T_R f)(v) = ρ(R)·f(R⁻¹v), the paper's eq. 2."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from baselines.steerable import Fields


def resample(field: Tensor, rotation: Tensor) -> Tensor:
    """f(R⁻¹v) by trilinear interpolation about the volume's centre, zero outside.

    Args:
        field: (B,C,X,Y,Z), a cube.
        rotation: (B,3,3).

    Returns:
        (B,C,X,Y,Z).
    """
    edge = field.shape[-1]
    centre = (2 * torch.arange(edge, device=field.device, dtype=torch.float32) + 1) / edge - 1
    v = torch.stack(torch.meshgrid(centre, centre, centre, indexing="ij"), dim=-1).view(-1, 3)
    with torch.autocast(field.device.type, enabled=False):
        source = v @ rotation.detach().to(v.dtype)  # rows: R⁻¹v = Rᵀv = (vᵀR)ᵀ
    # grid_sample wants (B,X,Y,Z,3) with the last axis of the volume first.
    grid = source.flip(-1).view(len(rotation), edge, edge, edge, 3).to(field.dtype)
    return nn.functional.grid_sample(field, grid, align_corners=False)


def rotate_field(field: Tensor, rotation: Tensor, fields: Fields) -> Tensor:
    """(T_R f)(v) = ρ(R)·f(R⁻¹v). No gradient flows to the rotation, as in the release.

    Args:
        field: (B,C,X,Y,Z), a cube with axes (x, y, z), components in e3nn's basis.
        rotation: (B,3,3) R. A field seen under object → camera R is brought to the object's frame
            by Rᵀ.
        fields: what the C channels are.

    Returns:
        (B,C,X,Y,Z).

    Source: TerenceHsu666/PAPNet@878adcc; its change of axes to se3cnn's (y, z, x) is not needed in
    e3nn's own basis.
    """
    if rotation.shape != (len(field), 3, 3):
        raise ValueError(
            f"expected one rotation per field, shape {(len(field), 3, 3)}, "
            f"got {tuple(rotation.shape)}"
        )
    return fields.rotate_components(resample(field, rotation), fields.wigner(rotation))
