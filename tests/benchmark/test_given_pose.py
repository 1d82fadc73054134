"""What a model is told of the pose at test, and which models can be told."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn
from typer.testing import CliRunner

from partialbench.benchmark import models
from partialbench.benchmark.prediction import Prediction
from partialbench.benchmark.records import results
from partialbench.benchmark.run import run_eval
from partialbench.benchmark.testing import evaluate, given_pose
from partialbench.cli import app
from partialbench.errors import InputError
from partialbench.geometry.rotations import geodesic_angle
from partialbench.geometry.symmetry import map_rotations
from tests.benchmark.memory_clouds import MemoryClouds
from tests.benchmark.tiny_models import MODELS, SMALL, STEERED

ROWS = np.arange(24)


class Reads(nn.Module):
    """Answers with the first entries of the pose it is told, with nothing otherwise."""

    def forward(self, clouds: torch.Tensor, rotation: torch.Tensor | None = None) -> Prediction:
        if rotation is None:
            return Prediction(torch.zeros(len(clouds), 3))
        return Prediction(rotation[:, 0])


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("0", "0"),
        (0, "0"),
        ("0.0", "0"),
        ("15", "15"),
        (7.5, "7.5"),
        ("random", "random"),
        ("class:0", "class:0"),
        ("class:15.0", "class:15"),
    ],
)
def test_names_of_poses(text, name):
    assert given_pose.parse(text) == name


@pytest.mark.parametrize("text", ["true", "-1", "181", "nan", "inf", "", "class:", "class:x"])
def test_what_is_no_pose_is_refused(text):
    with pytest.raises(InputError, match=rf"0 to 180 .*; got '{text}'"):
        given_pose.parse(text)


def test_the_true_pose_is_the_label_under_symmetry():
    clouds = MemoryClouds()
    told = given_pose.rotations("0", clouds, ROWS)
    assert told.dtype == np.float32
    expected = map_rotations(clouds.rotations[ROWS], clouds.symmetries[ROWS])
    np.testing.assert_allclose(told, expected, atol=1e-7)
    assert np.abs(told - clouds.rotations[ROWS]).max() > 0.1  # some class has a symmetry


def test_noise_is_of_the_papers_kind_and_size():
    clouds = MemoryClouds()
    true, told = (given_pose.rotations(name, clouds, ROWS) for name in ("0", "15"))
    noise = told @ true.swapaxes(1, 2)
    # Rz(c)·Ry(b)·Rx(a): the angles come back, and none exceeds 15°.
    angles = np.degrees(
        [
            np.arctan2(noise[:, 2, 1], noise[:, 2, 2]),
            np.arcsin(-noise[:, 2, 0]),
            np.arctan2(noise[:, 1, 0], noise[:, 0, 0]),
        ]
    )
    assert np.abs(angles).max() <= 15.001
    assert np.abs(angles).max(axis=1).min() > 8
    assert angles.min() < -5


def test_a_random_pose_has_nothing_of_the_true_one():
    clouds = MemoryClouds()
    true, told = (given_pose.rotations(name, clouds, ROWS) for name in ("0", "random"))
    assert np.degrees(np.median(geodesic_angle(true, told))) > 90
    np.testing.assert_allclose(told @ told.swapaxes(1, 2), np.broadcast_to(np.eye(3), told.shape),
                               atol=1e-6)  # fmt: skip


def test_each_cloud_is_told_its_own_pose_whatever_the_batches():
    clouds = MemoryClouds()
    given = given_pose.rotations("30", clouds, ROWS)
    told = given_pose.told("30", clouds, ROWS, clouds.class_names)
    np.testing.assert_array_equal(told.rotations[:, 0], given)
    whole, parts = (
        evaluate.predict_rows(
            Reads(), clouds, ROWS, clouds.class_names, batch_size=size, given=told
        )
        for size in (24, 7)
    )
    np.testing.assert_array_equal(whole.predicted, given[:, 0].argmax(1))
    np.testing.assert_array_equal(whole.predicted, parts.predicted)
    np.testing.assert_array_equal(given, given_pose.rotations("30", clouds, ROWS))


def test_under_each_class_s_own_symmetry_the_pose_is_mapped_as_if_it_were_of_that_class():
    clouds = MemoryClouds()  # bottles (z-inf), chairs (none), tables (z-180)
    told = given_pose.told("class:0", clouds, ROWS, (*clouds.class_names, "sofa", "cup"))
    assert told.rotations.shape == (24, 3, 3, 3)
    assert told.hypothesis.tolist() == [2, 0, 1, 0, 2]  # none, z-180, z-inf
    for group, expected in enumerate(("none", "z-180", "z-inf")):
        mapped = map_rotations(clouds.rotations[ROWS], np.full(24, expected))
        np.testing.assert_allclose(told.rotations[:, group], mapped, atol=1e-6)
    noisy = given_pose.told("class:15", clouds, ROWS, clouds.class_names).rotations[:, 1]
    turn = given_pose.rotations("15", clouds, ROWS) @ given_pose.rotations(
        "0", clouds, ROWS
    ).swapaxes(1, 2)
    np.testing.assert_allclose(noisy, turn @ told.rotations[:, 1], atol=1e-5)


def test_each_class_is_judged_under_its_own_pose_and_none_can_be_read_off_it():
    """A model that answers by the pose alone, as the true class's Map gives it away."""

    class KnowsBottles(nn.Module):
        """Says bottle where the pose has no turn about the object's own axis."""

        def forward(self, clouds, rotation=None):
            if rotation is None:
                return Prediction(torch.zeros(len(clouds), 3))
            turn = (rotation[:, 1, 0] - rotation[:, 0, 1]).abs()
            other = torch.full_like(turn, 1e-3)
            return Prediction(torch.stack([-turn, -other, -other], dim=1))

    clouds = MemoryClouds(objects=40)
    rows = np.arange(len(clouds))

    def bottles(name):
        told = given_pose.told(name, clouds, rows, clouds.class_names)
        found = evaluate.predict_rows(
            KnowsBottles(), clouds, rows, clouds.class_names, batch_size=50, given=told
        )
        return [(found.predicted[clouds.labels == label] == 0).mean() for label in range(3)]

    assert bottles("0")[0] == 1
    assert max(bottles("0")[1:]) < 0.1, "as labels are told, the pose alone tells bottles"
    assert bottles("class:0") == [1, 1, 1], "under each class's own, it says the same of all"


