"""papnet-steered: exact equivariance, one joint distribution, and a loss that is what it says."""

from __future__ import annotations

import copy
import functools

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from baselines.steerable.fields import wigner_matrix
from papnet.pose import soft_target
from papnet.steered.descriptor import Describe, Descriptor
from papnet.steered.head import JointHead, wigner_entries
from papnet.steered.model import PAPNetSteered, PAPNetSteeredNoPose
from papnet.steered.poses import pose_grid, share_of_bins
from partialbench.benchmark.prediction import Batch
from partialbench.errors import InputError
from partialbench.geometry.bins import NUM_BINS, rotation_bins
from partialbench.geometry.rotations import haar_rotations

CLASSES = 7


def clouds(number: int = 160) -> Tensor:
    """(4,number,3) float64: a box's corner, an ellipsoid's half, a lattice, and one with copies."""
    rng = np.random.default_rng(3)
    direction = rng.normal(size=(number, 3))
    box = np.abs(direction) / np.abs(direction).max(axis=1, keepdims=True) * (1, 0.6, 0.3)
    half = direction / np.linalg.norm(direction, axis=1, keepdims=True) * (1, 0.7, 0.4)
    half[:, 0] = np.abs(half[:, 0])
    # Every distance of a lattice is shared by many pairs of points: whoever breaks ties by the
    # last bit answers differently after a turn.
    edge = int(np.ceil(np.sqrt(number)))
    x, y = np.meshgrid(np.arange(edge), np.arange(edge))
    lattice = np.stack([x, y, x // 4], axis=-1).reshape(-1, 3)[:number] / edge
    copies = half[rng.integers(0, number // 2, number)] + (0, 0, 3)
    return torch.from_numpy(np.stack([box, half, lattice, copies]))


def turns(count: int, seed: int = 0) -> Tensor:
    return torch.from_numpy(haar_rotations(np.random.default_rng(seed), count))


def settle(model: nn.Module, points: Tensor | None = None) -> nn.Module:
    """In double precision, norms that have seen data, no parameter at a special value."""
    points = clouds() if points is None else points
    model.double()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
        for _ in range(30):
            model.train()(points)
    return model.eval()


@functools.cache
def posed() -> PAPNetSteered:
    torch.manual_seed(0)
    model = settle(PAPNetSteered(CLASSES))
    assert isinstance(model, PAPNetSteered)
    return model


@functools.cache
def poseless() -> PAPNetSteeredNoPose:
    torch.manual_seed(0)
    model = settle(PAPNetSteeredNoPose(CLASSES))
    assert isinstance(model, PAPNetSteeredNoPose)
    return model


def turned(x: Descriptor, R: Tensor) -> dict[int, Tensor]:
    return {
        degree: torch.einsum("bmn,bcn->bcm", wigner_matrix(degree, R), part)
        for degree, part in x.steerable.items()
    }


def deviation(a: dict[int, Tensor], b: dict[int, Tensor]) -> float:
    return max(float((a[degree] - b[degree]).abs().max() / b[degree].abs().max()) for degree in b)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 1e-5)])
def test_the_descriptor_turns_with_the_cloud(dtype: torch.dtype, tolerance: float) -> None:
    model = copy.deepcopy(posed()).to(dtype)
    R = turns(4)
    with torch.no_grad():
        before = model.descriptor(clouds().to(dtype))
        after = model.descriptor((clouds() @ R.mT).to(dtype))
    expected = turned(before, R.to(dtype))
    assert all(part.abs().max() > 0.1 for part in before.steerable.values()), "an empty descriptor"
    assert deviation(after.steerable, expected) < tolerance
    torch.testing.assert_close(after.invariant, before.invariant, atol=tolerance, rtol=tolerance)
    assert deviation(after.steerable, turned(before, R.mT.to(dtype))) > 0.1, "the check can fail"


def test_position_scale_and_order_do_not_matter() -> None:
    order = torch.randperm(clouds().shape[1], generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        before = posed().joint(clouds())
        after = posed().joint(3 * clouds()[:, order] + torch.tensor([1.0, -2, 4]))
    torch.testing.assert_close(after, before, atol=1e-9, rtol=0)


def test_turning_by_a_bin_permutes_the_joint_scores() -> None:
    # The poses are kept in float32, hence the tolerance.
    bins = torch.from_numpy(rotation_bins().copy())
    grid = torch.from_numpy(pose_grid(360).copy())
    with torch.no_grad():
        before = posed().joint(clouds())
        for turn in bins[[1, 17, 42]]:
            # What was seen under R is now seen under turn·R.
            moved = torch.cdist((turn @ grid).flatten(1), grid.flatten(1)).argmin(1)
            after = posed().joint(clouds() @ turn.T)
            torch.testing.assert_close(after[:, moved], before, atol=1e-7, rtol=0)
            torch.testing.assert_close(after.logsumexp(1), before.logsumexp(1), atol=1e-7, rtol=0)
    assert (before[:, moved] - before).abs().max() > 0.1, "the scores depend on the pose"


def test_the_head_reads_the_descriptor_in_the_objects_frame() -> None:
    """Fourier coefficients against a turned descriptor, pose by pose."""
    torch.manual_seed(1)
    head = JointHead(5, 6, 2, 8, CLASSES, 60).double().eval()
    x = Descriptor(
        {degree: torch.randn(2, 5, 2 * degree + 1, dtype=torch.float64) for degree in range(3)},
        torch.randn(2, 6, dtype=torch.float64),
    )
    R = turns(6).view(2, 3, 3, 3)
    for pose in range(3):
        canonical = turned(x, R[:, pose].mT)
        norms = [x.steerable[degree].square().mean(2).add(1e-6).sqrt() for degree in (1, 2)]
        untouched = torch.cat([x.steerable[0][..., 0], *norms, x.invariant], dim=1)
        h = head.invariant(untouched) + sum(
            torch.einsum("bcm,cmh->bh", canonical[degree], weight.unflatten(1, (-1, 8)))
            for degree, weight in enumerate(head.weights)
        )
        expected = head.score(torch.relu(head.norm(h)))
        _, view = head.look(x)
        found = head.scores(view, wigner_entries(R, 2))[:, pose]
        torch.testing.assert_close(found, expected, atol=1e-10, rtol=0)


def test_class_and_pose_are_the_marginals_of_one_distribution() -> None:
    with torch.no_grad():
        joint, prediction = posed().joint(clouds()), posed()(clouds())
    assert joint.shape == (4, 360, CLASSES)
    p = joint.exp()
    assert prediction.pose_logits is not None
    torch.testing.assert_close(p.sum((1, 2)), torch.ones(4, dtype=torch.float64))
    torch.testing.assert_close(prediction.class_logits.exp(), p.sum(1))
    of_bins = p.sum(2) @ torch.from_numpy(share_of_bins(360).copy())
    torch.testing.assert_close(prediction.pose_logits.exp(), of_bins, atol=1e-7, rtol=0)


def test_the_bins_alone_can_be_the_poses() -> None:
    torch.manual_seed(0)
    model = PAPNetSteered(CLASSES, poses=60).double().eval()
    with torch.no_grad():
        joint, prediction = model.joint(clouds()), model(clouds())
    assert joint.shape == (4, NUM_BINS, CLASSES)
    assert prediction.pose_logits is not None
    torch.testing.assert_close(prediction.pose_logits, joint.logsumexp(2), atol=1e-9, rtol=0)


def test_the_grid_of_poses_covers_the_rotations_evenly() -> None:
    grid, bins = pose_grid(360), rotation_bins()
    assert np.array_equal(grid[:60], bins)
    assert np.allclose(grid @ grid.swapaxes(1, 2), np.eye(3))
    assert np.allclose(np.linalg.det(grid), 1)

    def farthest_deg(poses: np.ndarray) -> float:
        R = Rotation.random(20_000, random_state=0).as_matrix()
        best = np.einsum("nij,pij->np", R, poses).max(1)
        return float(np.degrees(np.arccos((best.min() - 1) / 2)))

    assert 26 < farthest_deg(grid) < 28
    assert 42 < farthest_deg(bins) < 45
    share = share_of_bins(360)
    assert np.allclose(share.sum(1), 1)
    assert np.allclose(share.sum(0), 6), "every bin has as many poses"
    assert (np.einsum("pij,bij->pb", grid, bins)[share > 0] >= 1 + 2 * np.cos(np.pi / 4)).all()


def test_a_given_pose_conditions_the_class() -> None:
    R = turns(4, seed=1)
    with torch.no_grad():
        bin_answer = posed()(clouds(), rotation=torch.from_numpy(rotation_bins()[[5, 9, 33, 0]]))
        expected = posed().joint(clouds())[torch.arange(4), [5, 9, 33, 0]].log_softmax(-1)
        answer = bin_answer.class_logits.log_softmax(-1)
        torch.testing.assert_close(answer, expected, atol=1e-6, rtol=0)
        # The answer under the true pose is the object's, however it is turned.
        turn = turns(4, seed=2)
        before = posed()(clouds(), rotation=R).class_logits
        after = posed()(clouds() @ turn.mT, rotation=turn @ R).class_logits
        torch.testing.assert_close(after, before, atol=1e-9, rtol=0)
        other = posed()(clouds() @ turn.mT, rotation=R).class_logits
    assert (other - before).abs().max() > 0.1, "the given pose is used"
    with pytest.raises(InputError, match=r"floating and of shape \(4, 3, 3\), got \(1, 3"):
        posed()(clouds(), rotation=R[:1])


def test_the_loss_is_both_cross_entropies() -> None:
    model = copy.deepcopy(posed()).train()
    label, R, mapped = torch.tensor([1, 0, 6, 3]), turns(4, seed=3), turns(4, seed=4)
    loss = model.training_loss(Batch(clouds(), label, R, mapped))
    joint = copy.deepcopy(posed()).train().joint(clouds()).detach().numpy()
    angle = Rotation.from_matrix(
        mapped.numpy()[:, None].swapaxes(2, 3) @ pose_grid(360)
    ).magnitude()
    target = np.exp(2 * 3 * np.cos(angle))
    target /= target.sum(axis=1, keepdims=True)
    of_label = joint[np.arange(4), :, label.numpy()]
    class_loss = -np.log(np.exp(of_label).sum(axis=1)).mean()
    pose_loss = -(target * of_label).sum(axis=1).mean()
    # The poses are kept in float32.
    assert loss.item() == pytest.approx(class_loss + 0.3 * pose_loss, abs=1e-7)
    model.pose_weight = 0.0
    assert model.training_loss(Batch(clouds(), label, R, mapped)).item() == pytest.approx(
        class_loss, abs=1e-9
    )


def test_pose_and_class_are_learned_together() -> None:
    torch.manual_seed(0)
    model = PAPNetSteered(4, lmax=2, channels=16, width=32)
    # The same four objects under two poses each: the class alone does not tell the pose.
    R = turns(8, seed=6).float()
    points, label = clouds().float().repeat(2, 1, 1) @ R.mT, torch.arange(4).repeat(2)
    optimizer = torch.optim.Adam(model.parameters(), lr=3e-3)
    for _ in range(80):
        optimizer.zero_grad()
        model.train().training_loss(Batch(points, label, R, R)).backward()
        optimizer.step()
    with torch.no_grad():
        prediction = model.eval()(points)
    assert prediction.pose_logits is not None
    assert (prediction.class_logits.argmax(1) == label).all()
    likely = soft_target(R).gather(1, prediction.pose_logits.topk(4).indices)
    assert (likely > 0).float().mean() > 0.7


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 1e-4)])
def test_the_twin_does_not_see_the_pose(dtype: torch.dtype, tolerance: float) -> None:
    model = copy.deepcopy(poseless()).to(dtype)
    with torch.no_grad():
        before = model(clouds().to(dtype)).class_logits
        scale = before.abs().max()
        assert (before - before.mean(0)).abs().max() > 0.1 * scale, "it tells clouds apart"
        for seed in range(5):
            after = model((clouds() @ turns(4, seed).mT).to(dtype)).class_logits
            assert (after - before).abs().max() < tolerance * scale


