"""Published weights are read whatever they are wrapped in, and computed with as published."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from partialbench import registry
from partialbench.errors import InputError

FILES = {
    "dgcnn": "dgcnn",
    "pointnet2-ssg": "pointnet2_ssg",
    "pointnet2-msg": "pointnet2_msg",
    "simpleview": "simpleview",
    "papnet": "papnet_40",
    "riconv2": "modern/riconv2",
    "riconv2-normals": "modern/riconv2",
    "vn-pointnet": "modern/vn_pointnet",
    "vn-dgcnn": "modern/vn_dgcnn",
    "local-to-global": "modern/lgr_centauri",
    "pointmlp-elite": "modern/pointmlp_elite",
    "pointnext-s": "modern/pointnext_s",
    "pct": "modern/pct",
    "canonical-pca24": "modern/pca24",
    "canonical-vn": "modern/equiadapt_vn",
}
LAST = {
    "dgcnn": "linear3",
    "simpleview": "final_fc.model.7",
    "papnet": "fc3_c",
    "vn-dgcnn": "linear3",
    "local-to-global": "linear3",
    "pointmlp-elite": "classifier.8",
    "pointnext-s": "prediction.head.4.0",
    "pct": "linear3",
    "canonical-pca24": "linear3",
    "canonical-vn": "prediction_network.linear2",
}
"""The layer that scores the classes, where it is not fc3."""
every_model = pytest.mark.parametrize("name", FILES)


def published(shared: Path, name: str) -> dict[str, np.ndarray]:
    with np.load(shared / "parity" / f"{FILES[name]}.npz") as arrays:
        return {k.removeprefix("state/"): arrays[k] for k in arrays if k.startswith("state/")}


def test_every_model_with_published_weights_is_asked() -> None:
    assert set(FILES) == {name for name, card in registry.cards().items() if card.published}


@every_model
def test_wrapped_weights_of_any_precision_are_the_same_model(shared: Path, name: str) -> None:
    state = published(shared, name)
    expected = registry.load_published(name, state, 40).state_dict()
    bare = {k: torch.from_numpy(v) for k, v in state.items() if "num_batches" not in k}
    tensors = {f"module.{k}": v.double() for k, v in bare.items()}
    # One key a model: several times as many loads find nothing more.
    key = registry.PUBLISHED_UNDER[list(FILES).index(name) % len(registry.PUBLISHED_UNDER)]
    checkpoint: dict[str, Any] = {"epoch": 3, "optimizer": {"param_groups": []}, key: tensors}
    found = registry.load_published(name, checkpoint, 40).state_dict()
    assert all(torch.equal(v, found[k]) for k, v in expected.items() if "num_batches" not in k)


@every_model
def test_other_classes_are_read_and_what_does_not_belong_is_named(shared: Path, name: str) -> None:
    state = published(shared, name)
    layer = LAST.get(name, "fc3")
    fewer = state | {
        f"{layer}.{leaf}": state[f"{layer}.{leaf}"][:15] for leaf in ("weight", "bias")
    }
    registry.load_published(name, fewer, 15)
    with pytest.raises(InputError, match="another number of classes"):
        registry.load_published(name, fewer, 40)
    with pytest.raises(InputError, match=r"'stn.fc.weight', which this model has no place for"):
        registry.load_published(name, state | {"stn.fc.weight": np.zeros(3)}, 40)
    with pytest.raises(InputError, match=r"the published 'optimizer' is a dict, expected an array"):
        registry.load_published(name, state | {"optimizer": {"lr": 0.1}}, 40)


def test_what_holds_no_weights_is_refused_in_a_sentence() -> None:
    with pytest.raises(InputError, match=r"a mapping of names to arrays, got a Linear.*state_dict"):
        registry.load_published("dgcnn", nn.Linear(3, 3), 40)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="lacks the weights of"):
        registry.load_published("dgcnn", {"model": {}}, 40)


def single_scale(state: dict[str, np.ndarray], cloud: Tensor) -> Tensor:
    """PointNet++'s log-probabilities (K,) of one cloud (N,3), ball by ball, as yanx27 has them."""

    def layer(x: Tensor, linear: str, norm: str) -> Tensor:
        p = {n: torch.from_numpy(a).flatten(1) if a.ndim > 2 else torch.from_numpy(a)
             for n, a in state.items() if n.startswith((f"{linear}.", f"{norm}."))}  # fmt: skip
        y = F.linear(x, p[f"{linear}.weight"], p[f"{linear}.bias"])
        y = (y - p[f"{norm}.running_mean"]) / (p[f"{norm}.running_var"] + 1e-5).sqrt()
        return F.relu(y * p[f"{norm}.weight"] + p[f"{norm}.bias"])

    def mlp(x: Tensor, level: str) -> Tensor:
        for i in range(3):
            x = layer(x, f"{level}.mlp_convs.{i}", f"{level}.mlp_bns.{i}")
        return x.amax(dim=0)

    x, f = cloud, cloud[:, :0]
    for level, count, radius, most in (("sa1", 512, 0.2, 32), ("sa2", 128, 0.4, 64)):
        away, chosen = torch.full((len(x),), torch.inf), [0]
        for _ in range(count - 1):
            away = torch.minimum(away, (x - x[chosen[-1]]).square().sum(dim=1))
            chosen.append(int(away.argmax()))
        pooled = []
        for centre in x[chosen]:
            near = ((x - centre).norm(dim=1) <= radius).nonzero()[:most, 0]
            pooled.append(mlp(torch.cat([x[near] - centre, f[near]], dim=1), level))
        x, f = x[chosen], torch.stack(pooled)
    y = mlp(torch.cat([x, f], dim=1), "sa3")
    for i in (1, 2):
        y = layer(y, f"fc{i}", f"bn{i}")
    last = [torch.from_numpy(state[f"fc3.{leaf}"]) for leaf in ("weight", "bias")]
    return F.linear(y, *last).log_softmax(dim=-1)


