"""PointNet++: PointNet on balls around sampled centres, then on the centres; SSG and MSG.

Source: Qi et al., PointNet++, NeurIPS 2017; charlesq34/pointnet2@4292663 (TensorFlow) for widths,
dropout and sampling from index 0; yanx27/Pointnet_Pointnet2_pytorch@eb64fe0 for state dicts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from baselines.balls import Balls, without_padding
from baselines.edges import edge_moments, edge_relu
from baselines.points import as_weights, ball_query, farthest_points, gather, normalise
from baselines.published import chosen_quirks, tensors
from baselines.shared_mlp import Normed, SharedMLP, head
from partialbench.benchmark.prediction import Prediction


@dataclass(frozen=True)
class Scale:
    """One grouping: the ball's radius, how many points it keeps, the shared MLP's widths."""

    radius: float
    count: int
    widths: tuple[int, ...]


SSG = (
    (Scale(0.2, 32, (64, 64, 128)),),
    (Scale(0.4, 64, (128, 128, 256)),),
)
MSG = (
    (
        Scale(0.1, 16, (32, 32, 64)),
        Scale(0.2, 32, (64, 64, 128)),
        Scale(0.4, 128, (64, 96, 128)),
    ),
    (
        Scale(0.2, 32, (64, 64, 128)),
        Scale(0.4, 64, (128, 128, 256)),
        Scale(0.8, 128, (128, 128, 256)),
    ),
)
CENTRES = (512, 128)
"""Points sampled at the two levels, of clouds of 1,024 points or more."""
PUBLISHED_POINTS = 1024
QUIRKS = {"centres": "512 and 128 points are sampled of any cloud, of a small one some again"}
"""What the release does that the row does not."""


def num_centres(points: int, quirks: frozenset[str] = frozenset()) -> tuple[int, int]:
    """How many centres the two levels sample from a cloud of so many points.

    Smaller clouds than the published 1,024 keep the published shares, a half and an eighth: more
    centres than points would sample the same points again, at the published cost.
    """
    if "centres" in quirks:
        return CENTRES
    share = min(points, PUBLISHED_POINTS) / PUBLISHED_POINTS
    first, second = (max(1, round(share * centres)) for centres in CENTRES)
    return first, second


class GroupLinear(Normed):
    """The first layer of a group's MLP: ReLU(BN(W·[x_j − c_i, f_j] + b)), point j, ball i.

    It is taken once a point and once a centre, then gathered (see ``edges``).

    Args:
        features: channels of f.
        use_xyz: whether the relative coordinates are part of the input (first, then f).
        bias: whether there is b.
    """

    def __init__(
        self, features: int, outputs: int, use_xyz: bool = True, bias: bool = True
    ) -> None:
        super().__init__(features + 3 * use_xyz, outputs, bias)
        self.use_xyz = use_xyz

    def forward(
        self, xyz: Tensor, features: Tensor | None, centres: Tensor, balls: Balls
    ) -> Tensor:
        """(B,N,3), (B,N,C), (B,S,3), their balls → rows (R,C_out)."""
        with torch.autocast(xyz.device.type, enabled=False):
            a, c = self._values(xyz, features, centres)
            bias = 0 if self.linear.bias is None else self.linear.bias
            moments = None
            if self.norm.training:
                mean, var = edge_moments(a, c, balls.index)
                moments = mean + bias, var
            scale, shift = self.scale_and_shift(moments, balls.index.numel())
            a, c = a * scale, (c + bias) * scale + shift
        return edge_relu(a, c, balls)

    def _values(
        self, xyz: Tensor, features: Tensor | None, centres: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Those of points and of centres in full precision, without bias: it stays out of a, which
        keeps the digits of its differences. Features alone are multiplied as they come."""
        weight = self.linear.weight
        if features is None or features.dtype == weight.dtype:
            x = [part for part in (xyz if self.use_xyz else None, features) if part is not None]
            a = F.linear(torch.cat(x, dim=-1), weight)
        else:
            a = F.linear(features, weight[:, 3 * self.use_xyz :].to(features.dtype))
            a = a.to(weight.dtype)
            if self.use_xyz:
                a = a + F.linear(xyz, weight[:, :3])
        if not self.use_xyz:
            return a, a.new_zeros(*centres.shape[:2], len(weight))
        return a, -F.linear(centres, weight[:, :3])


class SetAbstraction(nn.Module):
    """Features of centres from the balls around them, one MLP and maximum a scale, joined.

    Args:
        features: channels a point brings besides its coordinates.
        scales: the groupings.
        use_xyz, nearest: see ``GroupLinear`` and ``points.ball_query``.
    """

    def __init__(
        self, features: int, scales: Sequence[Scale], use_xyz: bool = True, nearest: bool = False
    ) -> None:
        super().__init__()
        self.scales, self.nearest = tuple(scales), nearest
        self.first = nn.ModuleList(GroupLinear(features, s.widths[0], use_xyz) for s in scales)
        self.rest = nn.ModuleList(SharedMLP(*s.widths) for s in scales)
        self.channels = sum(s.widths[-1] for s in scales)

    def forward(self, xyz: Tensor, features: Tensor | None, centres: Tensor) -> Tensor:
        """(B,N,3), (B,N,C) or None, (B,S,3) → (B,S,channels)."""
        pooled = []
        for scale, first, rest in zip(self.scales, self.first, self.rest, strict=True):
            assert isinstance(rest, SharedMLP)
            index = ball_query(centres, xyz, scale.radius, scale.count, self.nearest)
            balls = without_padding(index, xyz.shape[1])
            pooled.append(rest.max_in_balls(first(xyz, features, centres, balls), balls))
        return torch.cat(pooled, dim=-1).unflatten(0, centres.shape[:2])


