"""One small trained model, for the tests of what comes after training."""

from __future__ import annotations

from pathlib import Path

import pytest

from partialbench.benchmark.run import run_eval
from tests.benchmark.memory_clouds import data_folder
from tests.benchmark.tiny_models import MODELS, SMALL


@pytest.fixture(scope="session")
def data(tmp_path_factory) -> Path:
    return data_folder(tmp_path_factory.mktemp("data") / "toy")


@pytest.fixture(scope="session")
def other(tmp_path_factory) -> Path:
    """Shares chair and table with ``data``, in another order, and has a class of its own."""
    folder = tmp_path_factory.mktemp("data") / "other"
    return data_folder(folder, "toy-rooms", ("table", "lamp", "chair"), seed=5)


@pytest.fixture(scope="session")
def done(data, other, tmp_path_factory):
    """Two seeds of a posed model on both data sets, and the folder of records."""
    folder = tmp_path_factory.mktemp("results")
    written = run_eval(f"{MODELS}:Posed", data, other, seeds=2, results_folder=folder, **SMALL)
    return written, folder
