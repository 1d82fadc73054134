"""``run_eval`` from a data folder to records, and with a user's own model."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from leaderboard.check import problems
from partialbench.benchmark.predict import Classifier
from partialbench.benchmark.protocol.split import balanced_subset
from partialbench.benchmark.records import results
from partialbench.benchmark.run import run_eval
from partialbench.benchmark.testing import asked, metrics
from partialbench.benchmark.testing.asked import Asked, Folder
from partialbench.benchmark.testing.run import _test_rows
from partialbench.cli import app
from partialbench.dataset.loader import ShardDataset
from partialbench.errors import ConfigurationMismatchError, InputError
from tests.benchmark.memory_clouds import MemoryClouds, data_folder
from tests.benchmark.tiny_models import MODELS, SMALL, STEERED, Bare

ROOT = Path(__file__).resolve().parents[2]


def test_a_record_per_seed_and_test_set(done):
    written, folder = done
    assert [(r.seed, r.test_data.id) for r in written] == [
        (0, "toy"), (0, "toy-rooms"), (1, "toy"), (1, "toy-rooms"),
    ]  # fmt: skip
    assert sorted(p.name for p in folder.glob("*.json")) == sorted(
        f"{r.run_name}.result.json" for r in written
    )
    assert {r.run_name for r in results.read_folder(folder)} == {r.run_name for r in written}


def test_a_record_says_what_made_it(done, data):
    record, folder = done[0][0], done[1]
    manifest = json.loads((data / "manifest.json").read_text())
    assert record.train_data.digest == manifest["digests"]["train"]
    assert record.test_data.digest == manifest["digests"]["test"]
    # 12 objects a class, one of each validates; two views.
    assert (record.train_data.clouds, record.train_data.objects) == (66, 33)
    assert record.protocol["preset"] == "smoke+"
    assert record.cost["parameters"] == sum(p.numel() for p in Bare(63).parameters())
    assert record.environment["instructions"] == torch.backends.cpu.get_cpu_capability()
    assert record.environment["packages"]["torch"] == torch.__version__.split("+")[0] or (
        record.environment["packages"]["torch"] == torch.__version__
    )
    assert record.training["clouds_seen"] == 64
    assert record.deviations
    assert record.seed == 0
    log = next((folder / "runs").glob("*seed0/branch-64/log.csv"))
    assert len(log.read_text().splitlines()) == 3  # the trunk and its branch, a step each


def test_scores_are_those_of_the_stored_predictions(done):
    for record in done[0]:
        stored = results.read_predictions(done[1], record)
        again = metrics.scores(stored, record.train_data.class_names, record.test_data.class_names)
        assert again == record.scores
        assert record.scores["pose"]["top_k"][-1] >= record.scores["pose"]["top_k"][0]


def test_another_data_set_is_scored_on_the_shared_classes(done):
    crossed = done[0][1]
    assert crossed.scores["clouds"] == 48  # chair and table, 12 objects, 2 views
    assert crossed.scores["per_class"]["bottle"] is None
    assert crossed.scores["restricted_accuracy"] >= crossed.scores["accuracy"]
    assert crossed.column != done[0][0].column


@pytest.mark.parametrize("limit", [200, 1])
def test_a_class_that_only_a_few_of_the_clouds_have_is_found(tmp_path, data, limit):
    """Few clouds of many classes, as the trial before a training tests, may have none in common."""
    other = data_folder(tmp_path / "other", "toy-other", ("aal", "chair", "cod", "eel"))
    _, crossed = run_eval(
        f"{MODELS}:Bare", data, other, results_folder=tmp_path / "results",
        **{**SMALL, "max_test_clouds": limit},
    )  # fmt: skip
    labels = ShardDataset(other, "test", 64).labels
    few = balanced_subset(np.arange(len(labels)), labels, 1)
    assert labels[few] != 1, "the one cloud of a balanced subset is of another class than chair"
    assert crossed.scores["clouds"] == min(limit, 24)
    assert {name for name, share in crossed.scores["per_class"].items() if share is not None} == {
        "chair"
    }


def test_one_test_or_several_each_folder_once():
    a, b = Path("a"), Path("b")
    conditions = (64,), ("0",), ("jitter:3",)
    once = asked.read("a", ["b", a], None, 64, 0, "jitter:3")
    assert once == Asked([Folder(a, *conditions), Folder(b, *conditions)], [])
    assert asked.read(None, "a", None, [64, 128], ["0", "class:0"], ["jitter:3", "scale:1"]) == (
        Asked([Folder(a, (64, 128), ("0", "class:0"), ("jitter:3", "scale:1"))], [])
    )


def test_conditions_of_one_folder_are_not_those_of_another():
    a, b = Path("a"), Path("b")
    of_each = asked.read("a", "b", None, {"b": 64}, {b: ["0"], "a": "15"}, {a: "jitter:3"})
    assert of_each == Asked([Folder(a, (), ("15",), ("jitter:3",)), Folder(b, (64,), ("0",))], [])
    with pytest.raises(InputError, match=r"test_points names c, which is not tested on; tested on"):
        asked.read("a", "b", None, {"c": 64}, (), ())


def test_a_shared_class_without_a_cloud_is_no_test(data):
    class Empty(MemoryClouds):
        def __init__(self):
            super().__init__(classes=("aal", "table"))
            self.labels = np.zeros_like(self.labels)

    with pytest.raises(InputError, match=r"no cloud of the test data \(toy\) is of a class that"):
        _test_rows(Empty(), ("chair", "table"), 2)


def test_a_field_of_the_protocol_may_be_called_as_an_argument_is(data, tmp_path):
    """The command line takes any field, "recipe" too, and refuses what is none."""
    fields = {"recipe": "published", "num_points": 64}
    command = [
        "eval", "--model", f"{MODELS}:Posed", "--data", str(data), "--preset", "smoke",
        "--device", "cpu", "--results", str(tmp_path),
    ]  # fmt: skip
    for name, value in fields.items():
        command += ["--protocol", f"{name}={value}"]
    ran = CliRunner().invoke(app, command)
    assert ran.exit_code == 0, ran.output
    (record,) = results.read_folder(tmp_path)
    assert {name: record.protocol[name] for name in fields} == fields
    assert record.recipe["schedule"] == "constant"
    for name in ("seeds", "preset"):
        with pytest.raises(InputError, match=f"the protocol has no field '{name}'"):
            run_eval(f"{MODELS}:Posed", data, device="cpu", protocol={name: 1})


def test_the_same_weights_on_clouds_of_other_sizes(done, data, tmp_path):
    """One record each; only those of the size trained on are of the table's column."""
    written, folder = done
    (weights,) = (folder / "runs").glob("*seed0/branch-*/checkpoint.pt")
    found = run_eval(
        f"{MODELS}:Posed", data, checkpoint_file=weights, device="cpu", results_folder=tmp_path,
        test_points=[16, 32, 64],
    )  # fmt: skip
    assert [r.test_data.points for r in found] == [64, 16, 32]
    assert [r.conditions for r in found] == [{}, {"points": "16"}, {"points": "32"}]
    assert found[0].column == written[0].column
    assert found[1].column != found[2].column
    assert len(results.read_folder(tmp_path)) == 3
    with pytest.raises(InputError, match="100000 were asked for"):
        run_eval(
            f"{MODELS}:Posed", data, checkpoint_file=weights, device="cpu",
            results_folder=tmp_path, test_points=[100_000],
        )  # fmt: skip


