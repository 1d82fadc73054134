"""Weights that come with a release: what is packed is what was trained, and damage is said."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from typer.testing import CliRunner

import partialbench as pb
from partialbench.benchmark.pack_weights import MOST_BYTES, MOST_DIFFERENCE, pack
from partialbench.benchmark.records import weights
from partialbench.benchmark.run import run_eval
from partialbench.benchmark.training import checkpoint, packed
from partialbench.cli import app
from partialbench.dataset.loader import ShardDataset
from partialbench.errors import InputError
from tests.benchmark.tiny_models import SMALL

NAME = "pointnet"


@pytest.fixture(scope="module")
def run(data, tmp_path_factory) -> Path:
    """The folder of a short training of a registered model."""
    folder = tmp_path_factory.mktemp("trained")
    run_eval(NAME, data, results_folder=folder, **SMALL)
    return next((folder / "runs").iterdir())


@pytest.fixture(scope="module")
def made(run, data, other, tmp_path_factory) -> Path:
    """Its weights, packed and tested on its own data and on others."""
    folder = tmp_path_factory.mktemp("weights")
    pack(run, {"its own shapes": data, "others": other}, folder)
    return folder


@pytest.fixture
def release(made, tmp_path, monkeypatch) -> Path:
    """A release that comes with them; a copy, to be damaged."""
    folder = shutil.copytree(made, tmp_path / "weights")
    monkeypatch.setattr(weights, "FOLDER", folder)
    return folder


def test_packed_weights_are_the_trained_ones_in_sixteen_bits(run, made):
    content = checkpoint.load(next(run.rglob("checkpoint.pt")))
    again = packed.load(made / f"{NAME}.safetensors")
    for field in (*checkpoint.IDENTITY, "summary", "clouds", "train_sources"):
        assert again[field] == content[field], field
    stored = load_file(made / f"{NAME}.safetensors")
    parameters = dict(checkpoint.build_model(content).named_parameters())
    assert stored.keys() == content["state"].keys()
    for name, tensor in content["state"].items():
        if name in parameters:
            assert stored[name].dtype == torch.float16
            assert torch.equal(stored[name].float(), tensor.half().float()), name
            assert torch.equal(again["state"][name], tensor.half().float()), name
        else:  # running means and variances
            assert torch.equal(stored[name], tensor), name
    (card,) = made.glob("*.json")
    about = json.loads(card.read_text())
    assert about["rounding"]["largest_difference"] <= MOST_DIFFERENCE
    assert about["licence"] == "the terms of the shapes that it was made from"
    assert about["checkpoint_sha256"] == content["weights_sha256"]


def test_the_card_says_what_predict_gives(release, data, other):
    classifier = pb.load_model(NAME, "cpu")
    for test, folder in zip(classifier.card["tests"], (data, other), strict=True):
        clouds = ShardDataset(folder, "test", 64)
        names = [clouds.class_names[label] for label in clouds.labels]
        asked = [row for row, name in enumerate(names) if name in classifier.class_names]
        right = [
            classifier.predict(clouds.points([row])[0][: clouds.n_visible[row]]).class_name
            == names[row]
            for row in asked
        ]
        assert test["accuracy"] == pytest.approx(np.mean(right))
        assert (test["answered"], test["left_out"]) == (len(asked), len(names) - len(asked))
        assert test["data"]["digest"] == clouds.digest
    assert classifier.card["tests"][1]["left_out"] > 0, "the lamps"
    table = weights.as_markdown({NAME: classifier.card})
    assert f"{classifier.card['tests'][0]['accuracy']:.1%}" in table


def test_a_name_stands_for_the_weights_wherever_a_checkpoint_does(release, data, tmp_path, rng):
    assert pb.list_models(pretrained=True) == [NAME]
    classifier = pb.load_model(NAME, "cpu")
    assert "its own shapes" in classifier.about
    model = pb.create_model(NAME, pretrained=True)
    for name, tensor in model.state_dict().items():
        assert torch.equal(tensor, classifier.content["state"][name])
    fewer = pb.create_model(NAME, 2, pretrained=True)
    assert fewer.eval()(torch.randn(2, 64, 3)).class_logits.shape == (2, 2)

    (tested,) = pb.evaluate(classifier, data, results=tmp_path / "a", device="cpu")
    (named,) = run_eval(NAME, data, checkpoint_file=NAME, results_folder=tmp_path / "b",
                        device="cpu")  # fmt: skip
    assert tested.scores == named.scores
    assert packed.PACKED in named.deviations
    (tuned,) = run_eval(NAME, data, start_from=NAME, results_folder=tmp_path / "c", **SMALL)
    assert any("begun from weights" in one for one in tuned.deviations)

    np.save(tmp_path / "cloud.npy", rng.standard_normal((200, 3)))
    done = CliRunner().invoke(
        app, ["predict", str(tmp_path / "cloud.npy"), "--checkpoint", NAME, "--json"]
    )
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["class"] in classifier.class_names
    assert "its own shapes" in done.stderr


def edited(path: Path, **fields) -> None:
    card = {**json.loads(path.read_text()), **fields}
    path.write_text(json.dumps(card))


def flipped(path: Path, at: int) -> None:
    content = bytearray(path.read_bytes())
    content[at] ^= 1
    path.write_bytes(content)


def no_objects(folder: Path) -> None:
    next(folder.glob("objects-*.bin")).unlink()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: flipped(f / f"{NAME}.safetensors", -9), "not the file its card lists"),
        (lambda f: (f / f"{NAME}.safetensors").write_bytes(b""), "of 0 bytes, expected"),
        (lambda f: (f / f"{NAME}.safetensors").write_bytes(
            (f / f"{NAME}.safetensors").read_bytes()[:-100]), "cut short or edited"),
        (lambda f: (f / f"{NAME}.json").unlink(), r"pointnet\.json is not a readable JSON file"),
        (lambda f: (f / f"{NAME}.json").write_text("{"), "not a readable JSON file"),
        (lambda f: (f / f"{NAME}.json").write_text("[]"), "no card of packed weights"),
        (lambda f: edited(f / f"{NAME}.json", format_version=2), "format 2, this version reads 1"),
        (lambda f: edited(f / f"{NAME}.json", clouds_seen=9_999_999), "changed after it was"),
        (lambda f: edited(f / f"{NAME}.json", clouds_seen="many"), "damaged: clouds_seen: "),
        (no_objects, "cannot be read: No such file"),
    ],
)  # fmt: skip
def test_damage_is_a_sentence(release, damage, message):
    damage(release)
    with pytest.raises(InputError, match=message):
        pb.load_model(NAME, "cpu")


def test_what_is_no_release_s_weights_is_refused(run, data, other, done, tmp_path, monkeypatch):
    with pytest.raises(InputError, match="not what these weights were trained on"):
        pack(run, {"others": other}, tmp_path)
    with pytest.raises(InputError, match="registered models"):
        pack(next((done[1] / "runs").glob("*seed0")), {"its own": data}, tmp_path)
    with pytest.raises(InputError, match="trained on toy, for which the terms of the shapes"):
        pack(run, {"its own": data})
    with pytest.raises(InputError, match="nothing to test on"):
        pack(run, {}, tmp_path)
    content = checkpoint.load(next(run.rglob("checkpoint.pt")))
    name = next(name for name, _ in checkpoint.build_model(content).named_parameters())
    content["state"][name] = content["state"][name] + 1e5
    with pytest.raises(InputError, match="more than 16 bits hold"):
        packed.rounded(content)
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(weights, "FOLDER", tmp_path)
    with pytest.raises(InputError, match="no weights of dgcnn come with this release"):
        pb.create_model("dgcnn", pretrained=True)
    with pytest.raises(InputError, match="no weights of dgcnn come with this release, and no file"):
        pb.load_model("dgcnn")
    with pytest.raises(InputError, match=r"no checkpoint at dgcnn\.pt"):
        pb.load_model("dgcnn.pt")


def test_whatever_comes_with_this_release_loads_and_answers():
    """Of every file in partialbench/weights: whole, small, and of a model that answers."""
    names = weights.names()
    assert not names or weights.DEFAULT in names, "predict asks it by default"
    assert set(names) <= set(pb.list_models())
    here = {path.name for path in weights.FOLDER.iterdir() if path.is_file()}
    listed = {"README.md"}
    cloud = np.random.default_rng(0).standard_normal((600, 3)) * (1, 0.5, 0.1) + (0, 0, 3)
    for name in names:
        classifier = pb.load_model(name, "cpu")
        card = classifier.card
        listed |= {f"{name}.json", card["file"]["name"], card["train_objects"]["name"]}
        assert card["identity"]["model"] == name
        assert card["licence"] == "MIT"
        assert card["identity"]["train_data"]["id"] == "pm40-parametric", "licence-clean"
        assert card["rounding"]["largest_difference"] <= MOST_DIFFERENCE
        assert len(card["tests"]) >= 2, "on real shapes too"
        answer = classifier.predict(cloud)
        assert answer.probabilities.sum() == pytest.approx(1)
        assert len(answer.class_names) == 40
    assert here == listed if names else here <= listed
    assert sum((weights.FOLDER / name).stat().st_size for name in here) <= MOST_BYTES


@pytest.mark.slow
def test_whatever_comes_with_this_release_is_as_right_as_its_card_says(tmp_path):
    """On shapes of another seed, which no training has seen."""
    if not weights.names():
        return
    pb.render_dataset(
        "parametric", tmp_path / "new", splits=("test",), points=1024, seed=77,
        source_options={"counts": (1, 5), "seed": 77}, workers=1,
    )  # fmt: skip
    clouds = ShardDataset(tmp_path / "new", "test", 1024)
    for model in weights.names():
        classifier = pb.load_model(model, "cpu")
        answers = classifier.predict([clouds.points([i])[0] for i in range(len(clouds))])
        given = [clouds.class_names[label] for label in clouds.labels]
        right = [a.class_name == name for a, name in zip(answers, given, strict=True)]
        stated = classifier.card["tests"][0]["accuracy"]
        # Four standard deviations of 200 answers; the board's classes are not equally frequent.
        assert abs(np.mean(right) - stated) < 4 * np.sqrt(0.25 / len(right)), model
