"""RIConv++: what a neighbourhood looks like from its point and round it, whatever the pose.

Source: Zhang, Hua & Yeung, RIConv++, IJCV 2022; cszyzhang/riconv2@70d9297. Geometry is computed in
double precision: where rounding chose a neighbour, a turned cloud would get another answer.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from baselines.camera import camera_ray
from baselines.joined import JoinedMax
from baselines.lra import (
    LEAST_OF_AXES,
    as_normals,
    dot,
    facing,
    local_axes,
    require_signs,
    unit,
)
from baselines.points import distances, farthest_from_centre, farthest_points, gather, normalise
from baselines.published import chosen_quirks, tensors
from baselines.shared_mlp import NormLinear, SharedMLP, head
from partialbench import given
from partialbench.benchmark.prediction import Prediction
from partialbench.errors import InputError

NEIGHBOURS = (8, 16, 32, 64)
"""Of the levels but the last, which takes all points. Of smaller clouds, as many as there are."""
LEAST_ANGLE = math.acos(1 - 2**-23)
"""Radians: the release clamps cosines to 1 − 10⁻⁷, in float32 this."""
TIE = 1e-4
"""Where coordinates have few digits, many neighbours are equally far, and a turned cloud's own
rounding would say which go first. This share of a neighbour's distance from the centroid tells them
apart: far above rounding, far below what tells other neighbours apart."""
COLLINEAR = 1e-5
"""Radians within which a neighbour is at the angle of the ring's start."""
QUIRKS = {
    "start": "farthest point sampling starts at index 0",
    "ring": "the last level's first point is on the left of its ring, wherever it is",
    "signs": "axes have the sign that LAPACK leaves, the ring's start the side that rounding says",
    "ties": "which of two points as far goes first is left to rounding",
    "cross": "cross products are along the first axis of size 3: in a batch of three, the batch",
}
"""What the release does that the row does not."""


@dataclass(frozen=True)
class Level:
    """A level's neighbourhoods, in the order of their rings; no gradient.

    Attributes:
        index: (B,S,n) neighbours among the points of the level before.
        features: (B,S,n,8), see ``invariants``.
    """

    index: Tensor
    features: Tensor


def angle(a: Tensor, b: Tensor) -> Tensor:
    """Between unit vectors, (…,3) → (…), as far from 0 and π as the release's arc cosine is."""
    # Not an arc cosine: near 0 and π it makes 3·10⁻⁴ of a rounding error.
    across = torch.linalg.vector_norm(torch.linalg.cross(a, b, dim=-1), dim=-1)
    return torch.atan2(across, dot(a, b)).clamp(LEAST_ANGLE, math.pi - LEAST_ANGLE)


def ring_keys(
    relative: Tensor,
    axis: Tensor,
    centre_first: bool,
    quirks: frozenset[str] = frozenset(),
    favour: Tensor | None = None,
) -> Tensor:
    """Where each neighbour stands on the ring round the axis: from +1, down, to −3 once round.

    The ring starts at the neighbour that is longest across the axis; the key of one at an angle α
    to its left is cos α, of one at an angle α to its right −2 − cos α.

    Args:
        relative: (…,n,3) neighbours less their point.
        axis: (…,3) unit.
        centre_first: the first neighbour is the point itself; it has no angle and its key is 0.
        quirks: "signs", "ties" and "cross" of ``QUIRKS``.
        favour: (…,n) added to lengths: where the ring starts if two are as long.

    Returns:
        (…,n).
    """
    axis = axis[..., None, :]
    across = relative - dot(relative, axis)[..., None] * axis
    length = torch.linalg.vector_norm(across, dim=-1)
    u = across / length.masked_fill(length == 0, 1)[..., None]
    start = (length if favour is None else length + favour).argmax(dim=-1, keepdim=True)
    r = u.gather(-2, start[..., None].expand(*start.shape, 3))
    dim = u.shape.index(3) if "cross" in quirks else -1
    margin = 0 if quirks & {"signs", "ties"} else COLLINEAR
    left = dot(torch.linalg.cross(u, r.expand_as(u), dim=dim), axis) > -margin
    if "signs" not in quirks:
        left.scatter_(-1, start, True)
    if centre_first:
        left[..., 0] = True
    cosine = dot(u, r)
    return torch.where(left, cosine, -2 - cosine)