def test_a_checkpoint_tested_alone_gives_the_same_record(done, data, tmp_path):
    first, folder = done[0][0], done[1]
    weights = next((folder / "runs").glob("*seed0/branch-*/checkpoint.pt"))
    (again,) = run_eval(
        first.model, data, checkpoint_file=weights, device="cpu", results_folder=tmp_path
    )
    assert again.identity == first.identity
    assert again.predictions_sha256 == first.predictions_sha256
    assert again.scores == first.scores
    assert again.training == first.training
    with pytest.raises(InputError, match=r"holds a .*Posed', not a 'pointnet'"):
        run_eval("pointnet", data, checkpoint_file=weights, device="cpu", results_folder=tmp_path)


def test_options_that_weights_do_not_depend_on_can_be_changed_for_a_test(data, tmp_path):
    """A row of its own, and the one that training under those options would have made."""
    trained = {
        "data": data,
        "recipe": {"lr": 0.01},
        **SMALL,
        "max_train_clouds": 32,
        "max_test_clouds": 12,
    }
    alike, other = (
        run_eval(
            "papnet-steered", options={**STEERED, "votes": votes},
            results_folder=tmp_path / str(votes), **trained,
        )[0]
        for votes in (1, 2)
    )  # fmt: skip
    (weights,) = (tmp_path / "1" / "runs").glob("*/branch-*/checkpoint.pt")

    def with_options(**options):
        return run_eval(
            "papnet-steered", data, checkpoint_file=weights, device="cpu", options=options,
            results_folder=tmp_path / "changed",
        )[0]  # fmt: skip

    changed = with_options(votes=2)
    assert changed.row == other.row != alike.row
    assert changed.options == other.options
    assert changed.identity == other.identity
    assert changed.predictions_sha256 == other.predictions_sha256 != alike.predictions_sha256
    with pytest.raises(InputError, match="weights do not fit"):
        with_options(scales=2)


