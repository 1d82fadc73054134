"""PAPNet's three parts: the shared backbone, the pose branch and the class branch.

Source: Xu et al., "Classification of Single-View Object Point Clouds", section 4;
TerenceHsu666/PAPNet@878adcc for every width, kernel and pooling.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn

from baselines.steerable import Fields, GatedBlock
from baselines.voxels import occupancy
from papnet.first_layer import pooled_first_layer

DEGREES = 4  # l = 0, 1, 2, 3
GRID = 64


def uniform(multiplicity: int) -> Fields:
    """The same number of fields of every degree: 16·multiplicity channels."""
    return Fields((multiplicity,) * DEGREES)


def block(fields_in: Fields, fields_out: Fields) -> GatedBlock:
    """Every convolution of PAPNet: size 3, padding 1, stride 1."""
    return GatedBlock(fields_in, fields_out, 3, padding=1)


def pool(x: Tensor) -> Tensor:
    """The release's pooling to half the edge. It samples at even indices, so the centre drifts."""
    return nn.functional.avg_pool3d(x, 3, stride=2, padding=1)


def concatenate(parts: list[tuple[Tensor, Fields]]) -> Tensor:
    """Feature volumes stacked degree by degree, so that the result is again one ``Fields``."""
    return torch.cat(
        [x[:, fields.degrees[i][2]] for i in range(DEGREES) for x, fields in parts], dim=1
    )


class Backbone(nn.Module):
    """Occupancy of a cloud → an equivariant volume at a quarter of its edge (16³ for 64³)."""

    fields = uniform(16)
    align_corners = True
    """Of the upsampling; with ``first`` and ``halve``, how the release lays one grid on another."""

    def __init__(self) -> None:
        super().__init__()
        u = uniform
        self.conv1 = block(Fields((1,)), u(2))
        self.conv21, self.conv22 = block(u(2), u(4)), block(u(4), u(4))
        self.conv23, self.conv24 = block(u(4), u(4)), block(u(4), u(4))
        self.conv31, self.conv32 = block(u(4), u(8)), block(u(8), u(8))
        self.conv41, self.conv42 = block(u(8), u(16)), block(u(16), u(16))
        self.convp1 = block(u(4 + 8 + 16), self.fields)

    def forward(self, points: Tensor, grid: int) -> Tensor:
        """(B,N,3) normalised clouds → (B,256,grid/4,grid/4,grid/4)."""
        x = self.first(occupancy(points, grid), points.shape[1])
        x = self.halve(self.conv22(self.conv21(x)))
        fine = self.conv24(self.conv23(x))
        middle = self.conv32(self.conv31(fine))
        coarse = self.conv42(self.conv41(self.halve(middle)))
        coarse = nn.functional.interpolate(
            coarse, scale_factor=2, mode="trilinear", align_corners=self.align_corners
        )
        pyramid = [(fine, uniform(4)), (middle, uniform(8)), (coarse, uniform(16))]
        return self.convp1(concatenate(pyramid))

    def first(self, volume: Tensor, points: int) -> Tensor:
        """(B,1,X,X,X) occupancy by so many points → the first layer's output at half the edge."""
        known = None if volume.device.type == "cpu" else points
        return pooled_first_layer(self.conv1, volume, known)

    def halve(self, x: Tensor) -> Tensor:
        """To half the edge."""
        return pool(x)


class PoseHead(nn.Module):
    """Backbone features → ``outputs`` numbers: scores of the 60 bins, or a regressed rotation.

    Args:
        vector: keep vectors up to degree 3 in the descriptor; else as many scalars (w/o vector).
    """

    def __init__(self, outputs: int, *, vector: bool = True) -> None:
        super().__init__()
        wide = uniform(64)
        self.descriptor = wide if vector else Fields((wide.channels,))
        self.conv51 = block(Backbone.fields, uniform(32))
        self.conv52 = block(uniform(32), self.descriptor)
        self.fc = mlp(self.descriptor.channels, 512, 256, outputs)

    def forward(self, features: Tensor) -> Tensor:
        """(B,256,X,X,X) → (B,outputs)."""
        return self.fc(self.conv52(self.conv51(pool(features))).mean((2, 3, 4)))


class ClassHead(nn.Module):
    """Features in the canonical pose → class scores, from pooled scalars and vectors."""

    descriptor = Fields((128, 128))

    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.conv0 = block(Backbone.fields, uniform(16))
        self.conv1 = block(uniform(16), uniform(32))
        self.conv2 = block(uniform(32), self.descriptor)
        self.fc = mlp(self.descriptor.channels, 256, 128, num_classes)

    def forward(self, features: Tensor) -> Tensor:
        """(B,256,X,X,X) → (B,K)."""
        return self.fc(self.describe(pool(self.conv0(features))))

    def describe(self, pooled: Tensor) -> Tensor:
        """(B,256,Y,Y,Y) pooled output of ``conv0`` → the mean scalars and vectors, (B,512)."""
        return self.conv2(self.conv1(pooled)).mean((2, 3, 4))


def mlp(*widths: int) -> nn.Sequential:
    """Linear layers with batch norm and ReLU between them."""
    layers: list[nn.Module] = []
    for a, b in itertools.pairwise(widths[:-1]):
        layers += [nn.Linear(a, b), nn.BatchNorm1d(b), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers, nn.Linear(widths[-2], widths[-1]))
