"""The rotation-robust models as their publications write them, to measure against; not for use.

Every edge is made before its layer, channels first. Each takes normalised clouds (B,N,3) and
returns logits (B,K). Source: modern cards; layouts as in FlyingGiraffe/vnn@f3197e2.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor, nn

EPS = 1e-6


def nearest(x: Tensor, k: int) -> Tensor:
    """(B,C,N) → (B,N,k)."""
    square = (x**2).sum(dim=1, keepdim=True)
    return (2 * x.mT @ x - square - square.mT).topk(k, dim=-1).indices


def at(x: Tensor, index: Tensor) -> Tensor:
    """(B,N,C) at (B,…) → (B,…,C)."""
    batch = torch.arange(len(x), device=x.device)
    return x[batch.view(-1, *[1] * (index.ndim - 1)).expand_as(index), index]


def fc_head(*channels: int, dropout: float) -> nn.Sequential:
    *hidden, outputs = channels
    layers: list[nn.Module] = []
    for a, b in pairwise(hidden):
        layers += [nn.Linear(a, b), nn.BatchNorm1d(b), nn.ReLU(), nn.Dropout(dropout)]
    return nn.Sequential(*layers, nn.Linear(hidden[-1], outputs))


class VectorNorm(nn.Module):
    def __init__(self, channels: int, dims: int) -> None:
        super().__init__()
        self.norm = nn.BatchNorm2d(channels) if dims == 2 else nn.BatchNorm1d(channels)

    def forward(self, v: Tensor) -> Tensor:
        n = torch.norm(v, dim=2) + EPS
        return v / n[:, :, None] * self.norm(n)[:, :, None]


class VectorReLU(nn.Module):
    """(B,C,3,N[,k]) → (B,C',3,N[,k])."""

    def __init__(
        self, inputs: int, outputs: int, slope: float, dims: int = 1, shared: bool = False
    ) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs, bias=False)
        self.norm = VectorNorm(outputs, dims)
        self.direction = nn.Linear(inputs, 1 if shared else outputs, bias=False)
        self.slope = slope

    def forward(self, v: Tensor) -> Tensor:
        p = self.norm(self.linear(v.transpose(1, -1)).transpose(1, -1))
        d = self.direction(v.transpose(1, -1)).transpose(1, -1)
        dot = (p * d).sum(dim=2, keepdim=True)
        mask = (dot >= 0).to(p.dtype)
        square = (d * d).sum(dim=2, keepdim=True)
        turned = mask * p + (1 - mask) * (p - dot / (square + EPS) * d)
        return self.slope * p + (1 - self.slope) * turned


def vector_edges(v: Tensor, k: int, cross: bool = False) -> Tensor:
    """(B,C,3,N) → (B,2C or 3,3,N,k)."""
    batch, channels, _, number = v.shape
    flat = v.flatten(1, 2)
    neighbours = at(flat.mT.contiguous(), nearest(flat, k)).view(batch, number, k, channels, 3)
    centre = v.permute(0, 3, 1, 2)[:, :, None].expand_as(neighbours)
    parts = [neighbours - centre, centre]
    parts += [torch.cross(neighbours, centre, dim=-1)] if cross else []
    return torch.cat(parts, dim=3).permute(0, 3, 4, 1, 2).contiguous()