def test_a_model_that_turns_its_input_in_place_turns_it_once_under_each_pose():
    class Turns(nn.Module):
        """Answers by where a point is in the object's frame, which it turns the cloud into."""

        def __init__(self, in_place: bool) -> None:
            super().__init__()
            self.in_place = in_place

        def forward(self, clouds, rotation=None):
            turned = clouds @ rotation
            if self.in_place:
                turned = clouds.copy_(turned)
            return turned[:, 0]

    clouds = MemoryClouds()
    told = given_pose.told("class:0", clouds, ROWS, clouds.class_names)
    whole, in_place = (
        evaluate.predict_rows(Turns(kind), clouds, ROWS, clouds.class_names, given=told)
        for kind in (False, True)
    )
    np.testing.assert_array_equal(whole.log_probabilities, in_place.log_probabilities)


def test_a_class_whose_objects_differ_in_symmetry_has_none_to_be_told_under():
    clouds = MemoryClouds()
    clouds.symmetries = clouds.symmetries.copy()
    clouds.symmetries[-1] = "none"
    with pytest.raises(InputError, match=r"class 'table' of toy .*\(none, z-180\)"):
        given_pose.told("class:0", clouds, ROWS, clouds.class_names)
    given_pose.told("0", clouds, ROWS, clouds.class_names)


def test_a_record_for_each_pose_beside_the_models_own(data, tmp_path):
    done = run_eval(
        "papnet-steered", data, results_folder=tmp_path, options=STEERED,
        test_poses=["0", 15, "class:0", "random", "15"], test_points=[32], **SMALL,
    )  # fmt: skip
    assert [r.conditions for r in done] == [
        {}, {"pose": "0"}, {"pose": "15"}, {"pose": "class:0"}, {"pose": "random"},
        {"points": "32"},
    ]  # fmt: skip
    assert [r.given_pose for r in results.read_folder(tmp_path)].count("") == 2
    own, true, *_ = done
    assert true.column == (*own.column, "pose=0")
    assert "_pose-0_" in true.run_name
    assert true.rotation_audit == own.rotation_audit
    # The pose it would find itself is the same; the class under the given one is another.
    stored, told = (results.read_predictions(tmp_path, r) for r in (own, true))
    np.testing.assert_array_equal(stored.pose_bins[:, :1], told.pose_bins)
    assert told.classes.shape[1] == 1  # the answer and its confidence alone
    assert (stored.log_probabilities[:, :1] != told.log_probabilities).any()


def test_the_command_tells_trained_weights_a_pose(data, tmp_path):
    run_eval("papnet-steered", data, results_folder=tmp_path, options=STEERED, **SMALL)
    (weights,) = (tmp_path / "runs").glob("*/branch-*/checkpoint.pt")
    ran = CliRunner().invoke(
        app,
        ["eval", "--model", "papnet-steered", "--checkpoint", str(weights), "--data", str(data),
         "--device", "cpu", "--results", str(tmp_path / "told"), "--test-pose", "0"],
    )  # fmt: skip
    assert ran.exit_code == 0, ran.output
    assert "(partial, pose 0): accuracy" in ran.output
    assert {r.given_pose for r in results.read_folder(tmp_path / "told")} == {"", "0"}


def test_a_model_without_a_pose_is_refused_before_it_is_trained(data, tmp_path):
    with pytest.raises(InputError, match=r"Bare takes no pose.*argument 'rotation', \(B,3,3\)"):
        run_eval(f"{MODELS}:Bare", data, results_folder=tmp_path, test_poses=["0"], **SMALL)
    for variant in ("without-pose", "multi-task"):
        with pytest.raises(InputError, match="classifies without a pose, so none can be given"):
            run_eval(
                "papnet", data, results_folder=tmp_path, test_poses=["random"],
                options={"grid": 16, "variant": variant}, **SMALL,
            )  # fmt: skip
    assert not list(tmp_path.rglob("*"))
    with pytest.raises(InputError, match="got 'yes'"):
        run_eval(f"{MODELS}:Bare", data, results_folder=tmp_path, test_poses=["yes"], **SMALL)


def test_every_model_that_takes_a_pose_is_known_by_its_forward():
    for name, takes in (("papnet", True), ("papnet-steered", True), ("pointnet", False)):
        model = models.create(name, 3, {"grid": 16} if name == "papnet" else {})
        if takes:
            given_pose.require_taken(model, name)
        else:
            with pytest.raises(InputError, match="pointnet takes no pose"):
                given_pose.require_taken(model, name)
