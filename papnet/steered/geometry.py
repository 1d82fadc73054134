"""What a cloud says without a weight: its neighbourhoods as steerable moments and as invariants.

Everything is an exactly equivariant and *continuous* function of the points. Continuity is what
makes the equivariance survive rounding: a rank (the k-th neighbour, every fourth neighbour) changes
hands where two distances are equal, and the last bit would decide. Here a neighbour fades out
before the rank that ends its neighbourhood is reached, and the wide neighbourhood is seen through
shells of the distance instead of through chosen ranks.

Fields are in e3nn's basis, degrees stacked: component l² + l + m of (l+1)² is degree l's m.
Suffixes: B clouds, N points, k neighbours, S shells, W widths of the wide neighbourhood,
M = (lmax+1)² components, F features.
"""

from __future__ import annotations

import warnings
from typing import NamedTuple

import torch
from torch import Tensor

from baselines.chunks import chunks
from baselines.points import distances, gather, smallest

with warnings.catch_warnings():
    # e3nn 0.5 reads its constants with torch.load's old default.
    warnings.simplefilter("ignore", FutureWarning)
    from e3nn import o3

SHELLS = 3
"""Radial functions of the wide neighbourhood, and of the distance from the centroid."""
WIDE_SHARE, WIDE_MOST = 4, 128
"""The wide neighbourhood holds one in WIDE_SHARE of the cloud's points, at most WIDE_MOST. Each
further scale holds twice as many as the one before."""
SHORT = 0.01
"""Length in a cloud of radius 1 below which a direction fades out: it would be rounding or noise
alone. Copies of one point are common where fewer points are visible than a cloud has."""

_GLOBAL_CENTRES, _GLOBAL_WIDTH = (0.25, 0.55, 0.85), 0.2
_WIDE_CENTRES, _WIDE_WIDTH = (0.0, 0.4, 0.8), 0.25


class Geometry(NamedTuple):
    """The fixed part of the encoder, without gradient.

    Attributes:
        neighbours: (B,N,k) int64, the nearest, the point itself included.
        penalty: (B,N,k) ≥ 0, 0 for near neighbours, without bound towards the rank that ends them.
        point_features: (B,N,F) invariants of each point.
        edge_features: (B,N,k,F) invariants of each point and its neighbour.
        fields: (B,N,num_fields,M) steerable: harmonics of the direction from the centroid times
            shells of the radius, then moments of the wide neighbourhoods, then, where it is known,
            harmonics of the camera's ray.
    """

    neighbours: Tensor
    penalty: Tensor
    point_features: Tensor
    edge_features: Tensor
    fields: Tensor


def harmonics(vectors: Tensor, lmax: int) -> Tensor:
    """(…,3) vectors v → (…,M): |v|^l·Y_l(v/|v|), Y_l of norm 1."""
    degrees = list(range(lmax + 1))
    # Each coordinate by itself in memory: e3nn's polynomials are then of whole vectors.
    vectors = vectors.movedim(-1, 0).contiguous().movedim(0, -1)
    return o3.spherical_harmonics(degrees, vectors, normalize=False, normalization="norm")


def directions(vectors: Tensor) -> Tensor:
    """(…,3) → (…,3) of norm below 1: v/√(|v|² + SHORT²)."""
    return vectors * torch.rsqrt(vectors.square().sum(-1, keepdim=True) + SHORT**2)


def shells(x: Tensor, centres: tuple[float, ...], width: float) -> Tensor:
    """Gaussians of (…) values at ``centres``, (…,S)."""
    offsets = torch.stack([x - centre for centre in centres], dim=-1)
    return torch.exp(-0.5 * (offsets / width).square())


def per_degree(products: Tensor, lmax: int) -> Tensor:
    """(…,S,M) → (…,S·lmax): the sums over the components of each degree above 0."""
    # As a product with zeros and ones: faster than sums over a few strided components.
    degree = torch.arange((lmax + 1) ** 2, device=products.device).sqrt().floor()
    belongs = degree[:, None] == torch.arange(1, lmax + 1, device=products.device)
    shells = torch.eye(products.shape[-2], device=products.device)
    return products.flatten(-2) @ torch.kron(shells, belongs.float()).to(products)


def num_features(lmax: int, scales: int = 1, ray: bool = False) -> tuple[int, int]:
    """(features of a point, features of an edge)."""
    moments = scales * SHELLS
    of_point = 2 + scales + moments + 2 * moments * lmax
    of_edge = 4 + 3 * SHELLS * lmax
    return (of_point + 1 + moments * lmax, of_edge + 1) if ray else (of_point, of_edge)


def num_fields(scales: int = 1, ray: bool = False) -> int:
    """How many steerable fields a point has."""
    return SHELLS * (1 + scales) + ray


