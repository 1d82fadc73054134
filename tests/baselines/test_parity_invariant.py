"""The rotation-robust models with published weights give what the published code printed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from baselines.local_to_global import LocalToGlobal, Trunk, pose_features
from baselines.lra import local_axes
from baselines.points import distances, gather
from baselines.riconv2 import RIConv2
from partialbench import registry
from partialbench.errors import InputError

FILES = {
    "riconv2": "riconv2",
    "vn-pointnet": "vn_pointnet",
    "vn-dgcnn": "vn_dgcnn",
    "local-to-global": "lgr_centauri",
}
TOLERANCE = 1e-4
every_model = pytest.mark.parametrize("name", FILES)


def fixture(shared: Path, name: str) -> tuple[dict[str, np.ndarray], dict[str, Tensor]]:
    """State, and everything else that the file holds."""
    with np.load(shared / "parity" / "modern" / f"{FILES[name]}.npz") as arrays:
        state = {k.removeprefix("state/"): arrays[k] for k in arrays if k.startswith("state/")}
        rest = {k: torch.from_numpy(arrays[k]) for k in arrays if not k.startswith("state/")}
    return state, rest


@torch.no_grad()
def off(name: str, state: dict[str, np.ndarray], rest: dict[str, Tensor]) -> Tensor:
    """Largest difference (B,) of each cloud's logits or log-probabilities."""
    model = registry.load_published(name, state, 40)
    given = {"normals": rest["normals"]} if "normals" in rest else {}
    logits = model(rest["points"], **given).class_logits
    if "logits" in rest:
        return (logits - rest["logits"]).abs().amax(dim=1)
    # The sign of RIConv++'s last axis was the solver's: either will do.
    answers = [rest[k] for k in ("log_probs", "log_probs_flipped") if k in rest]
    differences = [(logits.log_softmax(dim=-1) - a).abs().amax(dim=1) for a in answers]
    return torch.stack(differences).amin(dim=0)


@pytest.mark.parametrize("name", [n for n in FILES if n != "local-to-global"])
def test_answers_are_the_published_ones(shared: Path, name: str) -> None:
    assert off(name, *fixture(shared, name)).max() <= TOLERANCE


def test_local_to_global_answers_as_published_for_the_published_neighbours(
    shared: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are the same sets. Of one point two are as far to six digits, and the published order,
    by which the global branch's are joined to them, is that of its rounding."""
    state, rest = fixture(shared, "local-to-global")
    published = list(rest["neighbours"].long().unbind(dim=1))[1:]
    ours = []
    choose = Trunk.neighbours

    def given(trunk: Trunk, f: Tensor) -> Tensor:
        ours.append(choose(trunk, f))
        return published[len(ours) - 1]

    assert (off("local-to-global", state, rest) <= TOLERANCE).sum() >= 3
    monkeypatch.setattr(Trunk, "neighbours", given)
    assert off("local-to-global", state, rest).max() <= TOLERANCE
    for mine, theirs in zip(ours, published, strict=True):
        assert torch.equal(mine.sort(dim=-1).values, theirs.sort(dim=-1).values)


@every_model
def test_wrong_weights_do_not_pass(shared: Path, name: str) -> None:
    """The predicate can fail: swapping the two halves of one layer's input is noticed."""
    state, rest = fixture(shared, name)
    layer = next(n for n, a in state.items() if a.ndim >= 2 and a.shape[1] >= 42)
    state[layer] = np.roll(state[layer], state[layer].shape[1] // 2, axis=1)
    assert off(name, state, rest).max() > 5 * TOLERANCE


@every_model
def test_a_state_for_another_model_is_refused(shared: Path, name: str) -> None:
    state, _ = fixture(shared, name)
    with pytest.raises(InputError, match="another number of classes"):
        registry.load_published(name, state, 15)
    dropped = next(n for n in state if n.endswith("running_var") and "psa.bn" not in n)
    with pytest.raises(InputError, match="lacks the weights of"):
        registry.load_published(name, {k: v for k, v in state.items() if k != dropped}, 40)


def test_axes_and_rings_are_the_published_ones(shared: Path) -> None:
    state, rest = fixture(shared, "riconv2")
    points = rest["points"].double()
    near = distances(points, points).topk(32, largest=False).indices
    axes = local_axes(gather(points, near) - points[:, :, None])
    aligned = (axes * rest["normals"]).sum(dim=-1).abs()
    torch.testing.assert_close(aligned, torch.ones_like(aligned), atol=1e-6, rtol=0)
    model = registry.load_published("riconv2", state, 40)
    assert isinstance(model, RIConv2)
    first = model.levels(rest["points"], rest["normals"])[0].features
    # The published arc cosine of a float32 near 1 is that coarse.
    torch.testing.assert_close(first.float(), rest["sa0_features"], atol=1.2e-4, rtol=0)


def test_pose_features_are_the_published_ones(shared: Path) -> None:
    state, rest = fixture(shared, "local-to-global")
    model = registry.load_published("local-to-global", state, 40)
    assert isinstance(model, LocalToGlobal)
    made = model.geometry(rest["points"])
    features = pose_features(made.points, made.axes, made.mean, made.near)[:, :64]
    torch.testing.assert_close(features.float(), rest["appf"], atol=5e-5, rtol=0)
    torch.testing.assert_close(made.own.mT.float(), rest["global_coords"], atol=1e-5, rtol=0)
    torch.testing.assert_close(made.features.float(), rest["point_features"], atol=1e-5, rtol=0)
