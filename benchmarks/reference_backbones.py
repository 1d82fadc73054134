"""Modern backbones as their publications write them, to measure against; not for use.

Channels first, every edge made before its layer, sampling anew at every level. Each takes
normalised clouds (B,N,3) and returns logits (B,K). Source: the publications on the models' cards;
layouts as in ma-xu/pointMLP-pytorch@1ab7f04, guochengqian/PointNeXt@02341db and
Strawberry-Eat-Mango/PCT_Pytorch@0199a3b.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from benchmarks.reference_invariant import VectorNorm, VectorReLU, nearest
from benchmarks.reference_points import PointNet2


def at(x: Tensor, index: Tensor) -> Tensor:
    """(B,N,C) at (B,…) → (B,…,C)."""
    batch = torch.arange(len(x), device=x.device)
    return x[batch.view(-1, *[1] * (index.ndim - 1)).expand_as(index), index]


@torch.no_grad()
def sample(points: Tensor, count: int, skip: bool) -> Tensor:
    """From index 0; with ``skip``, points near the origin are never farther than others."""
    batch, number, _ = points.shape
    chosen = torch.zeros(batch, count, dtype=torch.long, device=points.device)
    distance = points.new_full((batch, number), 1e10)
    if skip:
        distance[(points**2).sum(dim=-1) <= 1e-3] = -1
    for i in range(1, count):
        last = at(points, chosen[:, i - 1])[:, None]
        distance = torch.minimum(distance, ((points - last) ** 2).sum(dim=-1))
        chosen[:, i] = distance.max(dim=-1).indices
    return chosen


def square_distances(a: Tensor, b: Tensor) -> Tensor:
    return ((a[:, :, None] - b[:, None]) ** 2).sum(dim=-1)


class Conv(nn.Module):
    """A 1×1 convolution and its batch norm, of (B,C,N) or (B,C,S,k)."""

    def __init__(self, dims: int, inputs: int, outputs: int, bias: bool = False) -> None:
        super().__init__()
        conv, norm = (nn.Conv1d, nn.BatchNorm1d) if dims == 1 else (nn.Conv2d, nn.BatchNorm2d)
        self.linear = conv(inputs, outputs, 1, bias=bias)
        self.norm = norm(outputs)

    def forward(self, x: Tensor) -> Tensor:
        return self.norm(self.linear(x))


def fc_head(*channels: int, bias: tuple[bool, bool], slope: float = 0.0) -> nn.Sequential:
    a, b, c, d = channels
    activation = nn.LeakyReLU(slope) if slope else nn.ReLU()
    return nn.Sequential(
        nn.Linear(a, b, bias=bias[0]), nn.BatchNorm1d(b), activation, nn.Dropout(0.5),
        nn.Linear(b, c, bias=bias[1]), nn.BatchNorm1d(c), activation, nn.Dropout(0.5),
        nn.Linear(c, d),
    )  # fmt: skip


class Residual(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.narrow = Conv(1, channels, channels // 4)
        self.wide = Conv(1, channels // 4, channels)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.wide(F.relu(self.narrow(x))))


class Group(nn.Module):
    """(B,N,C), (B,S,C), (B,S,k) → (B·S,2C,k) → (B·S,C',k)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.alpha = nn.Parameter(torch.ones(inputs))
        self.beta = nn.Parameter(torch.zeros(inputs))
        self.linear = nn.Conv1d(2 * inputs, outputs, 1, bias=False)
        self.norm = nn.BatchNorm1d(outputs)

    def forward(self, x: Tensor, centres: Tensor, index: Tensor) -> Tensor:
        g = at(x, index) - centres[:, :, None]
        sigma = g.flatten(1).std(dim=1)[:, None, None, None]
        g = self.alpha * (g / (sigma + 1e-5)) + self.beta
        g = torch.cat([g, centres[:, :, None].expand_as(g)], dim=-1)
        return F.relu(self.norm(self.linear(g.permute(0, 1, 3, 2).flatten(0, 1))))


class PointMLPStage(nn.Module):
    def __init__(self, inputs: int, outputs: int, blocks: int) -> None:
        super().__init__()
        self.group = Group(inputs, outputs)
        self.edges = nn.Sequential(*(Residual(outputs) for _ in range(blocks)))
        self.points = nn.Sequential(*(Residual(outputs) for _ in range(blocks)))

    def forward(self, xyz: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """(B,N,3), (B,C,N) → (B,N/2,3), (B,C',N/2)."""
        chosen = sample(xyz, xyz.shape[1] // 2, skip=True)
        centres, x = at(xyz, chosen), x.mT
        index = square_distances(centres, xyz).topk(24, dim=-1, largest=False).indices
        y = self.edges(self.group(x, at(x, chosen), index)).max(dim=-1).values
        return centres, self.points(y.unflatten(0, chosen.shape).mT)


class PointMLP(nn.Module):
    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.embed = Conv(1, 3, 32)
        widths, blocks = (32, 64, 128, 256, 256), (1, 1, 2, 1)
        self.stages = nn.ModuleList(
            PointMLPStage(widths[i], widths[i + 1], blocks[i]) for i in range(4)
        )
        self.head = fc_head(256, 512, 256, num_classes, bias=(True, True))

    def forward(self, points: Tensor) -> Tensor:
        x = F.relu(self.embed(points.mT))
        for stage in self.stages:
            points, x = stage(points, x)
        return self.head(x.max(dim=-1).values)


@torch.no_grad()
def ball(centres: Tensor, points: Tensor, radius: float, count: int) -> Tensor:
    number = points.shape[1]
    index = torch.arange(number, device=points.device).repeat(len(points), centres.shape[1], 1)
    index[square_distances(centres, points) >= radius**2] = number
    index = index.sort(dim=-1).values[:, :, :count]
    first = index[:, :, :1].expand_as(index)
    return torch.where(index == number, first, index)


class PointNeXtLevel(nn.Module):
    def __init__(self, inputs: int, outputs: int, radius: float) -> None:
        super().__init__()
        self.radius = radius
        self.first = Conv(2, inputs + 3, outputs // 2)
        self.second = Conv(2, outputs // 2, outputs)
        self.skip = nn.Conv1d(inputs, outputs, 1)

    def forward(self, xyz: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        chosen = sample(xyz, xyz.shape[1] // 2, skip=False)
        centres, x = at(xyz, chosen), x.mT
        index = ball(centres, xyz, self.radius, 32)
        relative = (at(xyz, index) - centres[:, :, None]) / self.radius
        edges = torch.cat([relative, at(x, index)], dim=-1).permute(0, 3, 1, 2)
        y = self.second(F.relu(self.first(edges))).max(dim=-1).values
        return centres, F.relu(y + self.skip(at(x, chosen).mT))


class PointNeXt(nn.Module):
    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.embed = nn.Conv1d(3, 32, 1)
        widths = (32, 64, 128, 256, 512)
        self.levels = nn.ModuleList(
            PointNeXtLevel(widths[i], widths[i + 1], 0.15 * 1.5**i) for i in range(4)
        )
        self.last = nn.ModuleList([Conv(1, 515, 512), Conv(1, 512, 512)])
        self.head = fc_head(512, 512, 256, num_classes, bias=(False, False))

    def forward(self, points: Tensor) -> Tensor:
        x = self.embed(points.mT)
        for level in self.levels:
            points, x = level(points, x)
        x = torch.cat([points.mT, x], dim=1)
        for layer in self.last:
            x = F.relu(layer(x))
        return self.head(x.max(dim=-1).values)


class Neighbourhood(nn.Module):
    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.first = Conv(1, 2 * inputs, outputs)
        self.second = Conv(1, outputs, outputs)

    def forward(self, xyz: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        chosen = sample(xyz, xyz.shape[1] // 2, skip=True)
        centres, x = at(xyz, chosen), x.mT
        index = square_distances(centres, xyz).topk(32, dim=-1, largest=False).indices
        own = at(x, chosen)[:, :, None]
        neighbours = at(x, index)
        edges = torch.cat([neighbours - own, own.expand_as(neighbours)], dim=-1)
        y = edges.permute(0, 1, 3, 2).flatten(0, 1)
        y = F.relu(self.second(F.relu(self.first(y)))).max(dim=-1).values
        return centres, y.unflatten(0, chosen.shape).mT


class OffsetAttention(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.query = nn.Conv1d(channels, channels // 4, 1, bias=False)
        self.value = nn.Conv1d(channels, channels, 1)
        self.out = Conv(1, channels, channels, bias=True)

    def forward(self, x: Tensor) -> Tensor:
        attention = (self.query(x).mT @ self.query(x)).softmax(dim=-1)
        attention = attention / (1e-9 + attention.sum(dim=1, keepdim=True))
        return x + F.relu(self.out(x - self.value(x) @ attention))


class PCT(nn.Module):
    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.embed = nn.ModuleList([Conv(1, 3, 64), Conv(1, 64, 64)])
        self.levels = nn.ModuleList([Neighbourhood(64, 128), Neighbourhood(128, 256)])
        self.mix = nn.ModuleList([Conv(1, 256, 256), Conv(1, 256, 256)])
        self.attention = nn.ModuleList(OffsetAttention(256) for _ in range(4))
        self.join = Conv(1, 1280, 1024)
        self.head = fc_head(1024, 512, 256, num_classes, bias=(False, True), slope=0.2)

    def forward(self, points: Tensor) -> Tensor:
        x = points.mT
        for layer in self.embed:
            x = F.relu(layer(x))
        for level in self.levels:
            points, x = level(points, x)
        local = x
        for layer in self.mix:
            x = F.relu(layer(x))
        features = []
        for layer in self.attention:
            x = layer(x)
            features.append(x)
        x = F.leaky_relu(self.join(torch.cat([*features, local], dim=1)), 0.2)
        return self.head(x.max(dim=-1).values)


class CanonicalPCA24(nn.Module):
    """One pose in training, all in evaluation, before PointNet++."""

    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.backbone = PointNet2(num_classes)
        turns = []
        for axes in itertools.permutations(range(3)):
            for signs in itertools.product((1.0, -1.0), repeat=3):
                turn = torch.diag(torch.tensor(signs))[list(axes)]
                turns += [turn] if torch.det(turn) > 0 else []
        self.register_buffer("turns", torch.stack(turns))

    def forward(self, points: Tensor) -> Tensor:
        axes = torch.linalg.eigh(points.mT @ points).eigenvectors
        axes = axes * torch.det(axes)[:, None, None]
        canonical = points @ axes
        if self.training:
            return self.backbone(canonical @ self.turns[torch.randint(24, (len(points),))])
        return sum(self.backbone(canonical @ turn) for turn in self.turns) / 24


class CanonicalVN(nn.Module):
    """Vector neurons on every edge, Gram and Schmidt, before PointNet++."""

    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.edge = VectorReLU(3, 21, 0.0, dims=2)
        self.first = VectorReLU(21, 21, 0.0)
        self.norm = VectorNorm(21, 1)
        self.second = VectorReLU(21, 4, 0.0)
        self.backbone = PointNet2(num_classes)

    def forward(self, points: Tensor) -> Tensor:
        neighbours = at(points, nearest(points.mT, 20))
        centre = points[:, :, None].expand_as(neighbours)
        cross = torch.linalg.cross(neighbours, centre)
        edges = torch.stack([neighbours - centre, centre, cross], dim=1).permute(0, 1, 4, 2, 3)
        v = self.second(self.norm(self.first(self.edge(edges).mean(dim=-1)))).mean(dim=-1)
        a = F.normalize(v[:, 0], dim=-1)
        b = F.normalize(v[:, 1] - (v[:, 1] * a).sum(dim=-1, keepdim=True) * a, dim=-1)
        frame = torch.stack([a, b, torch.linalg.cross(a, b)], dim=1)
        return self.backbone(points @ frame.mT)


REFERENCES: dict[str, Callable[[int], nn.Module]] = {
    "pointmlp-elite": PointMLP,
    "pointnext-s": PointNeXt,
    "pct": PCT,
    "canonical-pca24": CanonicalPCA24,
    "canonical-vn": CanonicalVN,
}
