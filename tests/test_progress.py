"""Progress on stderr, with a terminal and without."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from partialbench import progress
from partialbench.dataset.build import Progress as BuildProgress


def told(draw, terminal=False):
    """What ``draw(console)`` writes."""
    console = Console(file=io.StringIO(), force_terminal=terminal, width=60)
    draw(console)
    return console.file.getvalue()


@pytest.fixture
def seconds(monkeypatch):
    """A clock that a test moves: seconds[0]."""
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def train(console, seconds, steps, silent=False):
    with progress.training_bar(console, silent) as bar:
        task = bar.add_task("dgcnn", total=steps, loss="")
        for step in range(steps):
            seconds[0] += 25.0
            bar.update(task, completed=step + 1, loss=f"loss {3 - step / 10:.1f}")


def test_without_a_terminal_a_line_is_written_every_minute_and_at_the_end(seconds):
    lines = told(lambda console: train(console, seconds, 7)).splitlines()
    assert [line.split(" left ")[0] for line in lines] == [
        "dgcnn 3/7 steps loss 2.8", "dgcnn 6/7 steps loss 2.5", "dgcnn 7/7 steps loss 2.4",
    ]  # fmt: skip
    assert lines[-1].endswith("left 0:00:00")


def test_a_silent_bar_writes_nothing(seconds):
    assert told(lambda console: train(console, seconds, 7, silent=True)) == ""
    assert told(lambda console: train(console, seconds, 7, silent=True), terminal=True) == ""


def test_a_terminal_gets_a_bar_and_no_lines(seconds):
    drawn = told(lambda console: train(console, seconds, 7), terminal=True)
    assert "━" in drawn
    assert "dgcnn 3/7" not in drawn


def test_a_line_of_a_build_says_what_failed_and_is_not_folded(seconds):
    def build(console):
        with progress.build_bar(console) as update:
            for done in (1, 2):
                seconds[0] += 61.0
                made = BuildProgress(2, done_objects=done, rows=done * 10, failed=1)
                update(made)
                update(made)  # nothing new: no other line

    lines = told(build).splitlines()
    assert [line.split(" objects ")[0] for line in lines] == ["render 1/2", "render 2/2"]
    assert all(line.endswith(" 1 failed") for line in lines)


def test_a_count_of_things_ends_with_a_line(seconds):
    def count(console):
        update = progress.counting_bar(console, "verify")
        for done in (1, 2, 3):
            update(done, 3)

    (line,) = told(count).splitlines()
    assert line.startswith("verify 3/3 ")
