"""papnet-steered's options: each is what it says, and none costs the equivariance."""

from __future__ import annotations

import copy
import functools

import pytest
import torch
from torch import Tensor

from papnet.steered.geometry import geometry
from papnet.steered.head import wigner_entries
from papnet.steered.model import PAPNetSteered, PAPNetSteeredNoPose, windows
from papnet.steered.refine import REFINED, climb, generators, gradient
from partialbench.errors import InputError
from partialbench.geometry.bins import rotation_bins
from tests.papnet.test_steered import CLASSES, clouds, deviation, settle, turned, turns

SMALL = {"channels": 16, "width": 32}
EVERYTHING = {"ray": True, "scales": 2, "rounds": 2, "refine": 3, "votes": 4}


def seen() -> Tensor:
    """The clouds before a camera, as they are stored."""
    return clouds() + torch.tensor([0.3, -0.2, 3.0])


@functools.cache
def model_with(posed: bool = True, **options: object) -> PAPNetSteered | PAPNetSteeredNoPose:
    """Settled on clouds that have a camera, in double precision."""
    torch.manual_seed(0)
    kind = PAPNetSteered if posed else PAPNetSteeredNoPose
    model = kind(CLASSES, **SMALL, **options)  # type: ignore[arg-type]
    settle(model, seen())
    return model


@pytest.mark.parametrize("options", [{"ray": True}, {"scales": 2}, {"ray": True, "scales": 2}])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 1e-5)])
def test_the_descriptor_turns_with_cloud_and_camera(options, dtype, tolerance) -> None:
    model = copy.deepcopy(model_with(**options)).to(dtype)
    R = turns(4)
    with torch.no_grad():
        before = model.describe(seen().to(dtype))
        after = model.describe((seen() @ R.mT).to(dtype))
    assert deviation(after.steerable, turned(before, R.to(dtype))) < tolerance
    torch.testing.assert_close(after.invariant, before.invariant, atol=tolerance, rtol=tolerance)


def test_the_ray_is_seen_by_the_model_and_its_twin() -> None:
    centre = seen().mean(1, keepdim=True)
    turn = turns(1, seed=5)[0]
    # About its own centre: the same cloud from another side.
    elsewhere = (seen() - centre) @ turn.T + centre
    with torch.no_grad():
        for posed in (True, False):
            model = model_with(posed, ray=True)
            assert isinstance(model, PAPNetSteered | PAPNetSteeredNoPose)
            moved = model(elsewhere).class_logits - model(seen()).class_logits
            assert moved.abs().max() > 1e-3
            about_the_camera = model(seen() @ turn.T).class_logits - model(seen()).class_logits
            assert posed or about_the_camera.abs().max() < 1e-9
            with pytest.raises(InputError, match="a cloud is centred on the origin"):
                model(seen() - centre)


def test_a_second_scale_reaches_further() -> None:
    """A point far outside every narrow and first wide neighbourhood of another changes it."""
    near = torch.zeros(1, 64, 3, dtype=torch.float64)
    near[0, :, 0] = torch.linspace(0, 1, 64, dtype=torch.float64)
    moved = near.clone()
    moved[0, 24, 1] = 0.2  # the 24th neighbour of the first point: beyond 16, within 32
    one, other = (geometry(cloud, 8, 2, scales=2).fields[0, 0] for cloud in (near, moved))
    shells = one.shape[0] // 3
    assert torch.equal(one[shells : 2 * shells], other[shells : 2 * shells])
    assert not torch.allclose(one[2 * shells :], other[2 * shells :], atol=1e-3)


