"""Training: it learns, resumes to the last bit, stops at NaN, and refuses another's checkpoint."""

from __future__ import annotations

import csv
import dataclasses
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from lightning.fabric import Fabric

from partialbench.benchmark import environment
from partialbench.benchmark.prediction import Batch
from partialbench.benchmark.protocol.protocol import Protocol
from partialbench.benchmark.run import make_task
from partialbench.benchmark.training import checkpoint
from partialbench.benchmark.training.loop import DivergedError, WithLoss
from partialbench.benchmark.training.train import train
from partialbench.errors import ConfigurationMismatchError, InputError
from partialbench.registry import Recipe
from tests.benchmark.memory_clouds import MemoryClouds
from tests.benchmark.tiny_models import Interrupted, Penalised

MODELS = "tests.benchmark.tiny_models"
PROTOCOL = Protocol("paper+", num_points=64, recipe="published")
RECIPE = Recipe(
    lr=0.01, batch_size=16, clip_norm=10.0, schedule="plateau", epochs=3, label_smoothing=0.1,
    schedule_options={"factor": 0.5, "patience": 1,
                      "bn_momentum": {"start": 0.5, "gamma": 0.5, "every_epochs": 1}},
)  # fmt: skip


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def run(folder: Path, model="Bare", recipe=RECIPE, seed=0, data=None, clouds=10**6, **kwargs):
    """To the end of the recipe."""
    fabric = Fabric(accelerator="cpu", devices=1)
    task = make_task(f"{MODELS}:{model}", data or MemoryClouds(), PROTOCOL, recipe, seed, {})
    return train(task, fabric, folder, clouds, **kwargs)


def finished(folder: Path) -> Path:
    return folder / "branch-1M" / "checkpoint.pt"


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return checkpoint.load(finished(folder))["state"]


def same(a, b) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def test_it_learns_a_problem_that_rotations_do_not_hide(tmp_path):
    recipe = Recipe(lr=0.01, batch_size=16, epochs=30, schedule="one-cycle")
    trained = run(tmp_path, recipe=recipe, data=MemoryClouds(objects=60))
    assert trained.history[-1]["train_loss"] < 0.7 * trained.history[0]["train_loss"]
    assert trained.history[-1]["validation_accuracy"] > 0.75
    assert not trained.model.training


def test_the_same_seed_gives_the_same_weights_and_another_seed_others(tmp_path):
    for name, seed in [("a", 0), ("b", 0), ("c", 1)]:
        run(tmp_path / name, seed=seed)
    assert same(weights(tmp_path / "a"), weights(tmp_path / "b"))
    assert not same(weights(tmp_path / "a"), weights(tmp_path / "c"))


# A rate so high that the loss rises again, and "plateau" has cuts to remember.
RESTLESS = dataclasses.replace(RECIPE, lr=0.3, epochs=12)


@pytest.mark.parametrize("stop_at", [2, 7, 15, 48, 60])
def test_an_interrupted_training_ends_with_the_same_weights(tmp_path, monkeypatch, stop_at):
    """Six batches an epoch, saved every two: stops before the first save, at and off epoch ends."""
    monkeypatch.setattr(Interrupted, "stop_at", None)
    asked = {"model": "Interrupted", "recipe": RESTLESS}
    whole = run(tmp_path / "whole", **asked)
    assert len({row["lr"] for row in whole.history}) > 1
    monkeypatch.setattr(Interrupted, "taken", 0)
    monkeypatch.setattr(Interrupted, "stop_at", stop_at)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "cut", checkpoint_every=2, **asked)
    left = finished(tmp_path / "cut")
    if stop_at == 2:
        assert not left.exists()
    else:
        saved = checkpoint.load(left)
        assert saved["step"] == (stop_at - 1) // 2 * 2
        with pytest.raises(InputError, match=r"interrupted branch at .* of its 1,000,000"):
            checkpoint.require_finished(saved, left, "be tested")
    torch.manual_seed(99)  # whatever happened in between
    resumed = run(tmp_path / "cut", checkpoint_every=2, **asked)
    assert same(weights(tmp_path / "whole"), weights(tmp_path / "cut"))
    for a, b in zip(whole.history, resumed.history, strict=True):
        assert a["train_loss"] == pytest.approx(b["train_loss"], rel=1e-12)
        assert a["validation_accuracy"] == b["validation_accuracy"]
        assert a["lr"] == b["lr"]