class PointNet2(nn.Module):
    """PointNet++'s classifier: two set abstractions, a PointNet over the last centres, 512-256-K.

    Ball queries keep the first points in index order and coordinates are relative but not divided
    by the radius; the last PointNet sees absolute coordinates. Sampling starts at index 0.

    Args:
        levels: the two levels' groupings, ``SSG`` or ``MSG``.
        dropout: after each hidden layer of the head.
        features: channels the points bring besides coordinates.
        use_xyz: whether any layer sees coordinates; without, the classifier is blind to all but
            ``features`` and which points are near which.
        nearest: see ``points.ball_query``.
        quirks: what of ``QUIRKS`` to do as published, joined by "+".
    """

    def __init__(
        self,
        num_classes: int,
        levels: tuple[tuple[Scale, ...], tuple[Scale, ...]] = SSG,
        dropout: tuple[float, float] = (0.5, 0.5),
        features: int = 0,
        use_xyz: bool = True,
        nearest: bool = False,
        quirks: str = "",
    ) -> None:
        super().__init__()
        self.use_xyz, self.quirks = use_xyz, chosen_quirks(quirks, QUIRKS)
        self.sa1 = SetAbstraction(features, levels[0], use_xyz, nearest)
        self.sa2 = SetAbstraction(self.sa1.channels, levels[1], use_xyz, nearest)
        self.sa3 = SharedMLP(self.sa2.channels + 3 * use_xyz, 256, 512, 1024)
        self.head = head(1024, 512, 256, num_classes, dropout=dropout)

    def classify(
        self, xyz: Tensor, features: Tensor | None = None, start: Tensor | None = None
    ) -> Tensor:
        """Logits (B,K) of clouds (B,N,3) already normalised, with features (B,N,C).

        Args:
            start: (B,) where farthest point sampling starts; index 0 by default.
        """
        # Sampling the samples again would pick their first ones: one call serves both levels.
        first, second = num_centres(xyz.shape[1], self.quirks)
        centres1 = gather(xyz, farthest_points(xyz, first, start))
        centres2 = centres1[:, :second]
        x = self.sa1(xyz, features, centres1)
        x = self.sa2(centres1, x, centres2)
        if self.use_xyz:
            x = torch.cat([centres2.to(x.dtype), x], dim=-1)
        return self.head(self.sa3.max(x))

    def forward(self, points: Tensor) -> Prediction:
        """(B,N,3) clouds in the camera frame → logits (B,K)."""
        return Prediction(self.classify(as_weights(normalise(points), self)))


def pointnet2_ssg(num_classes: int, quirks: str = "") -> PointNet2:
    """Single-scale grouping, dropout 0.5 and 0.5 (charlesq34's; yanx27's is 0.4 and 0.4)."""
    return PointNet2(num_classes, SSG, (0.5, 0.5), quirks=quirks)


def pointnet2_msg(num_classes: int, quirks: str = "") -> PointNet2:
    """Multi-scale grouping, dropout 0.6 and 0.6 (charlesq34's; yanx27's is 0.4 and 0.5)."""
    return PointNet2(num_classes, MSG, (0.6, 0.6), quirks=quirks)


def from_published(state: Mapping[str, Tensor], model: nn.Module) -> dict[str, Tensor]:
    """yanx27's PyTorch state dict (SSG or MSG, without normals) → ours.

    Its multi-scale layers take [features, coordinates], ours the other order as its single-scale
    ones do.
    """
    state = dict(state)
    prefixes = {"fc1": "head.0", "bn1": "head.1", "fc2": "head.4", "bn2": "head.5", "fc3": "head.8"}
    for i in range(3):
        prefixes |= {f"sa3.mlp_convs.{i}": f"sa3.{i}.linear", f"sa3.mlp_bns.{i}": f"sa3.{i}.norm"}
    for level in ("sa1", "sa2"):
        for scale in range(3):
            block = f"{level}.conv_blocks.{scale}.0.weight"
            if block in state:
                state[block] = state[block].roll(3, dims=1)
            for i in range(3):
                ours = f"{level}.first.{scale}" if i == 0 else f"{level}.rest.{scale}.{i - 1}"
                names = [(f"conv_blocks.{scale}.{i}", f"bn_blocks.{scale}.{i}")]
                names += [(f"mlp_convs.{i}", f"mlp_bns.{i}")] if scale == 0 else []
                for conv, norm in names:
                    prefixes[f"{level}.{conv}"] = f"{ours}.linear"
                    prefixes[f"{level}.{norm}"] = f"{ours}.norm"
    return tensors(state, model, prefixes)
