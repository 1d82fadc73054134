"""Invariant features of every point: two layers over edges to the nearest neighbours, one over all.

No coordinate enters a weight; see ``geometry`` for what does.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from baselines.points import gather
from papnet.steered.geometry import Geometry, num_features


class EdgeLayer(nn.Module):
    """max over neighbours j of ReLU(BN(W·e_ij + A·x_j + C·x_i) − penalty_ij)."""

    def __init__(self, inputs: int, edge_features: int, outputs: int) -> None:
        super().__init__()
        self.edge = nn.Linear(edge_features, outputs, bias=False)
        self.ends = nn.Linear(inputs, 2 * outputs, bias=False)
        self.norm = nn.BatchNorm1d(outputs)

    def forward(self, x: Tensor, edges: Tensor, neighbours: Tensor, penalty: Tensor) -> Tensor:
        """(B,N,C), (B,N,k,F), (B,N,k), (B,N,k) → (B,N,C_out)."""
        here, there = self.ends(x).chunk(2, dim=-1)
        # In place: these are by far the largest tensors, and no backward pass needs them.
        y = self.edge(edges).add_(gather(there, neighbours)).add_(here[:, :, None])
        y = self.norm(y.flatten(0, 2)).view_as(y).sub_(penalty[..., None].to(y.dtype))
        return F.relu(y.amax(dim=2))


class Encoder(nn.Module):
    """Geometry of a cloud → (B,N,width) invariant features ≥ 0.

    Args:
        width: of the last layer; the edge layers have 3/8 and 3/4 of it.
    """

    def __init__(self, lmax: int, width: int) -> None:
        super().__init__()
        points, edges = num_features(lmax)
        first, second = 3 * width // 8, 3 * width // 4
        self.point_norm = nn.BatchNorm1d(points, affine=False)
        self.edge_norm = nn.BatchNorm1d(edges, affine=False)
        self.edge1 = EdgeLayer(points, edges, first)
        self.edge2 = EdgeLayer(first, edges, second)
        self.point = nn.Linear(points + first + second, width, bias=False)
        self.norm = nn.BatchNorm1d(width)

    def forward(self, g: Geometry) -> Tensor:
        """(B,N,width)."""
        x = self.point_norm(g.point_features.flatten(0, 1)).view_as(g.point_features)
        edges = self.edge_norm(g.edge_features.flatten(0, 2)).view_as(g.edge_features)
        first = self.edge1(x, edges, g.neighbours, g.penalty)
        second = self.edge2(first, edges, g.neighbours, g.penalty)
        y = self.point(torch.cat([x, first, second], dim=-1))
        return F.relu(self.norm(y.flatten(0, 1)).view_as(y))
