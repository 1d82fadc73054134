"""PCT: two levels of neighbourhoods, then attention between all points that are left.

Source: Guo et al., PCT: Point Cloud Transformer, CVM 2021; Strawberry-Eat-Mango/PCT_Pytorch@0199a3b
(``model.py``).
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from baselines.anchors import QUIRKS, anchors, nearest, num_anchors
from baselines.dense_edges import EdgeLayer
from baselines.points import gather, normalise
from baselines.published import chosen_quirks, tensors
from baselines.shared_mlp import NormLinear, activated
from partialbench.benchmark.prediction import Prediction
from partialbench.errors import InputError

ANCHORS = (512, 256)
"""Of clouds of 1,024 points."""
NEIGHBOURS = 32
SLOPE = 0.2
"""Of the LeakyReLUs after the attention."""


class Neighbourhood(nn.Module):
    """Two layers on [f_j − f_i, f_i], the maximum over the neighbours j."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.first = EdgeLayer(inputs, outputs)
        self.second = NormLinear(outputs, outputs, bias=False)

    def forward(self, f: Tensor, centres: Tensor, index: Tensor) -> Tensor:
        """(B,N,C), (B,S,C), (B,S,n) → (B,S,C_out)."""
        return F.relu_(self.second.max(self.first(f, centres, index)))


class OffsetAttention(nn.Module):
    """x + ReLU(BN(W·(x − r))), r_j = Σ_i A_ij·v_i.

    A = softmax over j of q_i·q_j, then its columns divided by their sums: queries are keys.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.query = nn.Linear(channels, channels // 4, bias=False)
        self.value = nn.Linear(channels, channels)
        self.out = NormLinear(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        """(B,S,C) → (B,S,C)."""
        q = self.query(x)
        share = (q @ q.mT).softmax(dim=-1)
        share = share / (1e-9 + share.sum(dim=1, keepdim=True))
        return x + F.relu(self.out(x - share.mT @ self.value(x)))


class PCT(nn.Module):
    """3-64-64 a point; neighbourhoods of 128 channels on half of the points, of 256 on a quarter;
    256-256, four attention layers, their outputs and what went in joined, 1024 channels a point,
    maximum, 512-256-K.

    Args:
        quirks: what of ``anchors.QUIRKS`` to do as published, joined by "+".
    """

    def __init__(self, num_classes: int, quirks: str = "") -> None:
        super().__init__()
        self.quirks = chosen_quirks(quirks, QUIRKS)
        self.embed = nn.ModuleList(NormLinear(a, 64, bias=False) for a in (3, 64))
        self.levels = nn.ModuleList([Neighbourhood(64, 128), Neighbourhood(128, 256)])
        self.mix = nn.ModuleList(NormLinear(256, 256, bias=False) for _ in range(2))
        self.attention = nn.ModuleList(OffsetAttention(256) for _ in range(4))
        self.join = NormLinear(1280, 1024, bias=False)
        self.head = nn.Sequential(
            nn.Linear(1024, 512, bias=False),
            nn.BatchNorm1d(512),
            nn.LeakyReLU(SLOPE, inplace=True),
            nn.Dropout(0.5),
            nn.Linear(512, 256),
            nn.BatchNorm1d(256),
            nn.LeakyReLU(SLOPE, inplace=True),
            nn.Dropout(0.5),
            nn.Linear(256, num_classes),
        )

    def forward(self, points: Tensor) -> Prediction:
        """(B,N,3) clouds in the camera frame → logits (B,K)."""
        points = normalise(points, radius=1.0)
        x = activated(self.embed, points)
        counts = num_anchors(points.shape[1], ANCHORS, self.quirks)
        chosen = anchors(points, counts[0], self.quirks)
        kept, centres = gather(points, chosen), gather(x, chosen)
        for level, count in zip(self.levels, counts, strict=True):
            # The first of the anchors are the anchors of the anchors.
            kept, centres = kept[:, :count], centres[:, :count]
            x = centres = level(x, centres, nearest(kept, points, NEIGHBOURS))
            points = kept
        joined = [x]
        x = activated(self.mix, x)
        for i, layer in enumerate(self.attention):
            x = layer(x)
            joined.insert(i, x)
        # The activation rises, so it may follow the maximum.
        x = F.leaky_relu(self.join.max(torch.cat(joined, dim=-1)), SLOPE)
        return Prediction(self.head(x))


def from_published(state: Mapping[str, Tensor], model: nn.Module) -> dict[str, Tensor]:
    """The state dict of the release's ``model.py`` → ours.

    Raises:
        InputError: keys with weights other than the queries', which the release shares.
    """
    state = dict(state)
    prefixes = {"linear1": "head.0", "bn6": "head.1", "linear2": "head.4", "bn7": "head.5"}
    prefixes |= {"linear3": "head.8", "conv_fuse.0": "join.linear", "conv_fuse.1": "join.norm"}
    layers: dict[str, str] = {}
    for i in range(2):
        layers |= {f"conv{i + 1}": f"embed.{i}.linear", f"bn{i + 1}": f"embed.{i}.norm"}
        layers |= {f"pt_last.conv{i + 1}": f"mix.{i}.linear", f"pt_last.bn{i + 1}": f"mix.{i}.norm"}
        for j, name in enumerate(("first", "second")):
            local, ours = f"gather_local_{i}", f"levels.{i}.{name}"
            layers |= {f"{local}.conv{j + 1}": f"{ours}.linear"}
            layers |= {f"{local}.bn{j + 1}": f"{ours}.norm"}
    for i in range(4):
        theirs, ours = f"pt_last.sa{i + 1}", f"attention.{i}"
        layers |= {f"{theirs}.q_conv": f"{ours}.query", f"{theirs}.v_conv": f"{ours}.value"}
        layers |= {f"{theirs}.trans_conv": f"{ours}.out.linear"}
        layers |= {f"{theirs}.after_norm": f"{ours}.out.norm"}
        key, query = (state.pop(f"{theirs}.{x}_conv.weight", None) for x in "kq")
        if query is not None:
            state[f"{theirs}.q_conv.weight"] = query
        if key is not None and query is not None and not torch.equal(key.float(), query.float()):
            raise InputError(
                f"the published {theirs}.k_conv has other weights than {theirs}.q_conv; this model "
                f"has one for both, as the release has"
            )
    return tensors(state, model, prefixes | layers)
