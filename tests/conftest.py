"""Fixtures every test file may use."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder with real data and parity fixtures; the test is skipped where it is absent."""
    default = Path(__file__).resolve().parents[2] / "shared"
    folder = Path(os.environ.get("PARTIALBENCH_SHARED", default))
    if not (folder / "parity").is_dir():
        pytest.skip(f"no real data or parity fixtures at {folder} (set PARTIALBENCH_SHARED)")
    return folder


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def arranged(monkeypatch):
    """Every arrangement that was made, in order."""
    from renderers import occlusion

    made = []
    own = occlusion.arrange

    def spy(*arguments):
        made.append(own(*arguments))
        return made[-1]

    monkeypatch.setattr(occlusion, "arrange", spy)
    return made
