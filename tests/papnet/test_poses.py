"""Poses that are told and labels: what is refused, and in which precision they are computed."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from baselines.points import normalise
from baselines.voxels import occupancy
from papnet import pose
from papnet.model import PAPNet, turned_back
from papnet.rotate_field import resample
from papnet.steered import model as steered
from papnet.steered.model import PAPNetSteered
from papnet.steered.refine import climb
from partialbench.benchmark.prediction import Batch
from partialbench.errors import InputError
from partialbench.geometry.rotations import haar_rotations

IDENTITY = torch.eye(3).expand(2, 3, 3)
VARIANTS = ("ground-truth", "predicted", "cascaded", "input-transformation", "multi-task")


def turns(count: int, seed: int = 0) -> Tensor:
    return torch.from_numpy(haar_rotations(np.random.default_rng(seed), count)).float()


def views(count: int = 2) -> Tensor:
    return torch.randn(count, 64, 3) * torch.tensor([0.5, 0.3, 0.2]) + torch.tensor([0, 0, 3.0])


@pytest.mark.parametrize(
    "make",
    [lambda: PAPNet(4, grid=16), lambda: PAPNet(4, grid=16, variant="input-transformation"),
     lambda: PAPNetSteered(4)],
)  # fmt: skip
def test_what_is_told_must_be_a_rotation_for_each_cloud(make) -> None:
    model, clouds = make().eval(), views()
    with torch.no_grad():
        single, double = (model(clouds, R).class_logits for R in (IDENTITY, IDENTITY.double()))
    assert torch.equal(single, double)
    for wrong in (IDENTITY[0], IDENTITY[:1], IDENTITY.long()):
        with pytest.raises(InputError, match="expected one rotation per cloud, floating"):
            model(clouds, wrong)
    mirror = torch.diag(torch.tensor([1.0, 1, -1])).expand(2, 3, 3)
    for wrong in (0 * IDENTITY, 2 * IDENTITY, mirror, torch.nan * IDENTITY):
        with pytest.raises(InputError, match="pose told with cloud 0 of the batch is no rotation"):
            model(clouds, wrong)


@pytest.mark.parametrize("variant", VARIANTS)
def test_unknown_poses_make_no_loss_in_silence(variant: str) -> None:
    model = PAPNet(4, variant=variant, grid=16).train()
    known = Batch(views(), torch.arange(2), IDENTITY, IDENTITY)
    assert model.training_loss(known).isfinite()
    unknown = known._replace(rotation=torch.nan * IDENTITY, mapped_rotation=torch.nan * IDENTITY)
    assert model.training_loss(unknown).isnan()


def test_a_batch_of_one_cloud_is_refused_in_training() -> None:
    """Scalars less their mean over one cloud are zero: its descriptor would say nothing."""
    with pytest.raises(ValueError, match="more than one value a channel in training, got 1"):
        PAPNetSteered(4).train()(views(1))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"pose_weight": -1.0}, "pose_weight must not be negative"),
        ({"variant": "without-pose", "pose_weight": 2.0}, "pose_weight=2.0 changes nothing"),
        ({"variant": "without-pose", "symmetry": False}, "symmetry=False changes nothing"),
        ({"variant": "without-pose", "vector_pose": False}, "vector_pose=False changes nothing"),
        ({"variant": "multi-task", "k": 3}, "it is an option of input-transformation, predicted-e"),
        ({"variant": "predicted", "delta_deg": 10.0}, "delta_deg=10.0 changes nothing"),
        ({"variant": "cascaded", "snap": False}, "snap=False changes nothing"),
    ],
)
def test_options_that_change_nothing_of_a_variant_are_refused(options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        PAPNet(4, **options)


def test_options_of_the_steered_model_that_change_nothing_are_refused() -> None:
    with pytest.raises(InputError, match=r"concentration=5\.0 is of the pose's loss"):
        PAPNetSteered(4, pose_weight=0.0, concentration=5.0)
    with pytest.raises(InputError, match="votes=65 need clouds of at least 65 points"):
        PAPNetSteered(4, votes=65).eval()(views())


class TestHalfPrecision:
    """Under autocast, rotations are multiplied as without: eight bits are four degrees."""

    def test_labels(self) -> None:
        R = turns(2000)
        with torch.autocast("cpu", torch.bfloat16):
            target, nearest = pose.soft_target(R), pose.nearest_bin(R)
            torch.manual_seed(1)
            noisy = pose.noise(R, 45.0)
        assert torch.equal(target, pose.soft_target(R))
        assert torch.equal(nearest, pose.nearest_bin(R))
        torch.manual_seed(1)
        assert torch.equal(noisy, pose.noise(R, 45.0))

    def test_clouds_and_fields(self) -> None:
        clouds, R = normalise(views(8)), turns(8)
        field = torch.randn(8, 2, 8, 8, 8)
        with torch.autocast("cpu", torch.bfloat16):
            turned, sampled = turned_back(clouds, R), resample(field, R)
        assert torch.equal(turned, turned_back(clouds, R))
        assert torch.equal(occupancy(turned, 64), occupancy(clouds @ R, 64))
        assert torch.equal(sampled, resample(field, R))

    def test_the_steered_models_target(self, monkeypatch: pytest.MonkeyPatch) -> None:
        model, R = PAPNetSteered(4), turns(50)
        batch = Batch(views(50), torch.arange(50) % 4, R, R)
        joint = torch.zeros(50, 360, 4, requires_grad=True)
        monkeypatch.setattr(model, "joint", lambda points: joint)
        gradients = []
        for half in (False, True):
            with torch.autocast("cpu", torch.bfloat16, enabled=half):
                gradients += torch.autograd.grad(model.training_loss(batch), joint)
        assert torch.equal(*gradients)

    def test_refined_poses_stay_rotations(self, monkeypatch: pytest.MonkeyPatch) -> None:
        found = []

        def climbing(*given):
            found.append(climb(*given))
            return found[-1]

        monkeypatch.setattr(steered, "climb", climbing)
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
            PAPNetSteered(4, refine=3).eval()(views(4))
        ((rotation, _),) = found
        torch.testing.assert_close(
            rotation @ rotation.mT, torch.eye(3).expand_as(rotation), atol=1e-5, rtol=0
        )
