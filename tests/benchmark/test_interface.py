"""The Python interface to a trained model: clouds in memory, weights to begin from, the board."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from partialbench.benchmark.board import leaderboard
from partialbench.benchmark.evaluation import evaluate, name_of
from partialbench.benchmark.predict import Classifier
from partialbench.benchmark.predict import load_model as load
from partialbench.benchmark.pretrained import create_model
from partialbench.errors import InputError
from tests.benchmark.memory_clouds import MemoryClouds
from tests.benchmark.tiny_models import MODELS


def load_model(weights: Path, device: str) -> Classifier:
    return load(weights, device, f"{MODELS}:Posed")


@pytest.fixture(scope="module")
def weights(done) -> Path:
    return next((done[1] / "runs").glob("*seed0/branch-*/checkpoint.pt"))


def test_a_cloud_in_memory_is_answered_as_its_file(weights, tmp_path, rng):
    clouds = MemoryClouds().points([3, 4, 5])
    np.save(tmp_path / "a.npy", clouds[0])
    classifier = load_model(weights, "cpu")
    from_file = classifier(tmp_path / "a.npy")
    kinds = (clouds[0], clouds[0].astype(np.float64), torch.from_numpy(clouds[0]).double(),
             clouds[0].tolist(), torch.from_numpy(clouds[0]).requires_grad_())  # fmt: skip
    for given in kinds:
        answer = classifier.predict(given)
        assert np.array_equal(answer.probabilities, from_file.probabilities)
        assert np.array_equal(answer.rotation, from_file.poses[0][0])
    assert answer.probabilities.sum() == pytest.approx(1, abs=1e-6)
    assert answer.pose_probabilities.shape == (60,)
    assert answer.class_name == answer.class_names[answer.probabilities.argmax()]
    batch = classifier.predict(clouds)
    listed = classifier.predict([*clouds, rng.standard_normal((300, 3)).astype(np.float16)])
    assert len(batch) == 3
    assert len(listed) == 4
    assert listed[3].points_used == 4 * 64
    for one, other in zip(batch, listed, strict=False):
        assert np.allclose(one.probabilities, other.probabilities, atol=1e-6)
    assert np.allclose(batch[0].probabilities, from_file.probabilities, atol=1e-6)
    assert classifier.predict([]) == []


def test_each_of_several_clouds_is_answered_as_if_alone(weights, rng):
    clouds = [rng.standard_normal((n, 3)) for n in (64, 200, 64, 300, 64)]
    classifier = load_model(weights, "cpu")
    for one, answer in zip(clouds, classifier.predict(clouds), strict=True):
        assert answer.points_given == len(one)
        assert np.array_equal(answer.probabilities, classifier.predict(one).probabilities)


def test_a_cloud_far_from_the_origin_is_moved_before_it_is_rounded(weights):
    """In 32 bits the points of a map's coordinates would fall onto a grid of half a metre."""
    seen = []
    classifier = load_model(weights, "cpu")
    cloud = MemoryClouds().points([3])[0].astype(np.float64)
    forward = classifier.model.forward
    classifier.model.forward = lambda points: (seen.append(points.clone()), forward(points))[1]
    classifier.predict(cloud)
    classifier.predict(cloud + (500_000.0, 5_400_000.0, 300.0))
    near, far = (one[0].double() - one[0].double().mean(0) for one in seen)
    assert float((near - far).abs().max()) < 1e-5


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((40, 2)), r"the cloud is a ndarray of shape \(40, 2\), expected \(N,3\)"),
        (np.ones((3, 40)), "transpose it"),
        (np.zeros(3), "got a ndarray of 1 dimension$"),
        (np.full((40, 3), np.nan), "the cloud has 0 finite points, at least 16"),
        (np.array([["a"] * 3] * 40), "is of type <U1, expected"),
        ("mug.ply", r"predict takes points; for a file call it: classifier\('mug.ply'\)"),
        ({"points": np.zeros((40, 3))}, "got a dict of 0 dimensions; give its points"),
        (None, "got a NoneType of 0 dimensions$"),
        ([[1.0, 2.0, 3.0], [1.0]], "the cloud is no array"),
        ([np.zeros((2, 40, 3))], "got a list of 4 dimensions"),
        ([np.eye(3)], "cloud 0 has 3 finite points"),
        (np.stack([np.random.default_rng(0).random((20, 3)), np.zeros((20, 3))]),
         "cloud 1 has 1 distinct point"),
    ],
)  # fmt: skip
def test_an_array_that_is_no_cloud_says_which(weights, points, message):
    with pytest.raises(InputError, match=message):
        load_model(weights, "cpu").predict(points)