@pytest.mark.parametrize("number", [100, 300])
@torch.no_grad()
def test_pointnet2_samples_clouds_of_any_size_as_published(shared: Path, number: int) -> None:
    state = published(shared, "pointnet2-ssg")
    cloud = torch.randn(1, number, 3)
    cloud = cloud - cloud.mean(dim=1, keepdim=True)
    cloud = cloud * (0.9999 / cloud.norm(dim=-1).max())
    model = registry.load_published("pointnet2-ssg", state, 40)
    # The fixture's random weights hardly tell clouds apart: rounding moves them by 1e-6 at most.
    found = model(cloud).class_logits.log_softmax(dim=-1)[0]
    torch.testing.assert_close(found, single_scale(state, cloud[0]), atol=2e-6, rtol=0)


@pytest.mark.parametrize(
    ("name", "levels", "published_counts"),
    [
        ("pct", "levels", {256: (512, 256), 2048: (512, 256)}),
        ("pointmlp-elite", "stages", dict.fromkeys((256, 2048), (512, 256, 128, 64))),
        ("pointnext-s", "levels", {256: (128, 64, 32, 16), 2048: (1024, 512, 256, 128)}),
    ],
)
@torch.no_grad()
def test_levels_keep_as_many_points_as_published(
    shared: Path, name: str, levels: str, published_counts: dict[int, tuple[int, ...]]
) -> None:
    model = registry.load_published(name, published(shared, name), 40)
    seen: list[int] = []
    for level in model.get_submodule(levels).children():
        level.register_forward_hook(lambda _module, _inputs, out: seen.append(out.shape[1]))
    for number, counts in published_counts.items():
        seen.clear()
        assert model(torch.randn(1, number, 3)).class_logits.isfinite().all()
        assert tuple(seen) == counts
