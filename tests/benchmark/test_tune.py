"""Recipes are compared on the validation split, each trial recorded once."""

from __future__ import annotations

import csv
import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict

import pytest
import torch
from typer.testing import CliRunner

from partialbench.benchmark.records.trials import FILE, Trial, add_trial, read_trials
from partialbench.benchmark.training import checkpoint
from partialbench.benchmark.tune import tune
from partialbench.cli import app
from partialbench.errors import InputError
from tests.benchmark.memory_clouds import data_folder

MODEL = "tests.benchmark.tiny_models:Bare"
SHORT = {"num_points": 32, "warm_up": 0}
TRIES = [{"lr": 1e-7}, {}, {"lr": 0.01, "batch_size": 16}]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Without its test split: nothing here may open it."""
    folder = data_folder(tmp_path_factory.mktemp("data") / "toy")
    for path in folder.glob("test-*.h5"):
        path.unlink()
    return folder


@pytest.fixture(scope="module")
def done(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("results")
    found = tune(
        MODEL, data, TRIES, "board", device="cpu", results_folder=folder, clouds=200, protocol=SHORT
    )
    return found, folder


def test_the_best_comes_first_and_each_is_what_its_own_training_ended_with(done):
    found, folder = done
    scores = [trial.validation_accuracy for trial in found]
    assert scores == sorted(scores, reverse=True)
    for trial in found:
        (log,) = [
            path for path in folder.glob("runs/*/branch-200/log.csv")
            if ("lr" in trial.recipe) == ("lr" in path.parts[-3])
            and ("batch" in trial.recipe) == ("batch" in path.parts[-3])
        ]  # fmt: skip
        last = list(csv.DictReader(log.open()))[-1]
        assert float(last["validation_accuracy"]) == trial.validation_accuracy
    assert {t.recipe for t in found} == {"lr=1e-07", "", "batch_size=16 lr=0.01"}


def test_trials_are_recorded_once_and_not_repeated(done, data):
    found, folder = done
    written = (folder / FILE).read_bytes()
    assert sorted(read_trials(folder / FILE), key=repr) == sorted(found, key=repr)
    for run in (folder / "runs").iterdir():  # a repeated training would write its log again
        (run / "branch-200" / "log.csv").unlink()
    again = tune(
        MODEL, data, TRIES, "board", device="cpu", results_folder=folder, clouds=200, protocol=SHORT
    )
    assert again == found
    assert (folder / FILE).read_bytes() == written
    assert not list((folder / "runs").glob("*/*/log.csv"))


def test_the_same_recipe_at_another_milestone_is_another_trial(data, tmp_path):
    for clouds in ("100", 200):
        tune(MODEL, data, [{}], device="cpu", results_folder=tmp_path, clouds=clouds,
             protocol=SHORT)  # fmt: skip
    trials = read_trials(tmp_path / FILE)
    assert {trial.clouds_seen for trial in trials} == {96, 192}  # of 32 a step
    assert len({trial.protocol for trial in trials}) == 1


def test_another_call_adds_to_the_file(done, data, tmp_path):
    found, folder = done
    shutil.copy(folder / FILE, tmp_path)
    more = tune(
        MODEL, data, [{"lr": 0.003}], "board", device="cpu", results_folder=tmp_path,
        clouds=100, protocol=SHORT, options={"width": 8},
    )  # fmt: skip
    assert more[0].options == "width=8"
    assert len(read_trials(tmp_path / FILE)) == len(found) + 1


@pytest.mark.parametrize(
    ("tries", "protocol", "message"),
    [
        ([], {}, "nothing to try"),
        ([{"rate": 0.1}], {}, "a recipe has no field 'rate'"),
        ([{}], {"validation_fraction": 0}, "there is nothing to choose on"),
        ([{}, {"epochs": 2}], {}, "epochs=2 does not go with .*--clouds"),
    ],
)
def test_what_cannot_be_tuned_is_refused(data, tmp_path, tries, protocol, message):
    with pytest.raises(InputError, match=message):
        tune(
            MODEL,
            data,
            tries,
            "board",
            device="cpu",
            clouds=100,
            results_folder=tmp_path,
            protocol={**SHORT, **protocol},
        )
    assert not (tmp_path / FILE).exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seed": -1}, "seed must be at least 0, got -1"),
        ({"seed": "0"}, "seed must be a whole number, got '0'"),
        ({"tries": {"lr": 0.1}}, "tries must be one or a list of them"),
        ({"tries": ["lr=0.1"]}, "a recipe to try must be a dictionary such as .*, got 'lr=0.1'"),
        ({"data": 3}, "a data folder must be a path"),
        ({"results_folder": 3}, "the folder of the results must be a path"),
        ({"options": "width=8"}, "options must be a dictionary"),
        ({"protocol": "num_points"}, "protocol must be a dictionary"),
    ],
)
def test_wrong_arguments_are_named(data, tmp_path, arguments, message):
    given = {"data": data, "tries": [{}], "results_folder": tmp_path, **arguments}
    with pytest.raises(InputError, match=message):
        tune("pointnet", **given)


def test_the_command_takes_several_fields_a_trial_and_prints_what_it_records(data, tmp_path):
    command = [
        "tune", "--model", MODEL, "--data", str(data), "--results", str(tmp_path),
        "--device", "cpu", "--option", "width=8",
        "--protocol", "num_points=32", "--clouds", "0.1k",
        "--try", "lr=0.01,batch_size=16", "--try", "lr=0.003", "--json",
    ]  # fmt: skip
    ran = CliRunner().invoke(app, command)
    assert ran.exit_code == 0, ran.output
    printed = json.loads(ran.stdout)["trials"]
    assert {trial["recipe"] for trial in printed} == {"batch_size=16 lr=0.01", "lr=0.003"}
    assert {trial["options"] for trial in printed} == {"width=8"}
    recorded = [asdict(trial) for trial in read_trials(tmp_path / FILE)]
    assert sorted(recorded, key=repr) == sorted(printed, key=repr)


def test_trials_added_at_once_are_all_kept(tmp_path):
    trials = [Trial("m", "", f"lr={i}", 0, "d", "p", 1, 0.5, 0.5) for i in range(16)]
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(add_trial, [tmp_path / FILE] * len(trials), trials))
    assert len(read_trials(tmp_path / FILE)) == len(trials)


def test_a_file_that_is_none_is_named(tmp_path):
    (tmp_path / FILE).write_text("model,options\nx,y\n")
    with pytest.raises(InputError, match=r"tuning.csv is not a file of trials"):
        read_trials(tmp_path / FILE)


def test_trials_may_begin_from_weights(done, data, tmp_path):
    """A rate of next to nothing then keeps them."""
    start = next(
        path for path in done[1].glob("runs/*/branch-*/checkpoint.pt") if "batch" in str(path)
    )
    (trial,) = tune(
        MODEL, data, [{"lr": 1e-7}], "board", device="cpu", results_folder=tmp_path,
        clouds=100, start_from=start, protocol=SHORT,
    )  # fmt: skip
    assert trial.options.startswith("start toy:")
    assert trial.recipe == "lr=1e-07"
    before = checkpoint.load(start)["state"]
    after = checkpoint.load(next(tmp_path.glob("runs/*/branch-*/checkpoint.pt")))["state"]
    for name in (name for name in before if name.endswith(("weight", "bias"))):
        torch.testing.assert_close(after[name], before[name], atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (",0.5\n", ",1.5\n", "line 2: no trial of net:make ended so: its .* is 1.5"),
        (",0.5\n", ",nan\n", "its validation accuracy is nan"),
        (",0.5\n", ",\n", "of loss and accuracy one is missing"),
        (",0.75,", ",inf,", "its loss is inf"),
        (",64,", ",0,", "it has seen 0 clouds"),
        (",0.5\n", ",0.5\nnet:make,,lr=1,0,d,p,64,0.25,0.875\n", "line 3: .* it comes twice"),
    ],
)  # fmt: skip
def test_a_file_of_trials_that_cannot_be_is_refused(tmp_path, old, new, message):
    add_trial(tmp_path / FILE, Trial("net:make", "", "lr=1", 0, "d", "p", 64, 0.75, 0.5))
    text = (tmp_path / FILE).read_text()
    assert text.count(old) == 1
    (tmp_path / FILE).write_text(text.replace(old, new))
    with pytest.raises(InputError, match=message):
        read_trials(tmp_path / FILE)
