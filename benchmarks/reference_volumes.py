"""The voxel models as their publications run them, for measuring against; not for use.

Each is our model with the parts replaced in which ours differs, so the weights are the same and the
answers must be: kernels assembled pair by pair at every call, dense convolutions throughout, field
rotation by one large block-diagonal matrix, candidate poses one after another.

Source: mariogeiger/se3cnn@546bc68 and TerenceHsu666/PAPNet@878adcc (formulation only).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor, nn

from baselines.steerable import Fields, SteerableConvolution
from baselines.steerable_cnn import SteerableCNN
from baselines.voxels import occupancy
from papnet import pose
from papnet.model import PAPNet
from papnet.parts import Backbone, concatenate, pool, uniform

Model = TypeVar("Model", bound=nn.Module)


class PublishedConvolution(SteerableConvolution):
    """The kernel assembled in a loop over pairs of degrees at every call, then one ``conv3d``."""

    def forward(self, x: Tensor) -> Tensor:
        mean, var = self._statistics(x)
        size = self.size
        kernel = x.new_zeros(self.fields_out.channels, self.fields_in.channels, size, size, size)
        scale = (var + self.eps).rsqrt()
        for l_out, m_out, rows in self.fields_out.degrees:
            start = field = 0
            for l_in, m_in, columns in self.fields_in.degrees:
                basis = self._basis(l_out, l_in).to(x.dtype)
                stop = start + m_in * len(basis)
                weight = self.weights[str(l_out)][:, start:stop].view(m_out, m_in, len(basis))
                weight = weight * scale[field : field + m_in, None]
                pair = torch.einsum("uvw,wijxyz->uivjxyz", weight, basis)
                kernel[rows, columns] = pair.flatten(2, 3).flatten(0, 1)
                start, field = stop, field + m_in
        bias = -kernel[:, : len(mean)].sum((2, 3, 4)) @ mean
        return nn.functional.conv3d(x, kernel, bias, stride=self.stride, padding=self.padding)


def publish(model: Model) -> Model:
    """Every steerable convolution of the model run as published."""
    for module in model.modules():
        if isinstance(module, SteerableConvolution):
            module.__class__ = PublishedConvolution
    return model


def rotate_as_released(field: Tensor, rotation: Tensor, fields: Fields) -> Tensor:
    """Resampling, then a (B,C,C) block-diagonal matrix filled field by field."""
    B, C, X, Y, Z = field.shape
    theta = nn.functional.pad(rotation.transpose(1, 2), (0, 1))
    x = field.permute(0, 1, 4, 3, 2)
    grid = nn.functional.affine_grid(theta, list(x.shape), align_corners=False)
    x = nn.functional.grid_sample(x, grid, align_corners=False).permute(0, 1, 4, 3, 2)
    matrix = field.new_zeros(B, C, C)
    wigner = fields.wigner(rotation)
    start = 0
    for degree, multiplicity, _ in fields.degrees:
        width = 2 * degree + 1
        for _ in range(multiplicity):
            matrix[:, start : start + width, start : start + width] = wigner[degree]
            start += width
    return torch.bmm(matrix, x.reshape(B, C, -1)).view(B, C, X, Y, Z)


class ReleasedBackbone(Backbone):
    def forward(self, points: Tensor, grid: int) -> Tensor:
        x = pool(self.conv1(occupancy(points, grid)))
        x = pool(self.conv22(self.conv21(x)))
        fine = self.conv24(self.conv23(x))
        middle = self.conv32(self.conv31(fine))
        coarse = self.conv42(self.conv41(pool(middle)))
        coarse = nn.functional.interpolate(
            coarse, scale_factor=2, mode="trilinear", align_corners=True
        )
        pyramid = [(fine, uniform(4)), (middle, uniform(8)), (coarse, uniform(16))]
        return self.convp1(concatenate(pyramid))


class ReleasedPAPNet(PAPNet):
    def _classify(self, points: Tensor, features: Tensor, rotation: Tensor | None) -> Tensor:
        assert rotation is not None
        inverse = rotation.transpose(1, 2).contiguous()
        return self.class_head(rotate_as_released(features, inverse, Backbone.fields))

    def _over_bins(self, points: Tensor, features: Tensor, ranked: Tensor) -> Tensor:
        rotations = pose.bins(features)[ranked]
        answers = [self._classify(points, features, R) for R in rotations.unbind(1)]
        return torch.stack(answers, dim=1)


def released_papnet(num_classes: int) -> ReleasedPAPNet:
    model = ReleasedPAPNet(num_classes)
    model.backbone.__class__ = ReleasedBackbone
    return publish(model)


REFERENCES: dict[str, Callable[[int], nn.Module]] = {
    "steerable-cnn": lambda num_classes: publish(SteerableCNN(num_classes)),
    "papnet": released_papnet,
}