def test_resuming_a_finished_evaluation_changes_no_prediction(done, data, other):
    written, folder = done
    weights = sorted((folder / "runs").glob("*/branch-*/checkpoint.pt"))
    before = [w.read_bytes() for w in weights]
    again = run_eval(f"{MODELS}:Posed", data, other, seeds=2, results_folder=folder, **SMALL)
    assert [w.read_bytes() for w in weights] == before
    assert [r.predictions_sha256 for r in again] == [r.predictions_sha256 for r in written]


def test_what_the_user_changes_is_another_row(data, tmp_path):
    (plain,) = run_eval(f"{MODELS}:Bare", data, results_folder=tmp_path, **SMALL)
    (changed,) = run_eval(
        f"{MODELS}:Bare", data, results_folder=tmp_path, recipe={"lr": 0.1}, options={"width": 8},
        **SMALL,
    )  # fmt: skip
    assert plain.row == f"{MODELS}:Bare"
    assert changed.row == f"{MODELS}:Bare [width=8; recipe lr=0.1]"
    assert changed.column == plain.column
    assert "lr 0.1 instead of 0.001" in changed.deviations
    assert changed.cost["parameters"] < plain.cost["parameters"]
    assert len(results.read_folder(tmp_path)) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seeds": 0}, "seeds must be at least 1, got 0"),
        ({"device": "gpu"}, "device must be auto, cpu, cuda"),
        ({"preset": "papr"}, "did you mean paper"),
        ({"rotations": 1}, "did you mean rotation"),
        ({"recipe": {"learning_rate": 1}}, "a recipe has no field 'learning_rate'"),
        ({"num_points": 4096}, "4096 were asked for"),
        ({"data": None}, "nothing to train on"),
        ({"checkpoint_file": "no.pt"}, "no checkpoint at no.pt"),
        ({"checkpoint_every": 1.5}, "checkpoint_every must be a whole number, got 1.5"),
        ({"seeds": "2"}, "seeds must be a whole number, got '2'"),
        ({"first_seed": -1}, "first_seed must be at least 0, got -1"),
        ({"restart": "no"}, "restart must be True or False, got 'no'"),
        ({"should_stop": 3}, "should_stop must be something to call, got 3"),
        ({"options": "width=8"}, "options must be a dictionary such as .*, got 'width=8'"),
        ({"recipe": [("lr", 1)]}, "recipe must be a dictionary"),
        ({"test_points": [1.5]}, "test_points must be a whole number, got 1.5"),
        ({"test_data": 3}, "a data folder must be a path"),
        ({"preset": None}, "no preset named None; known: board"),
        ({"preset": ["smoke"]}, r"no preset named \['smoke'\]; did you mean smoke"),
        ({"protocol": {"num_points": 32}}, "num_points of the protocol is given twice"),
        ({"device": None}, "device must be auto, cpu, cuda or cuda:0 …, got 'None'"),
        ({"clouds": "31"}, "31 clouds are less than one batch"),
        ({"clouds": 31}, "31 clouds are less than one batch"),
        ({"test_poses": "yes"}, "a test pose is 'random' or .* got 'yes'"),
        ({"checkpoint_every": 0}, "checkpoint_every must be at least 1, got 0"),
        ({"recipe": {"batch_size": 200}, "max_train_clouds": 1}, "batches of 2 clouds or more"),
        ({"options": {"widht": 8}}, "no option 'widht'; did you mean width"),
        ({"precision": "32-false"}, "precision '32-false'"),
        ({"recipe": {"epochs": 4}}, "epochs=4 does not go with"),
        ({"clouds": ["1OOk"]}, "such as 25000, 100k or 1M, got '1OOk'"),
        ({"clouds": [31]}, "31 clouds are less than one batch of 32"),
        ({"preset": "paper", "clouds": [64, 128]}, "published recipes have one schedule"),
    ],
)
def test_wrong_arguments_are_named(data, tmp_path, arguments, message):
    given = {**SMALL, "data": data, "results_folder": tmp_path, **arguments}
    with pytest.raises(InputError, match=message):
        run_eval(f"{MODELS}:Bare", **given)


