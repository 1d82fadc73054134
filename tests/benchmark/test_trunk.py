"""The trunk and its branches: equal to the bit however they came about, and not repeated."""

from __future__ import annotations

import dataclasses
import json
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

from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.protocol.protocol import Protocol
from partialbench.benchmark.records.predictions import to_bytes
from partialbench.benchmark.run import make_task
from partialbench.benchmark.testing import evaluate
from partialbench.benchmark.training import checkpoint, keeper, trunk
from partialbench.benchmark.training.loop import Loop
from partialbench.benchmark.training.train import Task, train
from partialbench.errors import ConfigurationMismatchError, InputError, TimeLimitError
from partialbench.registry import COMMON_RECIPE, Recipe
from tests.benchmark.memory_clouds import MemoryClouds
from tests.benchmark.tiny_models import MODELS, Interrupted

PROTOCOL = Protocol("board+", num_points=64, warm_up=200)
RECIPE = Recipe(**{**COMMON_RECIPE, "batch_size": 10})
MILESTONES = (300, 600, 1_200)
"""Of 10 clouds a step: the trunk branches after 24, 48 and 96 of 30, 60 and 120 steps."""


@pytest.fixture(autouse=True)
def small_steps(monkeypatch):
    """Regular milestones from 300 clouds on, one thread."""
    monkeypatch.setattr(milestones, "FIRST", 300)
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def taken(monkeypatch) -> list[int]:
    """Counts the steps that are taken: their numbers, in order."""
    numbers: list[int] = []
    take = Loop._take

    def counting(self, batch):
        numbers.append(self.step)
        take(self, batch)

    monkeypatch.setattr(Loop, "_take", counting)
    return numbers


def a_task(model="Bare", seed=0) -> Task:
    return make_task(f"{MODELS}:{model}", MemoryClouds(), PROTOCOL, RECIPE, seed, {})


def run(folder: Path, clouds: int, model="Bare", **kwargs):
    return train(a_task(model), Fabric(accelerator="cpu", devices=1), folder, clouds, **kwargs)


def finished(folder: Path, clouds: int) -> dict:
    return checkpoint.load(trunk.RunFolder(folder).branch(clouds))


def assert_same(folder: Path, other: Path, clouds: int) -> None:
    """Weights to the bit, the log's losses, and the bytes of predictions."""
    a, b = finished(folder, clouds), finished(other, clouds)
    assert a["state"].keys() == b["state"].keys()
    for name, tensor in a["state"].items():
        assert torch.equal(tensor, b["state"][name]), name
    for name in ("curve", "clouds_seen", "steps", "train_loss", "validation_accuracy"):
        assert a["summary"][name] == b["summary"][name], name
    dataset = MemoryClouds(seed=3)
    answers = [
        to_bytes(
            evaluate.predict_rows(
                checkpoint.build_model(c, c["model"]),
                dataset,
                np.arange(20),
                dataset.class_names,
                torch.device("cpu"),
            )
        )
        for c in (a, b)
    ]
    assert answers[0] == answers[1]