class VectorFrame(nn.Module):
    def __init__(self, channels: int, slope: float) -> None:
        super().__init__()
        self.first = VectorReLU(channels, channels // 2, slope)
        self.second = VectorReLU(channels // 2, channels // 4, slope)
        self.last = nn.Linear(channels // 4, 3, bias=False)

    def forward(self, v: Tensor) -> Tensor:
        """(B,C,3,N) → (B,3·C,N)."""
        frame = self.last(self.second(self.first(v)).transpose(1, -1)).transpose(1, -1)
        return torch.einsum("bijm,bjkm->bikm", v, frame.transpose(1, 2)).flatten(1, 2)


class VNDGCNN(nn.Module):
    def __init__(self, num_classes: int, k: int = 20) -> None:
        super().__init__()
        self.k = k
        self.convs = nn.ModuleList(
            VectorReLU(2 * a, b, 0.2, dims=2) for a, b in ((1, 21), (21, 21), (21, 42), (42, 85))
        )
        self.embed = VectorReLU(169, 341, 0.2, shared=True)
        self.frame = VectorFrame(682, 0.2)
        self.head = nn.Sequential(
            nn.Linear(4092, 512), nn.BatchNorm1d(512), nn.LeakyReLU(0.2), nn.Dropout(0.5),
            nn.Linear(512, 256), nn.BatchNorm1d(256), nn.LeakyReLU(0.2), nn.Dropout(0.5),
            nn.Linear(256, num_classes),
        )  # fmt: skip

    def forward(self, points: Tensor) -> Tensor:
        v, features = points.mT[:, None], []
        for conv in self.convs:
            v = conv(vector_edges(v, self.k)).mean(dim=-1)
            features.append(v)
        v = self.embed(torch.cat(features, dim=1))
        v = torch.cat([v, v.mean(dim=-1, keepdim=True).expand_as(v)], dim=1)
        x = self.frame(v)
        return self.head(torch.cat([x.max(dim=-1).values, x.mean(dim=-1)], dim=1))


class VNPointNet(nn.Module):
    def __init__(self, num_classes: int, k: int = 20) -> None:
        super().__init__()
        self.k = k
        self.edge = VectorReLU(3, 21, 0.0, dims=2)
        self.first = VectorReLU(21, 21, 0.0)
        self.tnet = nn.Sequential(
            *(VectorReLU(a, b, 0.0) for a, b in ((21, 21), (21, 42), (42, 341)))
        )
        self.cloud = nn.Sequential(*(VectorReLU(a, b, 0.0) for a, b in ((341, 170), (170, 85))))
        self.last = nn.Linear(85, 21, bias=False)
        self.second = VectorReLU(42, 42, 0.0)
        self.third = nn.Linear(42, 341, bias=False)
        self.norm = VectorNorm(341, 1)
        self.frame = VectorFrame(682, 0.0)
        self.head = nn.Sequential(
            nn.Linear(2046, 512), nn.BatchNorm1d(512), nn.ReLU(), nn.Linear(512, 256),
            nn.Dropout(0.4), nn.BatchNorm1d(256), nn.ReLU(), nn.Linear(256, num_classes),
        )  # fmt: skip

    def forward(self, points: Tensor) -> Tensor:
        v = self.first(self.edge(vector_edges(points.mT[:, None], self.k, cross=True)).mean(dim=-1))
        cloud = self.cloud(self.tnet(v).mean(dim=-1, keepdim=True))
        cloud = self.last(cloud.transpose(1, -1)).transpose(1, -1)
        v = self.second(torch.cat([v, cloud.expand(-1, -1, -1, v.shape[-1])], dim=1))
        v = self.norm(self.third(v.transpose(1, -1)).transpose(1, -1))
        v = torch.cat([v, v.mean(dim=-1, keepdim=True).expand_as(v)], dim=1)
        return self.head(self.frame(v).max(dim=-1).values)


def unit(v: Tensor) -> Tensor:
    return torch.nan_to_num(v / torch.norm(v, dim=-1, keepdim=True))


@torch.no_grad()
def sample(points: Tensor, count: int) -> Tensor:
    """Farthest point sampling from index 0."""
    chosen = torch.zeros(len(points), count, dtype=torch.long, device=points.device)
    rows, last = torch.arange(len(points), device=points.device), chosen[:, 0]
    distance = torch.full(points.shape[:2], 1e10, device=points.device, dtype=points.dtype)
    for i in range(count):
        chosen[:, i] = last
        square = ((points - points[rows, last][:, None]) ** 2).sum(dim=-1)
        distance = torch.minimum(distance, square)
        last = distance.max(dim=-1).indices
    return chosen


def square_distance(a: Tensor, b: Tensor) -> Tensor:
    square = (a**2).sum(dim=-1)[:, :, None] + (b**2).sum(dim=-1)[:, None]
    return square - 2 * a @ b.mT


def reference_axes(relative: Tensor) -> Tensor:
    """(…,n,3) neighbours less their point → (…,3): local reference axes, away from the origin."""
    length = torch.norm(relative, dim=-1, keepdim=True)
    weight = length.amax(dim=-2, keepdim=True) - length
    weight = weight / weight.sum(dim=-2, keepdim=True)
    weight[torch.isnan(weight)] = 1
    return torch.linalg.eigh((weight * relative).mT @ relative).eigenvectors[..., 0]


def ring_features(
    x: Tensor, n: Tensor, p: Tensor, axis: Tensor, whole: bool
) -> tuple[Tensor, Tensor]:
    """(B,S,n,3), …, (B,S,3), (B,S,3) → eight invariants in the order of the ring, that order."""
    relative, axis = x - p[:, :, None], axis[:, :, None].expand_as(n)
    across = relative - (relative * axis).sum(dim=-1, keepdim=True) * axis
    length = torch.norm(across, dim=-1, keepdim=True)
    u = unit(across)
    start = length.argmax(dim=2, keepdim=True)
    r = u.gather(2, start.expand(-1, -1, -1, 3)).expand_as(u)
    cosine = (u * r).sum(dim=-1)
    sign = torch.sign((torch.cross(u, r, dim=-1) * axis).sum(dim=-1))
    sign[sign == 0] = -1
    sign[..., 0] = 1
    sign.scatter_(2, start[..., 0], 1.0)
    key, order = (sign * cosine - (1 - sign)).sort(dim=-1, descending=True)
    index = order[..., None].expand(-1, -1, -1, 3)
    x, n = x.gather(2, index), n.gather(2, index)
    seen = x if whole else x - p[:, :, None]
    before = n.roll(1, dims=2)
    d, step = unit(seen), unit(x - x.roll(1, dims=2))
    gap = torch.cat([-3 - key[..., -1:], key[..., 1:] - key[..., :-1]], dim=-1)

    def angle(a: Tensor, b: Tensor) -> Tensor:
        return torch.acos((a * b).sum(dim=-1).clamp(-1 + 1e-7, 1 - 1e-7))

    features = [
        torch.norm(seen, dim=-1), gap, (d * axis).sum(dim=-1), (d * n).sum(dim=-1), angle(n, axis),
        (step * n).sum(dim=-1), (step * before).sum(dim=-1), angle(n, before),
    ]  # fmt: skip
    return torch.stack(features, dim=-1), order


class RILevel(nn.Module):
    def __init__(self, count: int | None, k: int, inputs: int, outputs: int) -> None:
        super().__init__()
        self.count, self.k = count, k
        self.lift = nn.Sequential(
            nn.Conv2d(8, 32, 1), nn.BatchNorm2d(32), nn.ReLU(),
            nn.Conv2d(32, 64, 1), nn.BatchNorm2d(64), nn.ReLU(),
        )  # fmt: skip
        self.mlp = nn.Sequential(
            nn.Conv2d(64 + inputs, outputs, 1), nn.BatchNorm2d(outputs), nn.ReLU()
        )

    def forward(self, x: Tensor, n: Tensor, f: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        with torch.no_grad():
            if self.count is None:
                p = x.mean(dim=1, keepdim=True)
                axis = reference_axes(x - p)[:, None]
                skew = (((x - p) * axis).sum(dim=-1) ** 3).sum(dim=1)
                axis = torch.where(skew[:, None, None] < 0, -axis, axis)
                near = torch.arange(x.shape[1], device=x.device).expand(len(x), 1, -1)
            else:
                centres = sample(x, self.count)
                p, axis = at(x, centres), at(n, centres)
                near = square_distance(p, x).topk(self.k, dim=-1, largest=False).indices
            features, order = ring_features(at(x, near), at(n, near), p, axis, self.count is None)
        y = self.lift(features.permute(0, 3, 2, 1))
        if f is not None:
            y = torch.cat([y, at(f, near.gather(-1, order)).permute(0, 3, 2, 1)], dim=1)
        return p, axis, self.mlp(y).max(dim=2).values.mT


class RIConv2(nn.Module):
    """Without normals, for clouds of 256 points upwards: 256, 128, 64, 32 and one centres."""

    def __init__(self, num_classes: int) -> None:
        super().__init__()
        shape = ((256, 8, 0, 32), (128, 16, 32, 64), (64, 32, 64, 128), (32, 64, 128, 256))
        self.levels = nn.ModuleList(RILevel(*level) for level in (*shape, (None, 0, 256, 512)))
        self.head = fc_head(512, 256, 128, num_classes, dropout=0.4)

    def forward(self, points: Tensor) -> Tensor:
        with torch.no_grad():
            near = square_distance(points, points).topk(32, dim=-1, largest=False).indices
            n = reference_axes(at(points, near) - points[:, :, None])
            n = torch.where((n * points).sum(dim=-1, keepdim=True) < 0, -n, n)
        x, f = points, None
        for level in self.levels:
            x, n, f = level(x, n, f)
        return self.head(f[:, 0])


def pose_features(x: Tensor, n: Tensor, axis: Tensor, index: Tensor) -> Tensor:
    """(B,N,3), axes, means, (B,N,k) → (B,8,N,k)."""
    edge = at(x, index) - x[:, :, None]
    length = torch.norm(edge, dim=-1, keepdim=True)
    mine, theirs = n[:, :, None].expand_as(edge), at(n, index)

    def beta(n: Tensor, axis: Tensor, e: Tensor) -> Tensor:
        a, b = torch.cross(n, unit(axis), dim=-1), torch.cross(n, unit(e), dim=-1)
        c = torch.cross(a, b, dim=-1)
        sine = torch.norm(c, dim=-1)
        sine = torch.where((c * n).sum(dim=-1) > 0, -sine, sine)
        return torch.atan2(sine, (a * b).sum(dim=-1))

    i, j = beta(mine, axis[:, :, None].expand_as(edge), edge), beta(theirs, at(axis, index), -edge)
    e = unit(edge)
    parts = [i.cos(), i.sin(), j.cos(), j.sin(), length[..., 0]]
    parts += [(mine * e).sum(dim=-1), (theirs * e).sum(dim=-1), (mine * theirs).sum(dim=-1)]
    return torch.stack(parts, dim=1)


def conv_norm(dims: int, a: int, b: int, slope: float | None, bias: bool = False) -> nn.Sequential:
    conv, norm = (nn.Conv1d, nn.BatchNorm1d) if dims == 1 else (nn.Conv2d, nn.BatchNorm2d)
    end = [] if slope is None else [nn.LeakyReLU(slope) if slope else nn.ReLU()]
    return nn.Sequential(conv(a, b, 1, bias=bias), norm(b), *end)


class Gate(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv = nn.Sequential(
            *conv_norm(2, channels, channels // 2, 0.2),
            nn.Conv2d(channels // 2, channels, 1, bias=False),
        )

    def forward(self, x: Tensor) -> Tensor:
        return x * torch.sigmoid(self.conv(x))


class PoseConv(nn.Module):
    def __init__(self, inputs: int, outputs: int, place: int) -> None:
        super().__init__()
        self.kernel = nn.Sequential(
            *conv_norm(2, 8, inputs // 4, 0.0, bias=True), nn.Conv2d(inputs // 4, inputs - place, 1)
        )
        self.gate = Gate(inputs)
        self.basis = nn.Conv1d(inputs, inputs, 1, bias=False)
        self.act = nn.Sequential(nn.BatchNorm2d(inputs), nn.ReLU())
        self.edge = conv_norm(2, 2 * inputs, outputs, 0.2)

    def forward(self, f: Tensor, index: Tensor, pose: Tensor, place: Tensor) -> Tensor:
        """(B,C,N), (B,N,k), (B,8,N,k), (B,C',N,k) → (B,C_out,N)."""
        kernel = self.gate(torch.cat([self.kernel(pose), place], dim=1))
        basis = at(self.basis(f).mT.contiguous(), index).permute(0, 3, 1, 2)
        h = self.act(kernel * basis)
        centre = f[..., None].expand_as(h)
        return self.edge(torch.cat([h - centre, centre], dim=1)).max(dim=-1).values


class LocalToGlobal(nn.Module):
    """With the layout of the global branch repaired, its own neighbours and no normals."""

    def __init__(self, num_classes: int, k: int = 20) -> None:
        super().__init__()
        self.k = k
        self.alpha = nn.Parameter(torch.zeros(1))
        self.embed_place = nn.Sequential(
            *conv_norm(1, 3, 64, 0.0), nn.Conv1d(64, 128, 1, bias=False)
        )
        self.query, self.key, self.value = (conv_norm(1, 128, c, 0.0) for c in (16, 16, 3))
        self.place1, self.place2 = conv_norm(2, 6, 32, 0.2), conv_norm(2, 32, 64, 0.2)
        self.gate = Gate(14)
        self.first = conv_norm(2, 20, 64, 0.2)
        self.convs = nn.ModuleList(
            [PoseConv(64, 64, 32), PoseConv(64, 128, 32), PoseConv(128, 256, 64)]
        )
        self.embed = conv_norm(1, 512, 1024, 0.2)
        self.head = nn.Sequential(
            nn.Linear(2048, 512, bias=False), nn.BatchNorm1d(512), nn.LeakyReLU(0.2),
            nn.Dropout(0.5), nn.Linear(512, 256), nn.BatchNorm1d(256), nn.LeakyReLU(0.2),
            nn.Dropout(0.5), nn.Linear(256, num_classes),
        )  # fmt: skip

    def pairs(self, x: Tensor, index: Tensor, own_first: bool) -> Tensor:
        mine = x[..., None].expand(-1, -1, -1, self.k)
        relative = at(x.mT.contiguous(), index).permute(0, 3, 1, 2) - mine
        return torch.cat([mine, relative] if own_first else [relative, mine], dim=1)

    def forward(self, points: Tensor) -> Tensor:
        with torch.no_grad():
            near = square_distance(points, points).topk(48, dim=-1, largest=False).indices
            relative = at(points, near) - points[:, :, None]
            axis = reference_axes(relative[:, :, :32])
            mean, ray = unit(relative.mean(dim=2)), unit(points)
            sine = torch.norm(torch.cross(axis, ray, dim=-1), dim=-1)
            f = torch.stack([torch.norm(points, dim=-1), (axis * ray).sum(dim=-1), sine], dim=1)
            own = torch.linalg.svd(at(points, sample(points, 32)), full_matrices=False).Vh.mT
            g = (points @ own).mT
        x = self.embed_place(g)
        weights = (self.key(x).mT @ self.query(x)).softmax(dim=-1)
        g = self.alpha * (weights @ self.value(x).mT).mT + g
        apart = nearest(g, self.k + 1)[..., 1:]
        index = near[..., 1 : self.k + 1]
        where = self.pairs(g, apart, own_first=True)
        gated = self.gate(torch.cat([pose_features(points, axis, mean, index), where], dim=1))
        f = self.first(torch.cat([gated, self.pairs(f, index, own_first=False)], dim=1))
        f = f.max(dim=-1).values
        places = [self.place1(where)]
        places += [places[0], self.place2(places[0])]
        features = [f]
        for conv, place in zip(self.convs, places, strict=True):
            index = nearest(f, self.k + 1)[..., 1:]
            f = conv(f, index, pose_features(points, axis, mean, index), place)
            features.append(f)
        x = self.embed(torch.cat(features, dim=1))
        return self.head(torch.cat([x.max(dim=-1).values, x.mean(dim=-1)], dim=1))


REFERENCES: dict[str, Callable[[int], nn.Module]] = {
    "riconv2": RIConv2,
    "vn-pointnet": VNPointNet,
    "vn-dgcnn": VNDGCNN,
    "local-to-global": LocalToGlobal,
}