def test_weights_are_tested_as_they_were_trained_or_not_at_all(done, data, tmp_path):
    path = next((done[1] / "runs").glob("*seed1/branch-*/checkpoint.pt"))
    same = {"device": "cpu", "results_folder": tmp_path, "checkpoint_file": path}
    for other, message in (
        ({"recipe": {"lr": 0.1}, "seeds": 3}, "--recipe, --seeds would have no effect"),
        ({"preset": "paper"}, "by the preset 'smoke' and is tested by it, not by 'paper'"),
        ({"precision": "bf16-mixed"}, "--precision would have no effect"),
        ({"log_to": "tensorboard", "checkpoint_every": 5}, "--log, --checkpoint-every would have"),
    ):
        with pytest.raises(InputError, match=message):
            run_eval(f"{MODELS}:Posed", data, **same, **other)
    (record,) = run_eval(f"{MODELS}:Posed", data, preset="smoke", **same)
    assert record.protocol["preset"] == "smoke+"


def test_another_precision_is_another_row(data, tmp_path):
    rows = [
        run_eval(f"{MODELS}:Bare", data, results_folder=tmp_path, precision=bits, **SMALL)[0]
        for bits in ("32-true", "bf16")
    ]
    assert [r.variant for r in rows] == ["", "precision bf16-mixed"]
    assert len(results.read_folder(tmp_path)) == 2
    path = next((tmp_path / "runs").glob("*precision*/branch-*/checkpoint.pt"))
    (again,) = run_eval(
        f"{MODELS}:Bare", data, checkpoint_file=path, device="cpu", options={"width": 16},
        results_folder=tmp_path / "again",
    )  # fmt: skip
    assert again.variant == "precision bf16-mixed"  # the width is the default


def test_a_recipe_given_as_it_is_makes_no_other_row(data, tmp_path):
    (plain,) = run_eval(f"{MODELS}:Bare", data, results_folder=tmp_path, **SMALL)
    (same,) = run_eval(
        f"{MODELS}:Bare", data, results_folder=tmp_path, recipe={"lr": 1e-3}, **SMALL
    )
    assert same.run_name == plain.run_name