def test_a_row_at_a_milestone_is_what_a_training_to_it_alone_gives(tmp_path, taken):
    for clouds in MILESTONES:
        run(tmp_path / "grown", clouds)
    # 0.8·M + 0.2·Σm clouds are all that it costs.
    assert 10 * len(taken) == 0.8 * MILESTONES[-1] + 0.2 * sum(MILESTONES)
    for clouds in MILESTONES:
        taken.clear()
        run(tmp_path / f"alone-{clouds}", clouds)
        assert taken == list(range(clouds // 10))
        assert_same(tmp_path / "grown", tmp_path / f"alone-{clouds}", clouds)
    assert not torch.equal(*(finished(tmp_path / "grown", m)["state"]["head.2.bias"]
                             for m in MILESTONES[:2]))  # fmt: skip


def test_a_finished_milestone_is_not_repeated_and_a_passed_one_costs_its_branch(tmp_path, taken):
    far = run(tmp_path, 1_200)
    path = trunk.RunFolder(tmp_path).branch(1_200)
    before = path.read_bytes()
    taken.clear()
    again = run(tmp_path, 1_200)
    assert taken == []
    assert path.read_bytes() == before
    assert again.summary == far.summary
    assert sorted(trunk.RunFolder(tmp_path).states()) == [240, 480, 960]
    run(tmp_path, 300)
    assert taken == list(range(24, 30))


def test_a_milestone_between_the_regular_ones_goes_on_from_the_state_before_it(tmp_path, taken):
    run(tmp_path, 600)
    taken.clear()
    run(tmp_path, 450)  # leaves the trunk after 36 steps; the state before is after 24
    assert taken == list(range(24, 45))
    run(tmp_path / "alone", 450)
    assert_same(tmp_path, tmp_path / "alone", 450)


def test_a_lost_trunk_is_made_again_from_the_seed(tmp_path, taken):
    run(tmp_path / "lost", 300)
    for path in trunk.RunFolder(tmp_path / "lost").states().values():
        path.unlink()
    taken.clear()
    run(tmp_path / "lost", 600)
    assert taken == list(range(60))
    run(tmp_path / "whole", 300)
    run(tmp_path / "whole", 600)
    assert_same(tmp_path / "lost", tmp_path / "whole", 600)
    states = [checkpoint.load(trunk.RunFolder(tmp_path / n).state(480)) for n in ("lost", "whole")]
    for name, tensor in states[0]["state"].items():
        assert torch.equal(tensor, states[1]["state"][name])


# Of 60 steps the first 48 are the trunk's; saved every five steps.
@pytest.mark.parametrize("stop_at", [3, 8, 31, 48, 49, 57, 60])
def test_killed_in_the_trunk_or_in_a_branch_it_ends_the_same(tmp_path, monkeypatch, taken, stop_at):
    monkeypatch.setattr(Interrupted, "stop_at", None)
    run(tmp_path / "whole", 600, "Interrupted")
    monkeypatch.setattr(Interrupted, "taken", 0)
    monkeypatch.setattr(Interrupted, "stop_at", stop_at)
    with pytest.raises(KeyboardInterrupt):  # within a step: nothing is saved any more
        run(tmp_path / "cut", 600, "Interrupted", checkpoint_every=5)
    torch.manual_seed(99)  # whatever happened in between
    taken.clear()
    run(tmp_path / "cut", 600, "Interrupted", checkpoint_every=5)
    saved = max(s for s in (*range(0, 60, 5), 24, 48) if s < stop_at)
    assert taken == list(range(saved, 60))
    assert_same(tmp_path / "whole", tmp_path / "cut", 600)


@pytest.mark.parametrize("steps", [7, 50])
def test_out_of_time_it_saves_and_says_so(tmp_path, taken, steps):
    with pytest.raises(TimeLimitError, match=f"saved at {10 * steps} of 600 clouds") as caught:
        run(tmp_path / "cut", 600, should_stop=lambda: len(taken) == steps)
    assert caught.value.exit_status == 75
    run(tmp_path / "cut", 600)
    assert taken == list(range(60))
    run(tmp_path / "whole", 600)
    assert_same(tmp_path / "whole", tmp_path / "cut", 600)


@pytest.mark.parametrize("steps", [7, 50, 60])
def test_ctrl_c_waits_for_the_step_and_saves(tmp_path, taken, steps):
    def press() -> bool:
        if len(taken) == steps:
            os.kill(os.getpid(), signal.SIGINT)
        return False

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, 600, should_stop=press)
    assert signal.getsignal(signal.SIGINT) is before
    seen = trunk.progress(tmp_path)
    assert max(seen.clouds_seen, *seen.branches.values(), 0) >= 10 * steps
    run(tmp_path, 600)
    assert len(taken) == len(set(taken)) == 60


def test_a_state_is_saved_every_few_minutes_without_being_asked_for(tmp_path, monkeypatch, taken):
    monkeypatch.setattr(keeper, "CHECKPOINT_SECONDS", -1.0)
    with pytest.raises(RuntimeError, match="killed"):
        run(tmp_path, 600, should_stop=lambda: len(taken) == 11 and _killed())
    assert sorted(trunk.RunFolder(tmp_path).states()) == [100]


def _killed() -> bool:
    raise RuntimeError("killed")


def test_progress_is_told_without_torch(tmp_path):
    assert trunk.progress(tmp_path) == trunk.Progress()
    run(tmp_path, 300)
    seen = trunk.progress(tmp_path)
    assert (seen.clouds_seen, seen.milestones_done, seen.branches) == (240, (300,), {})
    assert seen.clouds_per_second > 0
    steps = []
    with pytest.raises(TimeLimitError):
        run(tmp_path, 600, should_stop=lambda: steps.append(1) or len(steps) == 30)
    seen = trunk.progress(tmp_path)
    assert (seen.clouds_seen, seen.milestones_done, seen.branches) == (480, (300,), {600: 540})
    code = (
        "import sys; from partialbench.benchmark.training import trunk; "
        f"print(trunk.progress({str(tmp_path)!r}).clouds_seen, 'torch' in sys.modules)"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.split() == ["480", "False"]
    (tmp_path / trunk.PROGRESS_FILE).write_text("{}")
    with pytest.raises(InputError, match="does not say how far"):
        trunk.progress(tmp_path)


def test_states_that_no_milestone_needs_are_deleted(tmp_path):
    for clouds in MILESTONES:
        run(tmp_path, clouds, checkpoint_every=7)
    assert sorted(trunk.RunFolder(tmp_path).states()) == [960]
    assert trunk.progress(tmp_path).milestones_done == MILESTONES
    assert len(list(tmp_path.glob("trunk/*"))) == 1


def test_a_trunk_says_that_it_is_no_finished_training(tmp_path):
    run(tmp_path, 300)
    path = trunk.RunFolder(tmp_path).state(240)
    content = checkpoint.load(path)
    with pytest.raises(InputError, match=r"the trunk of a training at 240 clouds.*cannot classify"):
        checkpoint.require_finished(content, path, "classify")
    assert content["optimizer"]
    assert "optimizer" not in finished(tmp_path, 300)
    assert finished(tmp_path, 300)["clouds"] == 300


def test_a_trunk_of_another_training_is_refused(tmp_path):
    run(tmp_path, 300)
    with pytest.raises(ConfigurationMismatchError, match=r"seed: 0 there, 1 now.*--restart"):
        train(a_task(seed=1), Fabric(accelerator="cpu", devices=1), tmp_path, 600)


def test_a_recipe_whose_notes_are_in_other_words_is_no_other_training(tmp_path, taken):
    run(tmp_path, 300)
    taken.clear()
    task = a_task()
    said = dataclasses.replace(task, recipe=dataclasses.replace(RECIPE, notes="As published."))
    train(said, Fabric(accelerator="cpu", devices=1), tmp_path, 600)
    assert taken == list(range(24, 60))
    other = dataclasses.replace(task, recipe=dataclasses.replace(RECIPE, lr=0.5))
    with pytest.raises(ConfigurationMismatchError, match=r"recipe: .*'lr': 0.001.* there"):
        train(other, Fabric(accelerator="cpu", devices=1), tmp_path, 600)


def test_the_log_has_lines_of_the_trunk_and_of_the_branch(tmp_path, monkeypatch):
    monkeypatch.setattr(milestones, "LOG_CLOUDS", 100)
    trained = run(tmp_path, 600)
    seen = [row["clouds_seen"] for row in trained.history]
    assert seen == [100, 200, 300, 400, 480, 500, 520, 550, 570, 600]
    assert [row["validation_accuracy"] is None for row in trained.history] == [True] * 9 + [False]
    assert trained.summary["curve"]["clouds_seen"] == seen
    assert trained.summary["clouds"] == 600
    assert trained.history[1]["lr"] == pytest.approx(1e-3)
    assert trained.history[-1]["lr"] == pytest.approx(1e-3 / 12)


SCRIPT = """
import sys, torch
from pathlib import Path
from tests.benchmark import test_trunk as t
torch.set_num_threads(1)
t.milestones.FIRST = 300
for clouds in (300, 600):
    t.run(Path(sys.argv[1]), clouds, "Slow", checkpoint_every=2)
"""


@pytest.mark.slow
def test_killed_three_times_at_random_it_ends_with_the_same_bytes(tmp_path):
    root = Path(__file__).resolve().parents[2]
    rng = np.random.default_rng()
    command = [sys.executable, "-c", SCRIPT, str(tmp_path / "cut")]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    for _ in range(3):
        process = subprocess.Popen(command, cwd=root, env=environment)
        saved = _newest(tmp_path / "cut")
        while process.poll() is None and _newest(tmp_path / "cut") == saved:
            time.sleep(0.01)
        time.sleep(rng.uniform(0, 1.0))
        process.send_signal(signal.SIGKILL)
        process.wait()
    subprocess.run(command, cwd=root, env=environment, check=True)
    for clouds in (300, 600):
        run(tmp_path / "whole", clouds, "Slow")
        assert_same(tmp_path / "whole", tmp_path / "cut", clouds)
    assert json.loads((tmp_path / "cut" / trunk.PROGRESS_FILE).read_text())["branches"] == {}


def _newest(folder: Path) -> int:
    return max((path.stat().st_mtime_ns for path in folder.rglob("*.pt")), default=0)
