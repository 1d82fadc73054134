"""A cloud as one steerable descriptor: point features pooled against steerable fields."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from baselines.camera import camera_ray
from baselines.points import as_weights, full_precision, normalise
from baselines.processes import pooled
from papnet.steered.encoder import Encoder
from papnet.steered.geometry import geometry, num_fields
from partialbench.errors import InputError


class Descriptor(NamedTuple):
    """What is known of a cloud.

    Attributes:
        steerable: {l: (B,C,2l+1)}, turned by D^l(R) when the cloud is turned by R; e3nn's basis.
        invariant: (B,W), untouched by it.
    """

    steerable: dict[int, Tensor]
    invariant: Tensor


class DegreeNorm(nn.Module):
    """Batch norm of steerable channels: only degree 0 has a mean, a scale is one a channel."""

    def __init__(self, channels: int, degree: int, momentum: float = 0.1) -> None:
        super().__init__()
        self.degree, self.momentum, self.eps = degree, momentum, 1e-5
        self.mean: Tensor
        self.square: Tensor
        self.register_buffer("mean", torch.zeros(channels))
        self.register_buffer("square", torch.ones(channels))

    def forward(self, x: Tensor) -> Tensor:
        """(B,C,2l+1)."""
        mean, square = self.mean, self.square
        if self.training:
            mean = x.mean((0, 2)) if self.degree == 0 else torch.zeros_like(mean)
            square = (x - mean[:, None]).square().mean((0, 2))
            mean, square, count = pooled(mean, square, len(x) * x.shape[2])
            if isinstance(count, int) and count < 2:
                # A cloud less its own mean is nothing, and every cloud would look alike.
                raise ValueError(
                    f"batch norm needs more than one value a channel in training, got {count}"
                )
            with torch.no_grad():
                self.mean.lerp_(mean.to(self.mean.dtype), self.momentum)
                self.square.lerp_(square.to(self.square.dtype), self.momentum)
        return (x - mean[:, None]) * torch.rsqrt(square + self.eps)[:, None]


class Describe(nn.Module):
    """Clouds → their descriptors, exactly equivariant: no grid, no sampling of directions.

    Args:
        lmax: highest degree.
        channels: C, of every degree.
        width: W, of the point features.
        k: nearest neighbours.
        scales: of wide neighbourhoods, 1 or 2.
        ray: whether the direction from the camera to the cloud is seen. Clouds must then be in the
            camera's frame, and what is equivariant is a turn about the camera, or of camera and
            cloud together.
    """

    def __init__(
        self, lmax: int, channels: int, width: int, k: int, scales: int = 1, ray: bool = False
    ) -> None:
        super().__init__()
        self.lmax, self.k, self.scales, self.ray = lmax, k, scales, ray
        self.encoder = Encoder(lmax, width, scales, ray)
        fields = num_fields(scales, ray)
        # No bias: none is equivariant above degree 0, and the norm cancels it there.
        self.mix = nn.ModuleList(
            nn.Linear(fields * width, channels, bias=False) for _ in range(lmax + 1)
        )
        self.norm = nn.ModuleList(DegreeNorm(channels, degree) for degree in range(lmax + 1))

    def forward(self, points: Tensor) -> Descriptor:
        """(B,N,3) clouds of any position and scale, N > k.

        Raises:
            InputError: for clouds of another shape or of too few points, and where the ray is seen
                for centred ones, which have none.
        """
        observed, points = points, as_weights(normalise(points), self)
        if points.shape[1] <= self.k:
            raise InputError(
                f"{self.k} neighbours need clouds of at least {self.k + 1} points, "
                f"got {points.shape[1]}"
            )
        ray = camera_ray(observed).to(points.dtype) if self.ray else None
        g = geometry(points, self.k, self.lmax, self.scales, ray)
        features = self.encoder(g)
        with torch.autocast(points.device.type, enabled=False):
            features = full_precision(features)
            # (B,fields,M,W): the mean over points of field times feature.
            pooled = g.fields.flatten(2).mT @ features / points.shape[1]
            pooled = pooled.unflatten(1, g.fields.shape[2:])
            steerable = {}
            for degree, (mix, norm) in enumerate(zip(self.mix, self.norm, strict=True)):
                part = pooled[:, :, degree**2 : (degree + 1) ** 2].transpose(1, 2).flatten(2)
                steerable[degree] = norm(mix(part).mT)
            return Descriptor(steerable, features.amax(1))
