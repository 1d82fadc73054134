"""Frames of a cloud's own: what the wrappers publish, and that a turn leaves nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from baselines.canonical_pca24 import (
    CanonicalPCA24,
    composed,
    octahedral_group,
    principal_frame,
)
from baselines.canonical_vn import CanonicalVN, frame_of
from baselines.points import normalise
from partialbench import registry
from partialbench.errors import InputError
from partialbench.geometry.rotations import haar_rotations

WRAPPERS = ("canonical-pca24", "canonical-vn")


def fixture(shared: Path, stem: str) -> tuple[dict[str, np.ndarray], dict[str, Tensor]]:
    """State, and everything else that the file holds."""
    with np.load(shared / "parity" / "modern" / f"{stem}.npz") as arrays:
        state = {k.removeprefix("state/"): arrays[k] for k in arrays if k.startswith("state/")}
        rest = {k: torch.from_numpy(arrays[k]) for k in arrays if not k.startswith("state/")}
    return state, rest


def parameters(model: nn.Module) -> int:
    return sum(p.numel() for p in model.parameters())


def turned(points: Tensor, rng: np.random.Generator) -> Tensor:
    R = torch.from_numpy(haar_rotations(rng, len(points)))
    return (points.double() @ R.mT).to(points.dtype)


@torch.no_grad()
def test_24_poses_answer_as_published(shared: Path) -> None:
    """Which of four frames is order 0 is the solver's choice; the 24 orders together are not."""
    state, rest = fixture(shared, "pca24")
    model = registry.load_published("canonical-pca24", state, 40)
    assert isinstance(model, CanonicalPCA24)
    blended, weights = model.pose(rest["canonical"], torch.zeros(3, dtype=torch.long))
    torch.testing.assert_close(weights, rest["selector_weights"], atol=1e-6, rtol=0)
    torch.testing.assert_close(blended, rest["blended"], atol=1e-6, rtol=0)
    logits = model.backbone(blended).class_logits
    torch.testing.assert_close(logits, rest["logits"], atol=1e-4, rtol=0)
    # A sum of 24 has 24 times the rounding; neighbours among features may flip in some.
    off = (model(rest["points"]).class_logits - rest["logits_24_orders"].sum(dim=1)).abs() / 24
    assert float(off.max()) <= 1e-3
    assert parameters(model) == 2_907_849 - 3072


def test_principal_frames_and_the_group_are_the_published_ones(shared: Path) -> None:
    _, rest = fixture(shared, "pca24")
    group = octahedral_group()
    assert torch.equal(group, rest["rotations"].float())
    assert torch.equal(composed(group), rest["orders"].long())
    frame = principal_frame(normalise(rest["points"], radius=1.0))
    poses = rest["canonical"][:, None] @ group
    distance = (poses - frame[:, None]).abs().amax(dim=(2, 3))
    assert float(distance.amin(dim=1).max()) <= 1e-6


@torch.no_grad()
def test_learned_frames_answer_as_published(shared: Path) -> None:
    state, rest = fixture(shared, "equiadapt_vn")
    model = registry.load_published("canonical-vn", state, 40)
    assert isinstance(model, CanonicalVN)
    vectors = model.frame(normalise(rest["points"], radius=1.0).double())[:, :3]
    torch.testing.assert_close(vectors.float(), rest["vectors"], atol=1e-5, rtol=0)
    canonical, frame = model.canonical(rest["points"])
    torch.testing.assert_close(frame.float(), rest["rotation"], atol=5e-5, rtol=0)
    torch.testing.assert_close(canonical, rest["canonical"], atol=5e-5, rtol=0)
    output = model(rest["points"])
    torch.testing.assert_close(output.class_logits, rest["logits"], atol=1e-4, rtol=0)
    prior = output.penalty / model.prior
    torch.testing.assert_close(prior.float(), rest["prior_loss"], atol=1e-5, rtol=0)
    assert parameters(model) == 697_478
    assert parameters(model.frame) == 1310


@pytest.mark.parametrize(
    ("name", "stem", "layer"),
    [
        ("canonical-pca24", "pca24", "conv5.0.weight"),
        ("canonical-vn", "equiadapt_vn", "prediction_network.conv5.weight"),
    ],
)
def test_wrong_weights_and_other_states_do_not_pass(
    shared: Path, name: str, stem: str, layer: str
) -> None:
    state, rest = fixture(shared, stem)
    points = rest["points"][:1]
    with torch.no_grad():
        right = registry.load_published(name, state, 40)(points).class_logits
        rolled = state | {layer: np.roll(state[layer], 30, axis=1)}
        wrong = registry.load_published(name, rolled, 40)(points).class_logits
    assert (wrong - right).abs().max() > 1e-2
    with pytest.raises(InputError, match="another number of classes"):
        registry.load_published(name, state, 15)
    with pytest.raises(InputError, match="lacks the weights of"):
        registry.load_published(name, {k: v for k, v in state.items() if k != layer}, 40)