def test_the_second_round_is_what_its_formula_says() -> None:
    model = model_with(rounds=2)
    head = model.head
    with torch.no_grad():
        x = model.describe(seen())
        scores, view = head.look(x)
        h = head.layer(view, head.entries)
        first = torch.relu(head.norm(h.flatten(0, 1)).view_as(h))
        alone = head.score(first)
        joint = alone.flatten(1).softmax(1).view_as(alone)
        seen_poses = torch.einsum("bpk,bph->bh", joint, first)
        context = torch.cat([seen_poses, joint.sum(1)], 1) @ head.second.attend.weight.T
        again = h + context[:, None]
        again = head.second.score(torch.relu(head.second.norm(again.flatten(0, 1)).view_as(h)))
        torch.testing.assert_close(scores, alone + again)
        under = head.scores(view, wigner_entries(turns(4)[:, None], head.lmax))
        assert under.shape == (4, 1, CLASSES)
    assert (again - again.mean((1, 2), keepdim=True)).abs().max() > 1e-3


def test_turning_by_a_bin_permutes_the_scores_of_two_rounds() -> None:
    model = model_with(rounds=2)
    bins = torch.from_numpy(rotation_bins().copy())
    grid = model.poses.view(-1, 3, 3).double()
    with torch.no_grad():
        before = model.joint(seen())
        moved = torch.cdist((bins[17] @ grid).flatten(1), grid.flatten(1)).argmin(1)
        after = model.joint(seen() @ bins[17].T)
    torch.testing.assert_close(after[:, moved], before, atol=1e-6, rtol=0)


@pytest.mark.parametrize("rounds", [1, 2])
def test_slopes_over_poses_are_those_of_differences(rounds: int) -> None:
    head, R = model_with(rounds=rounds).head, turns(8, seed=2).view(4, 2, 3, 3)
    with torch.no_grad():
        _, view = head.look(model_with(rounds=rounds).describe(seen()))
        found = gradient(head, view, R)

        def value(step: float, axis: int) -> Tensor:
            turn = torch.linalg.matrix_exp(step * _cross(axis))
            return head.scores(view, wigner_entries(turn @ R, head.lmax)).logsumexp(-1)

        for axis in range(3):
            expected = (value(1e-5, axis) - value(-1e-5, axis)) / 2e-5
            torch.testing.assert_close(found[..., axis], expected, atol=1e-5, rtol=1e-4)
    assert found.abs().max() > 0.01


def _cross(axis: int) -> Tensor:
    matrix = torch.zeros(3, 3, dtype=torch.float64)
    a, b = (axis + 1) % 3, (axis + 2) % 3
    matrix[b, a], matrix[a, b] = 1.0, -1.0
    return matrix


def test_generators_are_antisymmetric_and_those_of_vectors_are_cross_products() -> None:
    for degree in range(4):
        J = generators(degree)
        torch.testing.assert_close(J, -J.mT, atol=1e-7, rtol=0)
    expected = torch.stack([_cross(axis) for axis in range(3)])
    torch.testing.assert_close(generators(1), expected, atol=1e-7, rtol=0)


def test_refined_poses_climb_and_turn_with_the_cloud() -> None:
    model = model_with()
    begin = turns(8, seed=1).view(4, 2, 3, 3)
    turn = turns(1, seed=9)[0]
    with torch.no_grad():
        _, view = model.head.look(model.describe(seen()))
        start = model.head.scores(view, wigner_entries(begin, 3)).logsumexp(-1)
        R, scores = climb(model.head, view, begin, 12)
        assert (scores.logsumexp(-1) > start).all()
        torch.testing.assert_close(model.head.scores(view, wigner_entries(R, 3)), scores)
        assert torch.linalg.vector_norm(gradient(model.head, view, R), dim=-1).median() < (
            0.3 * torch.linalg.vector_norm(gradient(model.head, view, begin), dim=-1).median()
        )
        _, view = model.head.look(model.describe(seen() @ turn.T))
        after, _ = climb(model.head, view, turn @ begin, 3)
        before, _ = climb(model.head, view, turn @ begin, 0)
        assert torch.equal(before, turn @ begin)
        _, view = model.head.look(model.describe(seen()))
        torch.testing.assert_close(after, turn @ climb(model.head, view, begin, 3)[0])


