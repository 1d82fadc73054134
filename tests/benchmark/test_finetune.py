"""Trainings that begin from the weights of another."""

from __future__ import annotations

import json

import pytest
import torch
from typer.testing import CliRunner

from leaderboard.words import budget
from partialbench.benchmark.records.origin import clouds_before
from partialbench.benchmark.run import run_eval
from partialbench.benchmark.training import checkpoint, finetune
from partialbench.cli import app
from partialbench.errors import InputError
from tests.benchmark.tiny_models import MODELS, SMALL, Bare, Posed

STILL = {"recipe": {"lr": 0.0, "optimizer": "sgd", "weight_decay": 0.0}}
"""A training that moves nothing but batch norm's statistics."""


@pytest.fixture(scope="module")
def weights(done):
    return next((done[1] / "runs").glob("*toy-*seed1/branch-*/checkpoint.pt"))


def tune(data, weights, folder, **more):
    return run_eval(
        f"{MODELS}:Posed", data, start_from=weights, results_folder=folder, **{**SMALL, **more}
    )


def trained(folder):
    return checkpoint.load(next((folder / "runs").glob("*/branch-*/checkpoint.pt")))


def test_it_begins_with_the_weights(data, weights, tmp_path):
    tune(data, weights, tmp_path, **STILL)
    before, after = checkpoint.load(weights)["state"], trained(tmp_path)["state"]
    moved = [name for name in before if not torch.equal(before[name], after[name])]
    assert moved
    assert all("running" in name or "num_batches" in name for name in moved)


def test_a_row_and_a_record_of_their_own(data, weights, tmp_path):
    (record,) = tune(data, weights, tmp_path)
    before = checkpoint.load(weights)
    origin = record.training["start"]
    assert record.variant == f"start {origin['name']}"
    assert origin["name"].startswith("toy:")
    assert (origin["seed"], origin["clouds_seen"], origin["start"]) == (1, 64, None)
    assert origin["train_data"]["digest"] == before["train_data"]["digest"]
    assert any("begun from weights" in line and "64 clouds" in line for line in record.deviations)
    assert budget(record).endswith(", after 64")


def test_the_chain_of_starts_is_counted(data, weights, tmp_path):
    tune(data, weights, tmp_path / "once")
    once = next((tmp_path / "once" / "runs").glob("*/branch-*/checkpoint.pt"))
    (record,) = tune(data, once, tmp_path / "twice")
    assert clouds_before(record.training["start"]) == 128
    assert "trained on 128 clouds" in record.deviations[-1]


def test_other_classes_get_a_new_last_layer(other, weights, tmp_path):
    (record,) = tune(other, weights, tmp_path, **STILL)
    before, after = checkpoint.load(weights), trained(tmp_path)
    # Posed's last layer has the 60 bins and the classes: as many here as there, but others.
    assert len(before["class_names"]) == len(record.train_data.class_names)
    head = ["body.head.2.weight", "body.head.2.bias"]
    for name in before["state"]:
        if "running" not in name and "num_batches" not in name:
            same = torch.equal(before["state"][name], after["state"][name])
            assert same == (name not in head), name
    start = finetune.load(weights, f"{MODELS}:Posed")
    reversed_names = start.class_names[::-1]
    for names in (["a", "b", "c", "d", "e"], ["a", "b", "c"], reversed_names):
        model = Posed(len(names))
        assert finetune.begin(model, start, names, Posed) == head
        assert torch.equal(model.state_dict()["body.points.0.weight"],
                           before["state"]["body.points.0.weight"])  # fmt: skip
    # A test object that either training has seen is a duplicate.
    assert set(after["train_sources"]) >= set(before["train_sources"])


def test_resumed_it_ends_the_same(data, weights, tmp_path):
    whole = tune(data, weights, tmp_path / "a", clouds=[128])
    again = tune(data, weights, tmp_path / "a", clouds=[128])
    assert whole[0].predictions_sha256 == again[0].predictions_sha256


def test_its_checkpoint_is_tested_as_the_same_row(data, weights, tmp_path):
    (record,) = tune(data, weights, tmp_path)
    path = next((tmp_path / "runs").glob("*/branch-*/checkpoint.pt"))
    (again,) = run_eval(
        f"{MODELS}:Posed", data, checkpoint_file=path, device="cpu", results_folder=tmp_path / "b"
    )
    assert again.row == record.row
    assert again.deviations == record.deviations


def test_what_is_no_start(data, weights, tmp_path):
    with pytest.raises(InputError, match="not a 'pointnet': it is no start"):
        run_eval("pointnet", data, start_from=weights, results_folder=tmp_path, **SMALL)
    with pytest.raises(InputError, match="give one"):
        tune(data, weights, tmp_path, checkpoint_file=weights)
    with pytest.raises(InputError, match=r"validate \(split_seed: 0 there, 3 now\)"):
        tune(data, weights, tmp_path, split_seed=3)
    unfinished = tmp_path / "unfinished.pt"
    content = checkpoint.load(weights)
    identity = {name: content.pop(name) for name in checkpoint.IDENTITY}
    del content["summary"]
    checkpoint.save(unfinished, identity, content)
    with pytest.raises(InputError, match="is not a finished training and cannot be the start"):
        tune(data, unfinished, tmp_path)


def test_weights_of_another_architecture_are_refused(weights):
    start = finetune.load(weights, f"{MODELS}:Posed")
    with pytest.raises(InputError, match="another architecture"):
        finetune.begin(Bare(3), start, start.class_names, Bare)
    wide = Posed(3)
    wide.body = Bare(63, width=32)
    with pytest.raises(InputError, match=r"body\.points\.0\.weight"):
        finetune.begin(wide, start, start.class_names, Posed)
    # Neither between other classes, where a new last layer is all that may be new.
    wider = Posed(4)
    wider.body = Bare(64, width=32)
    wide.num_classes = 3
    with pytest.raises(InputError, match=r"body\.points\.0\.weight"):
        finetune.begin(wide, start, ["a", "b", "c"], lambda k: wider)


def test_from_the_command_line(data, weights, tmp_path):
    command = ["eval", "--model", f"{MODELS}:Posed", "--data", str(data), "--preset", "smoke",
               "--device", "cpu", "--results", str(tmp_path), "--start-from", str(weights),
               "--protocol", "num_points=64", "--json"]  # fmt: skip
    ran = CliRunner().invoke(app, command)
    assert ran.exit_code == 0, ran.output
    (record,) = json.loads(ran.stdout)
    assert record["training"]["start"]["seed"] == 1
