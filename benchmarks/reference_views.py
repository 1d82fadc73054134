"""SimpleView and Spherical CNN as their publications run them, for measuring against; not for use.

Each is our model with the parts replaced in which ours differs, so the weights are the same and the
answers must be.

Source: princeton-vl/SimpleView@64c6dfe; daniilidis-group/spherical-cnn@6ee06fa ("naive" transform:
one product with every harmonic on the whole grid). Formulation only.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from baselines.points import normalise
from baselines.simpleview import CAMERA_DISTANCE, IMAGE, SimpleView, view_rotations
from baselines.spherical_cnn import SphericalCNN
from baselines.spherical_transform import (
    SphericalTransform,
    legendre,
    longitudes,
    quadrature_weights,
)
from partialbench.benchmark.prediction import Prediction


def depth_images_by_view(points: Tensor) -> Tensor:
    """(B,N,3) → (B,6,128,128), one view after another by accumulating index assignment."""
    images = []
    cloud = torch.arange(len(points))[:, None].expand(points.shape[:2])
    for R in view_rotations().to(points.dtype):
        seen = points @ R.T
        z = seen[..., 2] + CAMERA_DISTANCE
        column = torch.ceil((seen[..., 0] / z + 1) * IMAGE / 2 - 0.5).long()
        row = torch.ceil((seen[..., 1] / z + 1) * IMAGE / 2 - 0.5).long()
        ok = (column >= 0) & (column < IMAGE) & (row >= 0) & (row < IMAGE)
        index = (cloud[ok], column[ok], row[ok])
        total = points.new_zeros(len(points), IMAGE, IMAGE)
        count = torch.zeros_like(total)
        total.index_put_(index, 1 / z[ok], accumulate=True)
        count.index_put_(index, torch.ones_like(z[ok]), accumulate=True)
        images.append(torch.where(count > 0, count / total.clamp_min(1e-12), 0.0))
    return torch.stack(images, dim=1)


class PublishedSimpleView(SimpleView):
    def __init__(self, num_classes: int) -> None:
        super().__init__(num_classes)
        # The layout in which the publication leaves its weights; ours are channels last.
        self.trunk.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]

    def forward(self, points: Tensor) -> Prediction:
        images = depth_images_by_view(normalise(points)).flatten(0, 1)[:, None]
        features = self.feature_norm(self.trunk(images).mean((2, 3)))
        return Prediction(self.head(features.view(len(points), -1)))


class NaiveTransform(SphericalTransform):
    """Products with the harmonics Y_lm, m ≥ 0, on the whole n×n grid."""

    def __init__(self, n: int) -> None:
        super().__init__(n)
        waves = np.exp(1j * np.arange(n // 2)[:, None] * longitudes(n))
        harmonics = legendre(n)[..., None] * waves[:, None, None, :]  # (m,l,θ,φ)
        weights = quadrature_weights(n)[:, None] * 2 * np.pi / n
        for name, value in (("conjugate", harmonics.conj() * weights), ("harmonics", harmonics)):
            flat = torch.tensor(value.reshape((n // 2) ** 2, n * n)).to(torch.complex64)
            self.register_buffer(name, flat, persistent=False)

    def analyse(self, x: Tensor) -> Tensor:
        return torch.view_as_real(self(x.permute(2, 1, 0))).movedim(-1, 0)

    def synthesise(self, coefficients: Tensor) -> Tensor:
        parts = coefficients.movedim(0, -1).contiguous()
        return self.inverse(torch.view_as_complex(parts)).permute(2, 1, 0)

    def forward(self, x: Tensor) -> Tensor:
        out = x.flatten(-2).to(torch.complex64) @ self.get_buffer("conjugate").T
        return out.unflatten(-1, (self.band, self.band)).movedim((-2, -1), (0, 1))

    def inverse(self, coefficients: Tensor) -> Tensor:
        twice = torch.full((self.band, 1, 1), 2.0)
        twice[0] = 1  # a real function's m < 0 repeat its m > 0
        flat = (coefficients * twice).movedim((0, 1), (-2, -1)).flatten(-2)
        return (flat @ self.get_buffer("harmonics")).real.unflatten(-1, (self.n, self.n))


def published_spherical_cnn(num_classes: int) -> nn.Module:
    model = SphericalCNN(num_classes)
    for module in list(model.modules()):
        for name, child in module.named_children():
            if isinstance(child, SphericalTransform):
                setattr(module, name, NaiveTransform(child.n))
    return model


REFERENCES: dict[str, Callable[[int], nn.Module]] = {
    "simpleview": PublishedSimpleView,
    "spherical-cnn": published_spherical_cnn,
}