@pytest.mark.parametrize("votes", [2.0, True, "2", None])
def test_votes_are_counted_in_whole_numbers(weights, votes):
    with pytest.raises(InputError, match="votes must be a whole number, got"):
        load_model(weights, "cpu").predict(MemoryClouds().points([3])[0], votes)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"K": "a"}, r"intrinsics must be K \(3,3\) or \(fx, fy, cx, cy\) in pixels, got 'a'"),
        ({"K": (1, 2, 3)}, "intrinsics must be K"),
        ({"K": (9, 9, np.nan, 4)}, "K must be a finite"),
        ({"K": (0, 9, 4, 4)}, "focal lengths must be positive"),
        ({"depth_scale": np.inf}, "depth_scale must be a finite number above 0, got inf"),
        ({"depth_scale": "1"}, "depth_scale must be a finite number above 0, got '1'"),
        ({"file": 3}, "a capture's file must be a path"),
    ],
)
def test_what_is_wrong_beside_a_depth_image_is_said(weights, tmp_path, rng, arguments, message):
    np.save(tmp_path / "d.npy", rng.uniform(2, 3, (20, 30)))
    given = {"file": tmp_path / "d.npy", "K": (30, 30, 15, 10), **arguments}
    classifier = load_model(weights, torch.device("cpu"))
    with pytest.raises(InputError, match=message):
        classifier(**given)


def test_a_misspelt_keyword_is_told_from_arguments_protocol_and_recipe(data, tmp_path):
    name = f"{MODELS}:Bare"
    for wrong, message in (
        ({"seed": 1}, "called 'seed'; did you mean seeds, split_seed, first_seed"),
        ({"result": "x"}, "called 'result'; did you mean results"),
        ({"results_folder": "x"}, "called 'results_folder'; did you mean .*results"),
        ({"num_point": 8}, "called 'num_point'; did you mean num_points"),
        ({"lr": 0.1}, "lr is a field of the recipe: recipe={'lr': …}"),
    ):
        with pytest.raises(InputError, match=message):
            evaluate(name, data, **{"results": tmp_path, **wrong})
    assert not list(tmp_path.iterdir())


def test_a_model_begins_from_the_weights_of_a_training(weights):
    trained = load_model(weights, "cpu")
    name = f"{MODELS}:Posed"
    same = create_model(name, 3, pretrained=weights)
    for key, tensor in same.state_dict().items():
        assert torch.equal(tensor, trained.model.state_dict()[key])
    more = create_model(name, 7, pretrained=str(weights)).state_dict()
    fits = [key for key, tensor in more.items()
            if tensor.shape == trained.model.state_dict()[key].shape]  # fmt: skip
    assert 0 < len(fits) < len(more)
    with pytest.raises(InputError, match="no weights of pointnet come with this release"):
        create_model("pointnet", 3, pretrained=True)
    with pytest.raises(InputError, match=r"holds a .*Posed', not a 'pointnet'"):
        create_model("pointnet", 3, pretrained=weights)


def test_a_trained_model_and_a_factory_are_evaluated_by_name(weights, data, tmp_path, monkeypatch):
    classifier = load_model(weights, "cpu")
    (tested,) = evaluate(classifier, data, results=tmp_path, device="cpu")
    assert tested.model == f"{MODELS}:Posed"
    board = leaderboard(tmp_path)
    table = board.to_pandas()
    assert table["accuracy"].tolist() == [pytest.approx(tested.scores["accuracy"], abs=1e-6)]
    assert "accuracy" in board._repr_html_()
    assert repr(board) == "<Board of 1 row>"
    saved = board.save(tmp_path / "board")
    assert (tmp_path / "board" / "leaderboard.html") in saved
    assert (tmp_path / "board" / "leaderboard.csv").read_bytes() == board.files["leaderboard.csv"]

    from baselines.pointnet import PointNet
    from tests.benchmark import tiny_models

    assert name_of(PointNet) == "pointnet"
    monkeypatch.chdir(Path(__file__).parents[2])
    assert name_of(tiny_models.Posed) == "tests.benchmark.tiny_models:Posed"
    monkeypatch.chdir(tmp_path)
    assert name_of(tiny_models.Posed).endswith("tiny_models.py:Posed")
    for odd, message in ((lambda k: None, "has no name in its file"),
                         (partial(PointNet, width=2), "put the factory into a file of its own"),
                         (classifier.model, "got a Posed; expected a model's name")):  # fmt: skip
        with pytest.raises(InputError, match=message):
            name_of(odd)
    with pytest.raises(InputError, match="expected the folder of the records"):
        leaderboard([tested])
