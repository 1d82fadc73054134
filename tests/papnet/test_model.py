"""PAPNet's training and its ablations, on a small grid."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from baselines.points import normalise
from papnet import pose
from papnet.model import VARIANTS, PAPNet
from partialbench.benchmark.prediction import Batch
from partialbench.errors import InputError
from partialbench.geometry.bins import nearest_bins, rotation_bins
from partialbench.geometry.rotations import geodesic_angle


def batch(size: int = 4) -> Batch:
    generator = torch.Generator().manual_seed(0)
    R = torch.tensor(Rotation.random(2 * size, random_state=0).as_matrix()).float()
    points = torch.randn(size, 100, 3, generator=generator) * torch.tensor([1.0, 0.6, 0.3])
    return Batch(points, torch.arange(size), R[:size], R[size:])


def small(variant: str = "ground-truth", **options: object) -> PAPNet:
    torch.manual_seed(0)
    if VARIANTS[variant].ensemble:
        options.setdefault("k", 3)
    return PAPNet(5, variant=variant, grid=16, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(("classes", "count"), [(40, 1_154_874), (15, 1_151_649)])
def test_parameter_count(classes: int, count: int) -> None:
    assert sum(p.numel() for p in PAPNet(classes).parameters()) == count


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_ablation_trains_every_parameter_and_answers(variant: str) -> None:
    model, data = small(variant), batch()
    loss = model.train().training_loss(data)
    loss.backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        # Biases before a batch norm have a gradient of rounding only.
        assert name.endswith("bias") or parameter.grad.any(), name
    with torch.no_grad():
        out = model.eval()(data.points)
    assert out.class_logits.shape == (4, 5)
    if VARIANTS[variant].pose:
        assert out.pose_logits is not None
        assert out.pose_logits.shape == (4, 60)
    else:
        assert out.pose_logits is None


def test_ablations_are_configurations_of_the_same_size_where_the_paper_says_so() -> None:
    def count(variant: str, **options: object) -> int:
        return sum(p.numel() for p in small(variant, **options).parameters())

    full = count("ground-truth")
    for variant in ("multi-task", "input-transformation", "predicted", "predicted-ensemble"):
        assert count(variant) == full
    assert count("predicted-regression") == full - 54 * 257  # 6 outputs in place of 60
    backbone = sum(p.numel() for p in small().backbone.parameters())
    assert count("cascaded") == full + backbone
    pose_head = sum(p.numel() for p in small().pose_head.parameters())
    assert count("without-pose") == full - pose_head


def test_the_class_branch_is_given_what_the_variant_says(monkeypatch: pytest.MonkeyPatch) -> None:
    data = batch()
    for variant, expected in (("ground-truth", "label"), ("predicted", "own")):
        for symmetry in (True, False):
            given = {"delta_deg": 0.0, "snap": False} if expected == "label" else {}
            model = small(variant, symmetry=symmetry, **given).train()
            seen: list[torch.Tensor] = []
            classify = model._classify
            monkeypatch.setattr(
                model, "_classify", lambda p, f, R, c=classify, s=seen: (s.append(R), c(p, f, R))[1]
            )
            model.training_loss(data)
            label = data.mapped_rotation if symmetry else data.rotation
            assert torch.allclose(seen[0], label, atol=1e-6) == (expected == "label")


def test_snapped_noise_is_a_bin_and_seeds_decide_it() -> None:
    model, data = small(), batch()
    torch.manual_seed(3)
    given = model._given(data.mapped_rotation)
    distance = (given[:, None] - pose.bins(given)).abs().amax((2, 3))
    assert distance.amin(1).max() < 1e-6
    torch.manual_seed(3)
    assert torch.equal(model._given(data.mapped_rotation), given)
    torch.manual_seed(3)
    again = model.training_loss(data)
    torch.manual_seed(3)
    fresh = small()
    torch.manual_seed(3)
    assert torch.equal(fresh.training_loss(data), again)


def test_noise_turns_each_euler_angle_of_the_camera_side_uniformly() -> None:
    torch.manual_seed(0)
    R = torch.tensor(Rotation.random(random_state=1).as_matrix()).expand(20_000, 3, 3)
    turn = pose.noise(R, 45.0) @ R.mT
    angles = Rotation.from_matrix(turn.numpy()).as_euler("xyz", degrees=True)
    assert np.abs(angles).max() < 45.0001
    for column in angles.T:
        quartiles = np.quantile(column, [0.25, 0.5, 0.75])
        assert quartiles == pytest.approx([-22.5, 0, 22.5], abs=2)
    assert torch.allclose(pose.noise(R, 0.0), R)


def test_targets_are_those_of_the_geometry_package() -> None:
    R = Rotation.random(200, random_state=2).as_matrix()
    nearest = nearest_bins(R, 4)
    assert np.array_equal(pose.nearest_bin(torch.tensor(R)).numpy(), nearest[:, 0])
    expected = np.zeros((len(R), 60))
    np.put_along_axis(expected, nearest, np.array([[0.4, 0.2, 0.2, 0.2]]), axis=1)
    assert np.allclose(pose.soft_target(torch.tensor(R)).numpy(), expected)


def test_a_regressed_pose_is_a_rotation_whose_bins_are_ranked_by_angle() -> None:
    model = small("predicted-regression").eval()
    with torch.no_grad():
        features = model.backbone(batch().points, model.grid)
        logits, R = model._pose(features)
    assert R is not None
    assert logits is not None
    assert torch.allclose(R @ R.mT, torch.eye(3).expand(4, 3, 3), atol=1e-5)
    angles = geodesic_angle(R[:, None].numpy(), pose.bins(R).numpy())
    assert np.array_equal(angles.argmin(1), logits.argmax(1).numpy())


def test_input_transformation_turns_the_cloud() -> None:
    model, data = small("input-transformation").eval(), batch()
    with torch.no_grad():
        given = model(data.points, rotation=data.rotation).class_logits
        canonical = data.points @ data.rotation
        already = model(canonical, rotation=torch.eye(3).expand(4, 3, 3)).class_logits
    assert torch.allclose(given, already, atol=1e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"variant": "multitask"}, "did you mean multi-task"),
        ({"k": 61}, "between 1 and 60, got 61"),
        ({"delta_deg": -1.0}, "got -1.0"),
        ({"grid": 20}, "multiple of 8, at least 16, got 20"),
        ({"grid": 8}, "at least 16, got 8"),
    ],
)
def test_wrong_options_are_refused(options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        PAPNet(5, **options)


@torch.no_grad()
def test_candidates_are_given_where_an_ensemble_decided() -> None:
    for variant in ("without-pose", "multi-task", "predicted"):
        assert small(variant).eval()(batch().points).candidates is None
    assert small().train()(batch().points).candidates is None
    found = small().eval()(batch().points)
    assert found.candidates is not None
    logits, classes = found.candidates
    assert logits.shape == classes.shape == (4, 3)
    best = logits.argmax(1, keepdim=True)
    assert torch.equal(found.class_logits.argmax(1), classes.gather(1, best)[:, 0])
    assert torch.equal(found.class_logits.amax(1), logits.amax(1))


def test_eight_clouds_are_overfitted() -> None:
    torch.manual_seed(0)
    model, label = PAPNet(8, k=1, grid=16), torch.arange(8)
    points = torch.randn(8, 100, 3) * torch.rand(8, 1, 3)
    R = torch.tensor(Rotation.random(8, random_state=0).as_matrix()).float()
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-3)
    for _ in range(20):
        optimizer.zero_grad()
        model.train().training_loss(Batch(points, label, R, R)).backward()
        optimizer.step()
    for module in model.modules():
        if hasattr(module, "momentum"):
            module.momentum = 1.0  # the running statistics become those of the next batch
    snapped = pose.bins(R)[pose.nearest_bin(R)]
    with torch.no_grad():
        model.train()(points, rotation=snapped)
        given = model.eval()(points, rotation=snapped)
    assert given.class_logits.argmax(1).tolist() == label.tolist()
    assert given.pose_logits is not None
    assert torch.equal(given.pose_logits.argmax(1), pose.nearest_bin(R))


def test_bfloat16_stays_near_full_precision() -> None:
    """Within 5 % of the logits' spread for a given pose; about 1 % is usual."""
    torch.manual_seed(0)
    model = PAPNet(5, grid=32)
    points = normalise(torch.randn(4, 300, 3) * torch.rand(4, 1, 3))
    R = torch.tensor(rotation_bins()[[3, 9, 20, 31]].copy()).float()
    with torch.no_grad():
        for _ in range(3):  # batch norm settles
            model.train()(points)
        full = model.eval()(points, rotation=R)
        with torch.autocast("cpu", torch.bfloat16):
            low = model(points, rotation=R)
    for a, b in ((full.class_logits, low.class_logits), (full.pose_logits, low.pose_logits)):
        assert a is not None
        assert b is not None
        assert 0 < (a - b.float()).abs().max() < 0.05 * a.std()
