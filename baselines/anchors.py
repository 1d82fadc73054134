"""Which points stand for a cloud: the farthest point sampling of the modern backbones."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from baselines.points import (
    distances,
    farthest_from_centre,
    farthest_points,
    gather,
    smallest,
)

PUBLISHED_POINTS = 1024
QUIRKS = {
    "start": "farthest point sampling starts at index 0",
    "origin": "it never selects a point within 0.03 of the origin",
    "counts": "every cloud is sampled as often as one of 1,024 points, a smaller one's some again",
}
"""What published implementations do that the rows here do not."""
SKIPPED = 1e-3
"""Squared norm; a kernel that many of them share takes such points for padding."""


def num_anchors(
    points: int, published: Sequence[int], quirks: frozenset[str] = frozenset()
) -> tuple[int, ...]:
    """How many points each level keeps of a cloud of so many, if of 1,024 it is ``published``.

    Smaller clouds keep the published shares, see ``pointnet2.num_centres``.
    """
    if "counts" in quirks:
        return tuple(published)
    share = min(points, PUBLISHED_POINTS) / PUBLISHED_POINTS
    return tuple(max(1, round(share * count)) for count in published)


def anchors(points: Tensor, count: int, quirks: frozenset[str] = frozenset()) -> Tensor:
    """Indices (B,count) of points of centred clouds (B,N,3), each far from those before it.

    They start at the point farthest from the centroid and none is chosen twice, so that which
    points they are depends neither on the cloud's pose nor on the order of its points; but of
    copies of points, which come last, the first ones in order are chosen. The first m
    are the anchors that sampling the anchors again would choose.

    Args:
        count: at most N, but for "counts".
        quirks: of ``QUIRKS``; with "start" points are chosen twice where all have been.
    """
    start = None if "start" in quirks else farthest_from_centre(points)
    if "origin" in quirks:
        # Points that coincide with the start are the last to be chosen.
        first = points[:, :1] if start is None else gather(points, start[:, None])
        near = points.square().sum(dim=-1, keepdim=True) <= SKIPPED
        points = torch.where(near, first, points)
    return farthest_points(points, count, start, repeat="start" in quirks)


def nearest(anchors: Tensor, points: Tensor, k: int) -> Tensor:
    """Indices (B,S,k) of the k points (B,N,3) nearest to each anchor (B,S,3), in no particular
    order; all N of a smaller cloud."""
    k = min(k, points.shape[1])
    return smallest(distances(anchors, points), k)[1]
