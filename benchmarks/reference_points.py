"""The point models as their publications write them, for measuring against; not for use.

Channels first, 1×1 convolutions followed by batch norm and ReLU, every edge made before its layer,
ball queries by sorting. Each takes normalised clouds (B,N,3) and returns logits (B,K).

Source: the publications on the models' cards; layouts as in WangYueFt/dgcnn@f765b46,
yanx27/Pointnet_Pointnet2_pytorch@eb64fe0, wentaoyuan/it-net@55e654b.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn


def conv_mlp(dims: int, *channels: int, bias: bool = True, slope: float = 0.0) -> nn.Sequential:
    """1×1 convolutions with batch norm and (leaky) ReLU over ``dims`` dimensions."""
    conv, norm = (nn.Conv1d, nn.BatchNorm1d) if dims == 1 else (nn.Conv2d, nn.BatchNorm2d)
    layers: list[nn.Module] = []
    for a, b in pairwise(channels):
        layers += [conv(a, b, 1, bias=bias), norm(b), nn.LeakyReLU(slope) if slope else nn.ReLU()]
    return nn.Sequential(*layers)


def fc_head(*channels: int, dropout: float) -> nn.Sequential:
    *hidden, outputs = channels
    layers: list[nn.Module] = []
    for a, b in pairwise(hidden):
        layers += [nn.Linear(a, b), nn.BatchNorm1d(b), nn.ReLU(), nn.Dropout(dropout)]
    return nn.Sequential(*layers, nn.Linear(hidden[-1], outputs))


class TNet(nn.Module):
    def __init__(self, inputs: int, initial: Tensor) -> None:
        super().__init__()
        self.mlp = conv_mlp(1, inputs, 64, 128, 1024)
        self.head = fc_head(1024, 512, 256, len(initial), dropout=0.0)
        last = self.head[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        last.bias.data.copy_(initial)

    def forward(self, x: Tensor) -> Tensor:
        return self.head(self.mlp(x).max(dim=2).values)


class PointNet(nn.Module):
    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.tnet = TNet(3, torch.eye(3).flatten())
        self.mlp1 = conv_mlp(1, 3, 64, 64)
        self.feature_tnet = TNet(64, torch.eye(64).flatten())
        self.mlp2 = conv_mlp(1, 64, 64, 128, 1024)
        self.head = fc_head(1024, 512, 256, num_classes, dropout=0.3)

    def forward(self, points: Tensor) -> Tensor:
        transform = self.tnet(points.mT).view(-1, 3, 3)
        x = self.mlp1((points @ transform).mT)
        transform = self.feature_tnet(x).view(-1, 64, 64)
        x = self.mlp2((x.mT @ transform).mT)
        return self.head(x.max(dim=2).values)


class DGCNN(nn.Module):
    def __init__(self, num_classes: int, k: int = 20) -> None:
        super().__init__()
        self.k = k
        self.convs = nn.ModuleList(
            conv_mlp(2, 2 * a, b, bias=False, slope=0.2) for a, b in pairwise((3, 64, 64, 128, 256))
        )
        self.embed = conv_mlp(1, 512, 1024, bias=False, slope=0.2)
        self.head = nn.Sequential(
            nn.Linear(2048, 512, bias=False), nn.BatchNorm1d(512), nn.LeakyReLU(0.2),
            nn.Dropout(0.5), nn.Linear(512, 256), nn.BatchNorm1d(256), nn.LeakyReLU(0.2),
            nn.Dropout(0.5), nn.Linear(256, num_classes),
        )  # fmt: skip

    def edges(self, x: Tensor) -> Tensor:
        """(B,C,N) → (B,2C,N,k): every neighbour relative to its centre, and the centre."""
        inner = -2 * x.mT @ x
        square = (x**2).sum(dim=1, keepdim=True)
        index = (-square - inner - square.mT).topk(self.k, dim=-1).indices
        batch, channels, number = x.shape
        rows = (index + torch.arange(batch, device=x.device)[:, None, None] * number).view(-1)
        x = x.mT.contiguous()
        neighbours = x.view(batch * number, channels)[rows].view(batch, number, self.k, channels)
        centre = x[:, :, None].expand_as(neighbours)
        return torch.cat([neighbours - centre, centre], dim=3).permute(0, 3, 1, 2).contiguous()

    def forward(self, points: Tensor) -> Tensor:
        x, features = points.mT, []
        for conv in self.convs:
            x = conv(self.edges(x)).max(dim=-1).values
            features.append(x)
        x = self.embed(torch.cat(features, dim=1))
        pooled = torch.cat([x.amax(dim=2), x.mean(dim=2)], dim=1)
        return self.head(pooled)


def at(points: Tensor, index: Tensor) -> Tensor:
    """(B,N,C) at (B,…) → (B,…,C)."""
    batch = torch.arange(len(points), device=points.device)
    return points[batch.view(-1, *[1] * (index.ndim - 1)).expand_as(index), index]


@torch.no_grad()
def sample(points: Tensor, count: int) -> Tensor:
    batch, number, _ = points.shape
    chosen = torch.zeros(batch, count, dtype=torch.long, device=points.device)
    distance = torch.full((batch, number), 1e10, device=points.device, dtype=points.dtype)
    last = torch.zeros(batch, dtype=torch.long, device=points.device)
    rows = torch.arange(batch, device=points.device)
    for i in range(count):
        chosen[:, i] = last
        square = ((points - points[rows, last].view(batch, 1, 3)) ** 2).sum(dim=-1)
        closer = square < distance
        distance[closer] = square[closer]
        last = distance.max(dim=-1).indices
    return chosen


@torch.no_grad()
def ball(centres: Tensor, points: Tensor, radius: float, count: int) -> Tensor:
    batch, number, _ = points.shape
    square = -2 * centres @ points.mT
    square += (centres**2).sum(dim=-1)[:, :, None] + (points**2).sum(dim=-1)[:, None]
    index = torch.arange(number, device=points.device).repeat(batch, centres.shape[1], 1)
    index[square > radius**2] = number
    index = index.sort(dim=-1).values[:, :, :count]
    first = index[:, :, :1].expand_as(index)
    return torch.where(index == number, first, index)


class SetAbstraction(nn.Module):
    def __init__(self, features: int, count: int, scales: tuple, use_xyz: bool = True) -> None:
        super().__init__()
        self.count, self.scales, self.use_xyz = count, scales, use_xyz
        inputs = features + 3 * use_xyz
        self.mlps = nn.ModuleList(conv_mlp(2, inputs, *widths) for _, _, widths in scales)

    def forward(self, xyz: Tensor, features: Tensor | None) -> tuple[Tensor, Tensor]:
        centres = at(xyz, sample(xyz, self.count))
        pooled = []
        for (radius, count, _), mlp in zip(self.scales, self.mlps, strict=True):
            index = ball(centres, xyz, radius, count)
            parts = [at(xyz, index) - centres[:, :, None]] if self.use_xyz else []
            parts += [] if features is None else [at(features, index)]
            grouped = torch.cat(parts, dim=-1).permute(0, 3, 2, 1)
            pooled.append(mlp(grouped).max(dim=2).values)
        return centres, torch.cat(pooled, dim=1).mT


SSG = (((0.2, 32, (64, 64, 128)),), ((0.4, 64, (128, 128, 256)),))
MSG = (
    ((0.1, 16, (32, 32, 64)), (0.2, 32, (64, 64, 128)), (0.4, 128, (64, 96, 128))),
    ((0.2, 32, (64, 64, 128)), (0.4, 64, (128, 128, 256)), (0.8, 128, (128, 128, 256))),
)


class PointNet2(nn.Module):
    def __init__(
        self, num_classes: int, levels: tuple = SSG, features: int = 0, use_xyz: bool = True
    ) -> None:
        super().__init__()
        self.use_xyz = use_xyz
        self.sa1 = SetAbstraction(features, 512, levels[0], use_xyz)
        middle = sum(widths[-1] for _, _, widths in levels[0])
        self.sa2 = SetAbstraction(middle, 128, levels[1], use_xyz)
        last = sum(widths[-1] for _, _, widths in levels[1]) + 3 * use_xyz
        self.sa3 = conv_mlp(2, last, 256, 512, 1024)
        self.head = fc_head(1024, 512, 256, num_classes, dropout=0.5)

    def forward(self, points: Tensor, features: Tensor | None = None) -> Tensor:
        xyz, x = self.sa1(points, features)
        xyz, x = self.sa2(xyz, x)
        x = torch.cat([xyz, x], dim=-1) if self.use_xyz else x
        x = self.sa3(x.mT[..., None]).max(dim=2).values
        return self.head(x[..., 0])


class TNetPointNet2(nn.Module):
    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.tnet = TNet(3, torch.eye(3).flatten())
        self.classifier = PointNet2(num_classes)

    def forward(self, points: Tensor) -> Tensor:
        return self.classifier(points @ self.tnet(points.mT).view(-1, 3, 3))


class ITNetPointNet2(nn.Module):
    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.tnet = TNet(3, torch.tensor([1.0, 0, 0, 0, 0, 0, 0]))
        self.classifier = PointNet2(num_classes)

    def forward(self, points: Tensor) -> Tensor:
        R = torch.eye(3, device=points.device, dtype=points.dtype).expand(len(points), 3, 3)
        t = points.new_zeros(len(points), 1, 3)
        for _ in range(2):
            numbers = self.tnet((points @ R.mT + t).detach().mT)
            w, x, y, z = F.normalize(numbers[:, :4], dim=1).unbind(dim=1)
            step = torch.stack(
                [
                    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
                ],
                dim=1,
            ).view(-1, 3, 3)  # fmt: skip
            R, t = step @ R, t @ step.mT + numbers[:, None, 4:]
        return self.classifier(points @ R.mT + t)


class RRIPointNet2(nn.Module):
    """With the pairwise formula for φ: the angle to every other neighbour, then the least."""

    def __init__(self, num_classes: int, k: int = 32) -> None:
        super().__init__()
        self.k = k
        self.embed = conv_mlp(2, 4, 64)
        self.classifier = PointNet2(num_classes, features=64, use_xyz=False)

    @torch.no_grad()
    def features(self, points: Tensor) -> Tensor:
        index = torch.cdist(points, points).topk(self.k + 1, largest=False).indices[..., 1:]
        q = at(points, index)
        r = points.norm(dim=-1, keepdim=True)
        r_k = q.norm(dim=-1, keepdim=True)
        p_hat, q_hat = (points / r)[:, :, None], q / r_k
        cosine = (p_hat * q_hat).sum(dim=-1, keepdim=True)
        t = F.normalize(q_hat - cosine * p_hat, dim=-1)
        turn = torch.linalg.cross(t[:, :, :, None], t[:, :, None].expand(-1, -1, self.k, -1, -1))
        sine = (turn * p_hat[:, :, None]).sum(dim=-1)
        psi = torch.atan2(sine, t @ t.mT).remainder(2 * torch.pi)
        psi.diagonal(dim1=2, dim2=3).fill_(torch.inf)
        phi = psi.amin(dim=-1, keepdim=True)
        r = r[:, :, None].expand_as(r_k)
        return torch.cat([r, r_k, torch.acos(cosine.clamp(-1, 1)), phi], dim=-1)

    def forward(self, points: Tensor) -> Tensor:
        x = self.embed(self.features(points).permute(0, 3, 2, 1)).max(dim=2).values
        return self.classifier(points, x.mT)


REFERENCES: dict[str, Callable[[int], nn.Module]] = {
    "pointnet": PointNet,
    "dgcnn": DGCNN,
    "pointnet2-ssg": PointNet2,
    "pointnet2-msg": lambda num_classes: PointNet2(num_classes, MSG),
    "tnet-pointnet2": TNetPointNet2,
    "itnet-pointnet2": ITNetPointNet2,
    "rri-pointnet2": RRIPointNet2,
}