def test_each_test_set_has_its_own_turned_clouds(done, data, other, tmp_path):
    """They were the first one's, whatever else was tested beside it."""
    beside = next(r for r in done[0] if r.test_data.id == "toy-rooms")
    path = next((done[1] / "runs").glob("*seed0/branch-*/checkpoint.pt"))
    (alone,) = run_eval(
        f"{MODELS}:Posed", other, checkpoint_file=path, device="cpu", results_folder=tmp_path
    )
    assert beside.rotation_audit == alone.rotation_audit
    assert beside.rotation_audit != done[0][0].rotation_audit


MINE = """
import torch
class Mine(torch.nn.Module):
    def __init__(self, num_classes):
        super().__init__()
        self.layer = torch.nn.Linear(3, num_classes)
    def forward(self, clouds):
        return self.layer(clouds.{pooled}(dim=1))
"""


def test_a_users_model_that_was_edited_is_not_taken_for_the_one_before(
    data, tmp_path, monkeypatch, caplog
):
    monkeypatch.chdir(tmp_path)

    def write(pooled):
        (tmp_path / "edited_model.py").write_text(MINE.format(pooled=pooled))
        # As a process of tomorrow meets it.
        for name in [name for name in sys.modules if name.endswith(".edited_model")]:
            del sys.modules[name]

    def train(**more):
        return run_eval("edited_model:Mine", data, results_folder="out", **{**SMALL, **more})

    write("mean")
    (before,) = train()
    assert before.model_code == hashlib.sha256(Path("edited_model.py").read_bytes()).hexdigest()
    assert train()[0].model_code == before.model_code
    write("sum")
    with pytest.raises(ConfigurationMismatchError, match="model_code"):
        train()
    path = next(Path("out/runs").glob("*/branch-*/checkpoint.pt"))
    with pytest.raises(InputError, match="has changed since"):
        run_eval("edited_model:Mine", data, checkpoint_file=path, results_folder="out")
    np.save("cloud.npy", np.eye(3)[np.arange(30) % 3] + np.arange(30)[:, None])
    Classifier(path, model="edited_model:Mine")("cloud.npy")
    assert "has changed since the training" in caplog.text
    train(first_seed=1)
    (problem,) = problems(Path("out"))
    assert "of one row, edited_model:Mine" in problem


def test_a_test_set_without_a_shared_class_is_refused(data, tmp_path):
    foreign = data_folder(tmp_path / "foreign", "foreign", ("sink", "stove"))
    with pytest.raises(InputError, match="share no class"):
        run_eval(f"{MODELS}:Bare", data, foreign, results_folder=tmp_path, **SMALL)


def test_the_example_of_a_users_own_model_runs_from_its_folder(data, tmp_path):
    example = ROOT / "examples" / "my_model.py"
    code = [line for line in example.read_text().splitlines() if line.strip()]
    assert len(code) < 30
    # The page's code is the example's, and what runs is the page's.
    block, *_ = re.findall(r"```python\n(.*?)```", (ROOT / "docs/own_model.md").read_text(), re.S)
    assert block == example.read_text()
    (tmp_path / "my_model.py").write_text(block)
    command = [
        sys.executable, "-P", "-c", "from partialbench.cli import main; main()",
        "eval", "--model", "my_model:make",
        "--data", str(data), "--preset", "smoke", "--protocol", "num_points=64",
        "--device", "cpu", "--results", "out",
    ]  # fmt: skip
    ran = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=300,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1",
             "HOME": str(tmp_path)},
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    (record,) = results.read_folder(tmp_path / "out")
    assert record.model == "my_model:make"
    assert record.cost["parameters"] == 3 * 64 + 64 + 64 * 256 + 256 + 256 * 3 + 3
    assert dataclasses.asdict(record)["scores"]["clouds"] == 16
