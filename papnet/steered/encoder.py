"""Invariant features of every point: two layers over edges to the nearest neighbours, one over all.

No coordinate enters a weight; see ``geometry`` for what does.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from baselines.shared_mlp import NormLinear, activated
from papnet.steered.edge_layer import EdgeLayer, collect_edges
from papnet.steered.geometry import Geometry, num_features


class Encoder(nn.Module):
    """Geometry of a cloud → (B,N,width) invariant features ≥ 0.

    Args:
        width: of the last layer; the edge layers have 3/8 and 3/4 of it.
        scales, ray: of the geometry.
    """

    def __init__(self, lmax: int, width: int, scales: int = 1, ray: bool = False) -> None:
        super().__init__()
        points, edges = num_features(lmax, scales, ray)
        first, second = 3 * width // 8, 3 * width // 4
        self.point_norm = nn.BatchNorm1d(points, affine=False)
        self.edge_norm = nn.BatchNorm1d(edges, affine=False)
        self.edge1 = EdgeLayer(points, edges, first)
        self.edge2 = EdgeLayer(first, edges, second)
        self.point = NormLinear(points + first + second, width, bias=False)

    def forward(self, g: Geometry) -> Tensor:
        """(B,N,width)."""
        x = self.point_norm(g.point_features.flatten(0, 1)).view_as(g.point_features)
        features = self.edge_norm(g.edge_features.flatten(0, 2)).view_as(g.edge_features)
        edges = collect_edges(g.neighbours, features, g.penalty, moments=self.training)
        first = self.edge1(x, edges)
        second = self.edge2(first, edges)
        return activated([self.point], torch.cat([x, first, second], dim=-1))
