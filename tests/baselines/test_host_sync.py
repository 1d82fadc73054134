"""No model's training step waits for the device it runs on."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def checked(*names: str) -> subprocess.CompletedProcess[str]:
    """In a process of its own: torch takes a new device before its first gradient only."""
    return subprocess.run(
        [sys.executable, "-m", "benchmarks.host_sync", *(["--models", *names] if names else [])],
        cwd=ROOT, capture_output=True, text=True, timeout=600,
    )  # fmt: skip


@pytest.mark.slow
def test_no_model_waits() -> None:
    done = checked()
    assert done.returncode == 0, done.stdout + done.stderr


def test_what_waits_is_found_and_nothing_else() -> None:
    module = "tests.baselines.waiting_models"
    done = checked(*(f"{module}:{how}" for how in ("value", "place", "host", "never")))
    assert done.returncode == 1, done.stderr
    *waiting, never = done.stdout.splitlines()
    assert len(waiting) == 3
    assert all("waiting_models.py:" in line for line in waiting)
    assert never.endswith("never waits")