def test_a_training_names_every_machine_that_carried_a_part_of_it(tmp_path, monkeypatch):
    asked = {"model": "Interrupted", "recipe": RESTLESS}
    monkeypatch.setattr(Interrupted, "taken", 0)
    parts = ("one", 15), ("other", 45), ("one", None)
    for machine, stop_at in parts:
        monkeypatch.setattr(environment, "describe", lambda *_, name=machine: {"device": name})
        monkeypatch.setattr(Interrupted, "stop_at", stop_at)
        if stop_at is None:
            summary = run(tmp_path, checkpoint_every=6, **asked).summary
        else:
            with pytest.raises(KeyboardInterrupt):
                run(tmp_path, checkpoint_every=6, **asked)
    assert summary["environment"] == {"device": "one"}
    assert summary["earlier_environments"] == [{"device": "other"}]


def test_a_training_of_one_piece_names_one_machine(tmp_path):
    assert "earlier_environments" not in run(tmp_path).summary


def test_resuming_a_finished_training_trains_nothing(tmp_path):
    first = run(tmp_path)
    before = finished(tmp_path).read_bytes()
    again = run(tmp_path)
    assert finished(tmp_path).read_bytes() == before
    assert again.summary == first.summary
    assert same(again.model.state_dict(), first.model.state_dict())


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"seed": 1}, "seed"),
        ({"recipe": Recipe(lr=0.5)}, "recipe"),
        ({"model": "NoNorm"}, "model"),
        ({"data": MemoryClouds(seed=7)}, "train_data"),
    ],
)
def test_another_trainings_checkpoint_is_refused(tmp_path, change, named):
    run(tmp_path)
    with pytest.raises(ConfigurationMismatchError, match=named):
        run(tmp_path, **change)


def test_a_loss_that_is_not_a_number_ends_training_early_and_saves_nothing(tmp_path):
    with pytest.raises(DivergedError, match=r"became nan within 10 steps before .*lr \(now 0.01\)"):
        run(tmp_path, "Broken")
    assert not finished(tmp_path).exists()


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ("wrong_shape", r"class_logits have shape \(16, 4\), expected \(16, 3\)"),
        ("not_a_model", "returned a int; expected a torch.nn.Module"),
        ("Bar", "did you mean Bare"),
    ],
)
def test_a_users_mistake_is_named(tmp_path, model, message):
    with pytest.raises(InputError, match=message):
        run(tmp_path, model)


def test_the_log_has_a_row_an_epoch(tmp_path):
    trained = run(tmp_path)
    with open(finished(tmp_path).with_name("log.csv"), newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["clouds_seen"]) for row in rows] == [96, 192, 288]
    assert float(rows[-1]["train_loss"]) == trained.history[-1]["train_loss"]
    assert trained.summary["steps"] == 18
    assert trained.summary["clouds_seen"] == 288


def test_a_checkpoint_loads_without_running_code_and_a_stranger_does_not(tmp_path):
    run(tmp_path)
    content = torch.load(finished(tmp_path), weights_only=True)
    assert content["class_names"] == ["bottle", "chair", "table"]
    assert content["num_points"] == 64
    assert "optimizer" not in content  # a finished one holds weights alone
    model = checkpoint.build_model(content, content["model"])
    clouds = torch.from_numpy(MemoryClouds().points(np.arange(4)))
    assert model(clouds).shape == (4, 3)

    torch.save({"state_dict": {}}, tmp_path / "other.pt")
    with pytest.raises(InputError, match="not written by partialbench eval"):
        checkpoint.load(tmp_path / "other.pt")
    torch.save(Path("x"), tmp_path / "code.pt")
    (tmp_path / "cut.pt").write_bytes(finished(tmp_path).read_bytes()[:500])
    for name in ("code.pt", "cut.pt"):
        with pytest.raises(InputError, match=r"no checkpoint, or it is damaged|loads safely"):
            checkpoint.load(tmp_path / name)