def test_refined_poses_take_the_place_of_the_likeliest() -> None:
    model = copy.deepcopy(model_with())
    with torch.no_grad():
        plain, joint = model(seen()), model.joint(seen())
        model.refine = 6
        refined = model(seen())
        # By hand, on unnormalised scores.
        scores, view = model.head.look(model.describe(seen()))
        for cloud in range(4):
            best = scores[cloud].logsumexp(1).topk(REFINED).indices
            begin = model.poses[best].view(-1, 3, 3).double().expand(4, -1, -1, -1)
            _, climbed = climb(model.head, view, begin, 6)
            scores[cloud, best] = climbed[cloud]
        expected = scores.flatten(1).log_softmax(1).view_as(scores).logsumexp(1)
    torch.testing.assert_close(refined.class_logits, expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(
        refined.pose_logits.exp().sum(1), torch.ones(4, dtype=torch.float64), atol=1e-6, rtol=0
    )
    assert (refined.class_logits - plain.class_logits).abs().max() > 1e-4
    torch.testing.assert_close(plain.class_logits, joint.logsumexp(1))


@pytest.mark.parametrize("posed", [True, False])
def test_votes_average_the_probabilities_of_windows(posed: bool) -> None:
    model = copy.deepcopy(model_with(posed))
    parts = windows(seen(), 4)
    assert [part.shape for part in parts] == [(4, 120, 3)] * 4
    # Every point is left out of one window.
    counts = sum((seen()[0][:, None] == part[0]).all(-1).sum(1) for part in parts)
    assert (counts[:40] == 3).all()
    with torch.no_grad():
        expected = torch.stack([model(part).class_logits.softmax(1) for part in parts]).mean(0)
        model.votes = 4
        found = model(seen()).class_logits
        torch.testing.assert_close(found.exp(), expected)
        assert model.train()(seen()).class_logits.shape == (4, CLASSES)


def test_with_everything_on_it_answers_and_can_be_told_a_pose() -> None:
    model = model_with(**EVERYTHING)
    with torch.inference_mode():
        found, told = model(seen()), model(seen(), rotation=turns(4))
    for logs in (found.class_logits, found.pose_logits):
        torch.testing.assert_close(logs.exp().sum(1), torch.ones(4, dtype=torch.float64),
                                   atol=1e-6, rtol=0)  # fmt: skip
    assert told.class_logits.shape == (4, CLASSES)
    torch.testing.assert_close(told.pose_logits, found.pose_logits)


def test_everything_stays_under_two_million_parameters() -> None:
    for model in (PAPNetSteered(40, **EVERYTHING), PAPNetSteeredNoPose(40, ray=True, scales=2)):
        assert sum(p.numel() for p in model.parameters()) < 2_000_000


def test_options_that_act_at_test_alone_leave_training_as_it_is() -> None:
    one, other = copy.deepcopy(model_with()).train(), copy.deepcopy(model_with()).train()
    other.refine, other.votes = 3, 4
    with torch.no_grad():
        torch.testing.assert_close(one(seen()).class_logits, other(seen()).class_logits)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scales": 3}, "scales must be 1 or 2, got 3"),
        ({"rounds": 0}, "rounds must be 1 or 2, got 0"),
        ({"refine": -1}, "refine must not be negative, got -1"),
        ({"votes": 0}, "votes must be at least 1, got 0"),
    ],
)
def test_bad_options_are_refused(options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        PAPNetSteered(CLASSES, **options)


def test_answers_under_several_poses_compare() -> None:
    """Told poses of the grid, the scores are the joint's but for one constant a cloud."""
    model = model_with()
    with torch.no_grad():
        joint, apart = model.joint(seen()), []
        for pose in (0, 61, 200):
            R = model.poses[pose].view(1, 3, 3).expand(4, -1, -1)
            apart.append(model(seen(), rotation=R).class_logits - joint[:, pose])
    apart = torch.stack(apart, dim=1).flatten(1)
    torch.testing.assert_close(apart, apart[:, :1].expand_as(apart), atol=1e-6, rtol=0)
    assert (joint[:, 0] - joint[:, 61]).abs().max() > 1e-3