@torch.no_grad()
def geometry(
    points: Tensor, k: int, lmax: int, scales: int = 1, ray: Tensor | None = None
) -> Geometry:
    """Neighbourhoods, moments and invariants of clouds.

    Args:
        points: (B,N,3) normalised, float32 or float64, N > k.
        k: nearest neighbours that become edges.
        scales: of wide neighbourhoods.
        ray: (B,3) unit, from the camera to each cloud: one more direction that turns with it.
    """
    with torch.autocast(points.device.type, enabled=False):
        # A few clouds at a time: the wide neighbourhoods of all would leave a processor's cache.
        values = points.shape[1] * WIDE_MOST * 2 ** (scales - 1) * (lmax + 1) ** 2
        parts = [
            _geometry(points[part], k, lmax, scales, None if ray is None else ray[part])
            for part in chunks(len(points), values, points.device)
        ]
        return Geometry(*(torch.cat(tensors) for tensors in zip(*parts, strict=True)))


def _geometry(points: Tensor, k: int, lmax: int, scales: int, ray: Tensor | None) -> Geometry:
    number = points.shape[1]
    sizes = [
        min(max(min(number // WIDE_SHARE, WIDE_MOST) * 2**scale, k), number - 1)
        for scale in range(scales)
    ]
    near, index = smallest(distances(points, points), sizes[-1] + 1)
    # The distance of the first point left out ends a neighbourhood; it is continuous, as every
    # order statistic is, though which point it belongs to is not.
    ends, narrow_end = [near[..., size] for size in sizes], near[..., k]
    offsets = gather(points, index[..., : sizes[-1]]) - points[:, :, None]
    Y = harmonics(directions(offsets), lmax)
    of_scales = [_moments(near, Y, size) for size in sizes]
    moments = torch.cat(of_scales, dim=2)

    radius = torch.linalg.vector_norm(points, dim=-1)
    outward = harmonics(directions(points), lmax)
    from_centre = shells(radius, _GLOBAL_CENTRES, _GLOBAL_WIDTH)[..., None] * outward[:, :, None]

    neighbours = index[..., :k]
    scaled = near[..., :k] / narrow_end.clamp_min(1e-6)[..., None]
    # 0 up to half of the last distance, then up to 1e4 at all of it: never chosen there.
    fade = (2 * (1 - scaled)).clamp(1e-4, 1)
    of_points = [
        torch.stack([radius, *ends, narrow_end], dim=-1),
        moments[..., 0],
        per_degree(moments.square(), lmax).sqrt(),
        per_degree(moments * outward[:, :, None], lmax),
    ]
    of_edges = [
        _edge_features(points, neighbours, near[..., :k], Y[:, :, :k], of_scales[0], outward, lmax)
    ]
    fields = [from_centre, moments]
    if ray is not None:
        seen = harmonics(ray, lmax)[:, None, None]
        of_points += [
            (outward[..., 1:4] * seen[:, :, 0, 1:4]).sum(-1, keepdim=True),
            per_degree(moments * seen, lmax),
        ]
        of_edges.append((Y[:, :, :k, 1:4] * seen[..., 1:4]).sum(-1, keepdim=True))
        fields.append(seen.expand(-1, number, -1, -1))
    return Geometry(
        neighbours, 1 / fade - 1, torch.cat(of_points, dim=-1), torch.cat(of_edges, dim=-1),
        torch.cat(fields, dim=2),
    )  # fmt: skip


def _moments(near: Tensor, Y: Tensor, size: int) -> Tensor:
    """(B,N,S,M) of the harmonics (B,N,n,M) of the ``size`` nearest, in shells of the distance."""
    u = near[..., :size] / near[..., size].clamp_min(1e-6)[..., None]
    window = (1 - u.square()).clamp_min(0).square()
    radial = shells(u, _WIDE_CENTRES, _WIDE_WIDTH) * window[..., None]
    return radial.mT @ Y[:, :, :size] / window.sum(-1).clamp_min(1e-6)[..., None, None]


def _edge_features(
    points: Tensor,
    neighbours: Tensor,
    distance: Tensor,
    Y: Tensor,
    moments: Tensor,
    outward: Tensor,
    lmax: int,
) -> Tensor:
    """(B,N,k,F): the distance, three cosines, and how moments at both ends lie to the edge.

    Component by component over all edges at once: a sum over a few values that lie side by side
    keeps a processor's vectors empty.
    """
    shape, (S, M) = Y.shape[:3], moments.shape[2:]
    outward_there = gather(outward[..., 1:4], neighbours)
    edge, here = Y[..., 1:4], outward[:, :, None, 1:4]
    cosines = [(edge * here), (edge * outward_there), (here * outward_there)]
    there = gather(moments.flatten(2), neighbours).flatten(0, 2).T.contiguous().view(S, M, -1)
    of_point = moments.flatten(0, 1).permute(1, 2, 0).repeat_interleave(shape[2], dim=2)
    edges = Y.flatten(0, 2).T.contiguous()[None]
    sums = edges.new_empty(3, S, lmax, edges.shape[2])
    for into, (one, other) in zip(
        sums, ((of_point, edges), (there, edges), (of_point, there)), strict=True
    ):
        for degree in range(1, lmax + 1):
            first = degree**2
            total = torch.mul(one[:, first], other[:, first], out=into[:, degree - 1])
            for component in range(first + 1, (degree + 1) ** 2):
                total.addcmul_(one[:, component], other[:, component])
    return torch.cat(
        [
            distance[..., None],
            *(product.sum(-1, keepdim=True) for product in cosines),
            sums.flatten(0, 2).T.unflatten(0, shape),
        ],
        dim=-1,
    )