def test_published_counts_of_other_backbones() -> None:
    assert parameters(registry.create("canonical-vn", 40, backbone="dgcnn")) == 1_810_886


def settled(name: str, points: Tensor) -> nn.Module:
    """Before a backbone that chooses no points, so that only the frame can err; with the running
    statistics of these clouds."""
    model = registry.create(name, 10, backbone="pointnet")
    for module in model.modules():
        if isinstance(module, nn.BatchNorm1d):
            module.momentum = 1.0
    with torch.no_grad():
        for _ in range(6):
            model.train()(points)
    return model.eval()


@pytest.mark.parametrize("name", WRAPPERS)
@torch.no_grad()
def test_a_turned_cloud_gets_the_same_answer_and_its_mirror_image_another(
    name: str, clouds: Tensor
) -> None:
    rng = np.random.default_rng(3)
    model = settled(name, clouds)
    before = model(clouds).class_logits
    spread = float((before - before.roll(1, dims=0)).abs().max())
    for _ in range(3):
        after = model(turned(clouds, rng)).class_logits
        assert float((after - before).abs().max()) <= 1e-4 * spread
    mirrored = model(clouds * torch.tensor([1.0, 1.0, -1.0])).class_logits
    assert float((mirrored - before).abs().max()) > 1e-2 * spread


def test_frames_are_right_handed_unless_mirrored() -> None:
    vectors = torch.randn(64, 3, 3)
    for mirror, least in ((False, 1.0), (True, -1.0)):
        frame = frame_of(vectors, mirror)
        identity = torch.eye(3).expand_as(frame)
        torch.testing.assert_close(frame @ frame.mT, identity, atol=1e-4, rtol=0)
        assert float(torch.linalg.det(frame).min()) == pytest.approx(least, abs=1e-4)
    canonical = frame_of(torch.zeros(2, 3, 3))
    assert torch.equal(canonical, torch.zeros(2, 3, 3))


def test_the_prior_says_nothing_of_clouds_turned_at_random(clouds: Tensor) -> None:
    """Its mean is 2/3 for whatever frame, so it is off unless asked for."""
    model = CanonicalVN(10, backbone="released", prior=1.0).eval()
    rng = np.random.default_rng(0)
    many = clouds[:1, :64].expand(400, -1, -1)
    with torch.no_grad():
        _, frame = model.canonical(turned(many, rng))
        prior = (frame - torch.eye(3)).square().mean()
        assert float(prior) == pytest.approx(2 / 3, abs=0.03)
        assert CanonicalVN(10, backbone="released").eval()(clouds).penalty is None
        assert model(clouds).penalty is not None


def test_training_draws_a_pose_a_cloud(clouds: Tensor) -> None:
    model = CanonicalPCA24(10, backbone="pointnet").train()
    seen: list[Tensor] = []
    model.backbone.register_forward_pre_hook(lambda _module, inputs: seen.append(inputs[0]))
    for _ in range(20):
        model(clouds)
    frame = principal_frame(normalise(clouds, radius=1.0))
    poses = frame[:, None] @ octahedral_group()
    drawn = [(poses - one[:, None]).abs().amax(dim=(2, 3)).argmin(dim=1) for one in seen]
    assert len(torch.cat(drawn).unique()) > 15
    model.eval()(clouds)
    assert len(seen) == 20 + 24


@pytest.mark.parametrize("name", WRAPPERS)
def test_backbones_that_do_not_fit_are_refused(name: str, clouds: Tensor) -> None:
    with pytest.raises(InputError, match="no model named 'pointnet3'"):
        registry.create(name, 10, backbone="pointnet3")
    with pytest.raises(InputError, match="has no option 'k'"):
        registry.create(name, 10, backbone="pointnet", backbone_options={"k": 3})
    with pytest.raises(InputError, match="has no options"):
        registry.create(name, 10, backbone="released", backbone_options={"k": 3})
    model = registry.create(name, 10, backbone="papnet-steered").eval()
    with pytest.raises(InputError, match="predicts a pose"), torch.no_grad():
        model(clouds)


def test_options_of_the_backbone_arrive(clouds: Tensor) -> None:
    model = registry.create("canonical-vn", 10, backbone="dgcnn", backbone_options='{"k": 7}')
    assert isinstance(model, CanonicalVN)
    assert model.backbone.network.k == 7
    assert model.eval()(clouds).class_logits.shape == (3, 10)
    for wrong in ({"prior": -1.0}, {"quirks": "blend"}):
        with pytest.raises(InputError):
            registry.create("canonical-vn", 10, **wrong)


@torch.no_grad()
def test_the_blend_of_clouds_in_double_precision_is_taken(clouds: Tensor) -> None:
    model = CanonicalPCA24(5, "pointnet", pooling="blend").eval()
    single, double = (model(points).class_logits for points in (clouds, clouds.double()))
    torch.testing.assert_close(double, single, atol=1e-4 * float(single.abs().max()), rtol=0)
