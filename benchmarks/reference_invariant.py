"""The rotation-robust models as their publications write them, to measure against; not for use.

Every edge is made before its layer, channels first. Each takes normalised clouds (B,N,3) and
returns logits (B,K). Source: modern cards; layouts as in FlyingGiraffe/vnn@f3197e2.
"""

from __future__ import annotations

from collections.abc import Callable

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


REFERENCES: dict[str, Callable[[int], nn.Module]] = {
    "vn-pointnet": VNPointNet,
    "vn-dgcnn": VNDGCNN,
}
