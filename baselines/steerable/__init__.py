"""Steerable convolutions on voxel grids.

Source: Weiler, Geiger, Welling, Boomsma & Cohen, "3D Steerable CNNs: Learning Rotationally
Equivariant Features in Volumetric Data", NeurIPS 2018 (arXiv:1807.02547).

``fields`` says what a channel is, ``basis`` solves the kernel constraint, ``convolution``
normalises and convolves, ``gated`` adds the equivariant non-linearity, ``published`` reads the
weights of the authors' implementation (se3cnn).

Everything here is in e3nn's own basis: degree-1 components are (x, y, z), a volume's axes are
(x, y, z) with increasing coordinates, and a rotation R acts on degree-l components by
``e3nn.o3.Irrep(l).D_from_matrix(R)``.
"""

from baselines.steerable.convolution import SteerableConvolution
from baselines.steerable.fields import Fields
from baselines.steerable.gated import GatedBlock

__all__ = ["Fields", "GatedBlock", "SteerableConvolution"]
