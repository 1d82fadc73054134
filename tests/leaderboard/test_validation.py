"""Two trainings on the validation split: what is compared, and that no test split is opened."""

from __future__ import annotations

import shutil

import pytest

from leaderboard.validation import compare
from partialbench.benchmark.tune import tune
from partialbench.dataset.loader import ShardDataset
from partialbench.errors import InputError
from tests.benchmark.memory_clouds import data_folder

PROTOCOL = {"num_points": 64, "max_train_clouds": 200, "max_test_clouds": None,
            "validation_fraction": 0.3}  # fmt: skip
SMALL = {"clouds": 128, "device": "cpu", "preset": "smoke", "protocol": PROTOCOL}
TWIN = {"channels": 8, "width": 8}


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trials")
    data = data_folder(folder / "data")
    for path in (data / "test").rglob("*"):  # as a trial, it never looks there
        if path.is_file():
            path.unlink()
    trials = []
    for seed in (0, 1):
        trials += tune("papnet-steered-nopose", data, [{}, {"lr": 0.0}], seed=seed,
                       results_folder=folder / "results", options=TWIN, **SMALL)  # fmt: skip
    runs = sorted((folder / "results" / "runs").iterdir())
    learnt = [run for run in runs if "lr=0" not in run.name]
    never = [run for run in runs if "lr=0" in run.name]
    return data, learnt, never, trials


def test_accuracies_are_those_of_the_trials_and_the_gain_is_between_them(trained):
    data, learnt, never, trials = trained
    assert len(learnt) == len(never) == 2
    train_set = ShardDataset(data, "train", 64)
    found = compare([(run, {}) for run in never], [(run, {}) for run in learnt], train_set)
    for accuracy, recipe in ((found.a, "lr=0.0"), (found.b, "")):
        recorded = [t.validation_accuracy for t in trials if t.recipe == recipe]
        assert len(recorded) == 2
        assert accuracy == pytest.approx(sum(recorded) / 2)
    assert found.gain == pytest.approx(found.b - found.a)
    assert found.low <= found.gain <= found.high
    assert 0 < found.p_value <= 1
    same = compare([(learnt[0], {})], [(learnt[0], {})], train_set)
    assert (same.gain, same.low, same.high, same.p_value) == (0, 0, 0, 1)


def test_options_that_act_at_test_alone_are_tried_on_the_same_weights(trained):
    data, learnt, *_ = trained
    train_set = ShardDataset(data, "train", 64)
    found = compare([(learnt[0], {})], [(learnt[0], {"votes": 4})], train_set)
    assert 0 <= found.b <= 1
    with pytest.raises(InputError):
        compare([(learnt[0], {})], [(learnt[0], {"width": 16})], train_set)


def test_the_other_may_read_more_points_of_the_same_clouds(trained):
    data, learnt, *_ = trained
    few, many = (ShardDataset(data, "train", points) for points in (32, 64))
    one, other = [(learnt[0], {})], [(learnt[1], {})]
    found = compare(one, other, few, many)
    assert found.a == compare(one, other, few).a
    assert found.b == compare(one, other, many).b


def test_what_cannot_be_compared_is_refused(trained, tmp_path):
    data, learnt, never, _ = trained
    train_set = ShardDataset(data, "train", 64)
    with pytest.raises(InputError, match="as many runs of each are compared, got 2 and 1"):
        compare([(run, {}) for run in never], [(learnt[0], {})], train_set)
    other = ShardDataset(data_folder(tmp_path / "other", seed=5), "train", 64)
    with pytest.raises(InputError, match="was trained on other data than toy"):
        compare([(never[0], {})], [(learnt[0], {})], other)
    shutil.rmtree(tmp_path / "other")