def invariants(
    x: Tensor, normals: Tensor, seen: Tensor, axis: Tensor, key: Tensor, signed: bool = False
) -> Tensor:
    """Eight numbers of each neighbour in the order of the ring, that do not depend on the pose.

    With û the direction of a neighbour, v̂ the direction to it from the one before on the ring, n
    its normal, n₀ that one's and a the point's axis: distance, step of the key, û·a, û·n, ∠(n,a),
    v̂·n, v̂·n₀, ∠(n,n₀).

    Args:
        x: (…,n,3) neighbours; seen: the same, less what they are seen from.
        normals: (…,n,3) unit.
        axis: (…,3) unit.
        key: (…,n), descending.
        signed: angles are negative where n leans less along û (v̂) than the other.

    Returns:
        (…,n,8).
    """
    axis = axis[..., None, :].expand_as(normals)
    direction = unit(seen)
    step = unit(x - x.roll(1, dims=-2))
    before = normals.roll(1, dims=-2)
    gap = key - key.roll(1, dims=-1)
    gap[..., 0] -= 4
    along = [dot(direction, axis), dot(direction, normals), dot(step, normals), dot(step, before)]
    to_axis, to_before = angle(normals, axis), angle(normals, before)
    if signed:
        to_axis = torch.where(along[1] < along[0], -to_axis, to_axis)
        to_before = torch.where(along[2] < along[3], -to_before, to_before)
    distance = torch.linalg.vector_norm(seen, dim=-1)
    return torch.stack([distance, gap, *along[:2], to_axis, *along[2:], to_before], dim=-1)