def test_only_the_posed_one_tells_a_shape_from_its_mirror_image() -> None:
    t = torch.linspace(0, 1, 160, dtype=torch.float64)
    helix = torch.stack([(9 * t).cos(), (9 * t).sin(), 2 * t], dim=-1) * (1 + t[:, None])
    mirrored = helix * torch.tensor([1.0, -1.0, 1.0])
    with torch.no_grad():
        for model, differs in ((posed(), True), (poseless(), False)):
            one, other = model(torch.stack([helix, mirrored])).class_logits
            change = (one - other).abs().max() / one.abs().max()
            assert change > 1e-4 if differs else change < 1e-9


def test_the_twin_has_the_same_encoder_and_about_as_many_parameters() -> None:
    def shapes(model: nn.Module) -> dict[str, torch.Size]:
        (describe,) = [m for m in model.modules() if isinstance(m, Describe)]
        return {name: value.shape for name, value in describe.state_dict().items()}

    # In a small one the twin's wider last layer shows: it reads 384 features, the other 312.
    for options, apart in (({}, 0.01), ({"lmax": 1, "channels": 32}, 0.02)):
        one, other = PAPNetSteered(40, **options), PAPNetSteeredNoPose(40, **options)
        assert shapes(one) == shapes(other)
        counts = [sum(p.numel() for p in m.parameters()) for m in (one, other)]
        assert counts[1] == pytest.approx(counts[0], rel=apart)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"lmax": 4}, "lmax must be 1, 2 or 3, got 4"),
        ({"k": 3}, "k must be at least 8, got 3"),
        ({"pose_weight": -1.0}, "pose_weight must not be negative, got -1"),
        ({"concentration": 0.0}, "concentration must be positive, got 0"),
        ({"poses": 100}, r"poses must be one of \(60, 360\), got 100"),
    ],
)
def test_bad_options_are_refused(options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        PAPNetSteered(CLASSES, **options)


def test_clouds_with_too_few_points_are_refused() -> None:
    with pytest.raises(InputError, match="16 neighbours need clouds of at least 17 points, got 16"):
        PAPNetSteeredNoPose(CLASSES)(clouds(16).float())
