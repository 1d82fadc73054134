"""The log for TensorBoard has the lines of log.csv, each once, also after an interruption."""

from __future__ import annotations

import csv

import pytest

from partialbench.benchmark.run import run_eval
from partialbench.benchmark.training.follow import TensorBoard, check_log
from partialbench.errors import InputError
from tests.benchmark.tiny_models import MODELS, SMALL

events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")


def scalars(folder, name):
    found = events.EventAccumulator(str(folder))
    found.Reload()
    return [(event.step, event.value) for event in found.Scalars(name)]


def test_a_training_writes_what_its_log_has(data, tmp_path):
    run_eval(f"{MODELS}:Bare", data, results_folder=tmp_path, log_to="tensorboard", **SMALL)
    (log,) = tmp_path.glob("runs/*/branch-*/log.csv")
    with open(log, newline="") as file:
        lines = list(csv.DictReader(file))
    losses = [(int(line["clouds_seen"]), float(line["train_loss"])) for line in lines]
    folder = log.parent / "tensorboard"
    assert scalars(folder, "train_loss") == [(step, pytest.approx(v)) for step, v in losses]
    ((step, accuracy),) = scalars(folder, "validation_accuracy")
    assert (step, accuracy) == (
        losses[-1][0],
        pytest.approx(float(lines[-1]["validation_accuracy"])),
    )


def test_lines_of_before_an_interruption_are_not_written_twice(tmp_path):
    history = [{"clouds_seen": n, "train_loss": 1 / n, "clouds_per_second": None} for n in (1, 2)]
    first = TensorBoard(tmp_path / "a")
    first.update(history)
    first.update(history)
    first.close()
    earlier = [dict(line) for line in history]
    history[-1]["clouds_per_second"] = 4.0  # was not known when the line was written
    history.append({"clouds_seen": 3, "train_loss": 0.1, "clouds_per_second": 5.0})
    second = TensorBoard(tmp_path / "a", earlier)
    second.update(history)
    second.close()
    assert [step for step, _ in scalars(tmp_path / "a", "train_loss")] == [1, 2, 3]
    assert scalars(tmp_path / "a", "clouds_per_second") == [(2, 4.0), (3, 5.0)]
    # A branch of a trunk has a folder of its own: the whole log goes into it.
    whole = TensorBoard(tmp_path / "b", earlier)
    whole.update(history)
    whole.close()
    assert [step for step, _ in scalars(tmp_path / "b", "train_loss")] == [1, 2, 3]
    assert scalars(tmp_path / "b", "clouds_per_second") == [(2, 4.0), (3, 5.0)]


def test_an_unknown_log_is_refused():
    with pytest.raises(InputError, match="no log 'tensorbord'; did you mean tensorboard"):
        check_log("tensorbord")