class RIConv2(nn.Module):
    """Five levels on fewer and fewer points, the last on all that are left; 512-256-128-K.

    A level lifts its eight invariants to 64 channels, joins the neighbour's features, and takes the
    maximum over neighbours of one more layer.

    Args:
        lra_neighbours: of the local reference axes that take the normals' place where clouds come
            without, the point itself included.
        orient: "centroid": they point away from it; "camera": towards the camera, as the normals of
            what it sees do.
        centres: most points of the first level, halved from level to level: 1,024 as on ModelNet40,
            512 as on ScanObjectNN.
        signed_angles: the two angles have the signs that the paper gives them; see ``invariants``.
        quirks: names of ``QUIRKS`` joined by "+": what to do as the release does.

    Attributes:
        needs_normals: whether clouds must come with normals; else normals that come are used.

    Raises:
        InputError: an option that is not known, beyond its limit or, beside another, does nothing.
    """

    def __init__(
        self,
        num_classes: int,
        lra_neighbours: int = 32,
        orient: str = "centroid",
        centres: int = 1024,
        signed_angles: bool = False,
        quirks: str = "",
    ) -> None:
        super().__init__()
        if orient not in ("centroid", "camera"):
            raise InputError(f"orient must be centroid or camera, got {orient!r}")
        self.needs_normals, self.orient, self.signed_angles = False, orient, signed_angles
        self.lra_neighbours = given.whole_number(lra_neighbours, "lra_neighbours", LEAST_OF_AXES)
        self.centres = given.whole_number(centres, "centres", least=1)
        self.quirks = chosen_quirks(quirks, QUIRKS)
        require_signs(orient, self.quirks)
        self.tie = 0.0 if "ties" in self.quirks else TIE
        self.lifts = nn.ModuleList(SharedMLP(8, 32, 64) for _ in range(5))
        self.first = NormLinear(64, 32)
        self.layers = nn.ModuleList(
            JoinedMax(64, a, b) for a, b in pairwise((32, 64, 128, 256, 512))
        )
        self.head = head(512, 256, 128, num_classes, dropout=(0.4, 0.4))

    @torch.no_grad()
    def levels(self, points: Tensor, normals: Tensor | None = None) -> list[Level]:
        """The neighbourhoods of clouds (B,N,3) with normals (B,N,3), in the camera frame."""
        x = normalise(points, radius=1.0, dtype=torch.float64)
        number = x.shape[1]
        start = None if "start" in self.quirks else farthest_from_centre(x)
        favour = self.tie * torch.linalg.vector_norm(x, dim=-1)
        # Each level's points are the first ones of this order, so one matrix serves them all.
        order = farthest_points(x, number, start, repeat=False, favour=favour)
        x, favour = gather(x, order), favour.gather(1, order)
        # A flat cloud has no side away from its centroid; the sense of three far points is one.
        third = x[:, min(2, number - 1)][:, None]
        side = self.tie * unit(torch.linalg.cross(x[:, :1], third, dim=-1))
        # A point stays its own nearest: no other is nearer the centroid by more than it is away.
        distance = distances(x, x) + favour[:, None]
        most = min(max(self.lra_neighbours, NEIGHBOURS[1]), number)
        nearest = distance.topk(most, dim=-1, largest=False).indices
        if normals is not None:
            n = gather(as_normals(normals, points), order)
        else:
            near = nearest[..., : self.lra_neighbours]
            n = local_axes(gather(x, near) - x[:, :, None])
            if "signs" not in self.quirks:
                away = -camera_ray(points)[:, None].double() if self.orient == "camera" else x
                n = facing(n, away + side)
        cloud, levels = torch.cat([x, n, favour[..., None]], dim=-1), []
        before, count = number, min(number, self.centres)
        for k in NEIGHBOURS:
            if before == number and min(k, number) <= most:
                near = nearest[:, :count, :k]
            else:
                near = distance[:, :count, :before].topk(min(k, before), dim=-1, largest=False)[1]
            p, axis, _ = cloud[:, :count].split((3, 3, 1), dim=-1)
            levels.append(self._level(cloud, near, p, axis))
            before, count = count, max(1, count // 2)
        return [*levels, self._whole(cloud[:, :before], side)]

    def _whole(self, cloud: Tensor, side: Tensor) -> Level:
        """The level of all points left, round their centroid but seen from the cloud's."""
        x = cloud[..., :3]
        centroid = x.mean(dim=1, keepdim=True)
        relative = x - centroid
        axis = local_axes(relative)[:, None]
        if "signs" not in self.quirks:
            skew = dot(relative, axis).pow(3).sum(dim=1) + self.tie * dot(side, axis)[:, 0]
            axis = torch.where(skew[:, None, None] < 0, -axis, axis)
        near = torch.arange(x.shape[1], device=x.device).expand(len(x), 1, -1)
        return self._level(cloud, near, centroid, axis, whole=True)

    def _level(
        self, cloud: Tensor, near: Tensor, p: Tensor, axis: Tensor, whole: bool = False
    ) -> Level:
        grouped = gather(cloud, near)
        centre_first = not whole or "ring" in self.quirks
        relative, favour = grouped[..., :3] - p[:, :, None], grouped[..., 6]
        key = ring_keys(relative, axis, centre_first, self.quirks, favour)
        # Of neighbours at one angle the nearer comes first.
        far = torch.linalg.vector_norm(relative, dim=-1)
        share = far / far.amax(dim=-1, keepdim=True).clamp_min(1e-12)
        order = (key - self.tie * share).sort(dim=-1, descending=True, stable=True).indices
        key = key.gather(-1, order)
        x, n, _ = grouped.gather(2, order[..., None].expand_as(grouped)).split((3, 3, 1), dim=-1)
        seen = x if whole else x - p[:, :, None]
        features = invariants(x, n, seen, axis, key, self.signed_angles)
        return Level(near.gather(-1, order), features)

    def forward(self, points: Tensor, normals: Tensor | None = None) -> Prediction:
        """(B,N,3) clouds in the camera frame, and their normals (B,N,3) → logits (B,K).

        Raises:
            InputError: no normals where they must be given.
        """
        if self.needs_normals and normals is None:
            raise InputError("this model was made to take normals; call it with normals=…")
        levels = self.levels(points, normals)
        dtype = self.first.linear.weight.dtype
        lifted = [lift(a.features.to(dtype)) for a, lift in zip(levels, self.lifts, strict=True)]
        f = F.relu(self.first.max(lifted[0]))
        for layer, level, edges in zip(self.layers, levels[1:], lifted[1:], strict=True):
            f = F.relu(layer(edges, f, level.index))
        return Prediction(self.head(f[:, 0]))


def with_normals(
    num_classes: int, centres: int = 1024, signed_angles: bool = False, quirks: str = ""
) -> RIConv2:
    """RIConv++ of clouds that must come with normals: of ``RIConv2``'s options those that are not
    of local axes."""
    model = RIConv2(num_classes, centres=centres, signed_angles=signed_angles, quirks=quirks)
    model.needs_normals = True
    return model


def from_published(state: Mapping[str, Tensor], model: nn.Module) -> dict[str, Tensor]:
    """The release's state dict → ours."""
    prefixes = {"fc1": "head.0", "bn1": "head.1", "fc2": "head.4", "bn2": "head.5", "fc3": "head.8"}
    for i in range(5):
        for j in range(2):
            prefixes[f"sa{i}.prev_mlp_convs.{j}"] = f"lifts.{i}.{j}.linear"
            prefixes[f"sa{i}.prev_mlp_bns.{j}"] = f"lifts.{i}.{j}.norm"
        ours = f"layers.{i - 1}" if i else "first"
        prefixes[f"sa{i}.mlp_convs.0"] = f"{ours}.linear"
        prefixes[f"sa{i}.mlp_bns.0"] = f"{ours}.norm"
    return tensors(state, model, prefixes)
