"""PointMLP (elite): residual MLPs on neighbourhoods of a sampled cloud, four times.

Source: Ma et al., Rethinking Network Design and Local Geometry in Point Cloud, ICLR 2022;
ma-xu/pointMLP-pytorch@1ab7f04.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from baselines.anchors import QUIRKS, anchors, nearest, num_anchors
from baselines.dense_edges import NarrowLinear, activated_edges, residual_max
from baselines.edges import cloud_edge_moments
from baselines.points import full_precision, gather, normalise
from baselines.published import chosen_quirks, tensors
from baselines.shared_mlp import Normed, NormLinear, activated, head
from partialbench.benchmark.prediction import Prediction

ANCHORS = (512, 256, 128, 64)
"""Of clouds of 1,024 points."""
NEIGHBOURS = 24
EPS = 1e-5


class Residual(nn.Module):
    """ReLU(x + BN(V·ReLU(BN(U·x)))) with a quarter of the channels between."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.narrow = NarrowLinear(channels, channels // 4)
        self.wide = NormLinear(channels // 4, channels, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """(…,C) → (…,C)."""
        h = self.narrow(x)
        return F.relu_(self.wide(h).add_(x))

    def max(self, x: Tensor) -> Tensor:
        """(…,n,C) → (…,C): the largest over n."""
        h = self.narrow(x)
        weight, bias = self.wide.folded(h)
        return F.relu_(residual_max(x, h, weight) + bias)


class GroupLayer(Normed):
    """ReLU(BN(W·[α⊙(f_j − f_i)/σ + β, f_i])) of every edge.

    σ is the standard deviation of all f_j − f_i of a cloud, over its edges and their channels.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(2 * inputs, outputs, bias=False)
        self.alpha = nn.Parameter(torch.ones(inputs))
        self.beta = nn.Parameter(torch.zeros(inputs))

    def forward(self, f: Tensor, centres: Tensor, index: Tensor) -> Tensor:
        """(B,N,C), (B,S,C), (B,S,n) → (B,S,n,C_out)."""
        relative, own = self.linear.weight.chunk(2, dim=1)
        with torch.autocast(f.device.type, enabled=False):
            f, centres = full_precision(f), full_precision(centres)
            mean, var = cloud_edge_moments(f, -centres, index)
            # Of all channels together; unbiased, as published.
            whole = (var + mean.square()).mean(dim=1) - mean.mean(dim=1).square()
            count = index[0].numel() * f.shape[-1]
            spread = (whole * (count / (count - 1))).clamp_min(1e-20).sqrt()
            scale = (1 / (spread + EPS))[:, None, None]
            a = F.linear(f, relative * self.alpha) * scale
            c = F.linear(centres, own) - F.linear(centres, relative * self.alpha) * scale
            c = c + F.linear(self.beta, relative)
        return activated_edges(self, a, c, index, 0.0)


class Stage(nn.Module):
    """Half of the points, each with what its neighbourhood says of it.

    Args:
        inputs, outputs: channels.
        blocks: residual blocks on the edges, and as many on the points after the maximum.
    """

    def __init__(self, inputs: int, outputs: int, blocks: int) -> None:
        super().__init__()
        self.group = GroupLayer(inputs, outputs)
        self.edges = nn.ModuleList(Residual(outputs) for _ in range(blocks))
        self.points = nn.ModuleList(Residual(outputs) for _ in range(blocks))

    def forward(self, f: Tensor, centres: Tensor, index: Tensor) -> Tensor:
        """(B,N,C), (B,S,C), (B,S,n) → (B,S,C_out)."""
        x = self.group(f, centres, index)
        *inner, last = self.edges
        for block in inner:
            x = block(x)
        assert isinstance(last, Residual)
        x = last.max(x)
        for block in self.points:
            x = block(x)
        return x


class PointMLP(nn.Module):
    """PointMLP-elite: embedding 32; stages of 64, 128, 256, 256 channels with 1, 1, 2, 1 residual
    blocks before and after the maximum over 24 neighbours; maximum over points, 512-256-K.

    Args:
        quirks: what of ``anchors.QUIRKS`` to do as published, joined by "+".
    """

    def __init__(self, num_classes: int, quirks: str = "") -> None:
        super().__init__()
        self.quirks = chosen_quirks(quirks, QUIRKS)
        self.embed = NormLinear(3, 32, bias=False)
        widths, blocks = (32, 64, 128, 256, 256), (1, 1, 2, 1)
        self.stages = nn.ModuleList(
            Stage(widths[i], widths[i + 1], blocks[i]) for i in range(len(blocks))
        )
        self.head = head(256, 512, 256, num_classes, dropout=(0.5, 0.5))

    def forward(self, points: Tensor) -> Prediction:
        """(B,N,3) clouds in the camera frame → logits (B,K)."""
        points = normalise(points, radius=1.0)
        # Neighbours are told apart by differences of these alone: no half precision here.
        with torch.autocast(points.device.type, enabled=False):
            x = activated([self.embed], points)
        counts = num_anchors(points.shape[1], ANCHORS, self.quirks)
        chosen = anchors(points, counts[0], self.quirks)
        kept, centres = gather(points, chosen), gather(x, chosen)
        for stage, count in zip(self.stages, counts, strict=True):
            # The first of the anchors are the anchors of the anchors.
            kept, centres = kept[:, :count], centres[:, :count]
            x = stage(x, centres, nearest(kept, points, NEIGHBOURS))
            points = kept
            centres = x
        return Prediction(self.head(x.amax(dim=1)))


def from_published(state: Mapping[str, Tensor], model: nn.Module) -> dict[str, Tensor]:
    """The release's state dict, without a positional embedding of its own, → ours."""
    renamed = {}
    for name, value in state.items():
        for theirs, ours in (("affine_alpha", "alpha"), ("affine_beta", "beta")):
            if name.endswith(theirs):
                name, value = name.removesuffix(theirs) + ours, value.flatten()
        renamed[name] = value
    prefixes = {"embedding.net.0": "embed.linear", "embedding.net.1": "embed.norm"}
    prefixes |= {f"classifier.{i}": f"head.{i}" for i in (0, 1, 4, 5, 8)}
    for i in range(4):
        group = f"stages.{i}.group"
        prefixes[f"local_grouper_list.{i}"] = group
        prefixes[f"pre_blocks_list.{i}.transfer.net.0"] = f"{group}.linear"
        prefixes[f"pre_blocks_list.{i}.transfer.net.1"] = f"{group}.norm"
        for theirs, ours in (("pre", "edges"), ("pos", "points")):
            for block in range(2):
                for net, layer in (("net1", "narrow"), ("net2", "wide")):
                    published = f"{theirs}_blocks_list.{i}.operation.{block}.{net}"
                    mine = f"stages.{i}.{ours}.{block}.{layer}"
                    prefixes |= {f"{published}.0": f"{mine}.linear"}
                    prefixes |= {f"{published}.1": f"{mine}.norm"}
    return tensors(renamed, model, prefixes)