SCRIPT = """
import sys, torch
torch.set_num_threads(1)
from pathlib import Path
from tests.benchmark import test_train
test_train.run(Path(sys.argv[1]), "Slow", checkpoint_every=2)
"""


@pytest.mark.slow
def test_training_killed_three_times_ends_with_the_same_weights(tmp_path):
    root = Path(__file__).resolve().parents[2]
    rng = np.random.default_rng()
    command = [sys.executable, "-c", SCRIPT]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    subprocess.run([*command, str(tmp_path / "whole")], cwd=root, env=environment, check=True)
    path = finished(tmp_path / "cut")
    for _ in range(3):
        process = subprocess.Popen([*command, str(tmp_path / "cut")], cwd=root, env=environment)
        before = path.stat().st_mtime_ns if path.exists() else 0
        while process.poll() is None:
            time.sleep(0.01)
            if path.exists() and path.stat().st_mtime_ns != before:
                time.sleep(rng.uniform(0, 0.3))
                process.send_signal(signal.SIGKILL)
                process.wait()
        assert process.returncode == -signal.SIGKILL
    assert "summary" not in checkpoint.load(path)
    subprocess.run([*command, str(tmp_path / "cut")], cwd=root, env=environment, check=True)
    assert same(weights(tmp_path / "whole"), weights(tmp_path / "cut"))


def test_shares_of_a_batch_average_to_the_loss_of_the_whole():
    """What data parallelism does to a loss that is a mean and a penalty that is a sum."""
    torch.manual_seed(0)
    clouds, label = torch.randn(8, 20, 3), torch.arange(8) % 3
    turn = torch.eye(3).expand(8, 3, 3)
    model = Penalised(3)
    whole = WithLoss(model, 0.1, 3)(Batch(clouds, label, turn, turn))
    assert model(clouds).penalty > 0.1 * whole
    share = WithLoss(model, 0.1, 3, processes=2)
    halves = [share(Batch(clouds[i::2], label[i::2], turn[i::2], turn[i::2])) for i in (0, 1)]
    assert torch.allclose(sum(halves) / 2, whole)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["NoNorm", "Penalised"])
def test_two_processes_train_the_same_model_as_one(tmp_path, model):
    """gloo: the shares of a batch average to the whole batch's gradient, to rounding."""
    root = Path(__file__).resolve().parents[2]
    script = tmp_path / "job.py"
    script.write_text(TWO_PROCESSES.replace("MODEL", model))
    environment = {**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    single = [sys.executable, str(script), str(tmp_path / "one")]
    double = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2",
              "--master-port", "0", "--standalone", str(script), str(tmp_path / "two")]  # fmt: skip
    for command in (single, double):
        subprocess.run(command, cwd=root, env=environment, check=True, timeout=300)
    one, two = (checkpoint.load(finished(tmp_path / n)) for n in ("one", "two"))
    for name, tensor in one["state"].items():
        assert torch.allclose(tensor, two["state"][name], atol=1e-5), name
    for a, b in zip(one["history"], two["history"], strict=True):
        assert a["train_loss"] == pytest.approx(b["train_loss"], rel=1e-5)
        assert a["validation_accuracy"] == b["validation_accuracy"]


TWO_PROCESSES = """
import sys
from pathlib import Path
from partialbench.benchmark.run import make_fabric, make_task
from partialbench.benchmark.training.train import train
from tests.benchmark import test_train
fabric = make_fabric("cpu", "32-true")
task = make_task("tests.benchmark.tiny_models:MODEL", test_train.MemoryClouds(),
                 test_train.PROTOCOL, test_train.RECIPE, 0, {})
train(task, fabric, Path(sys.argv[1]), 10**6)
"""
