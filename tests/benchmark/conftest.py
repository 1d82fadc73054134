"""One small trained model, for the tests of what comes after training, and a small campaign."""

from __future__ import annotations

from pathlib import Path

import pytest

from partialbench.benchmark.campaign import run as running
from partialbench.benchmark.campaign import worker
from partialbench.benchmark.campaign.file import load
from partialbench.benchmark.campaign.jobs import from_dict
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


CAMPAIGN = """
results = "records"
work = "work"
preset = "smoke"

[data.toy]
render = "pm40 --counts 1,1"
[data.other]
render = "pm40 --counts 1,1"

[[train]]
models = ["{MODELS}:Bare", "{MODELS}:Posed"]
data = "toy"
clouds = [32, 64]

[[train]]
models = "{MODELS}:Posed"
data = "toy"
clouds = 64
test = "other"
points = 32

[[tune]]
models = "{MODELS}:Bare"
data = "toy"
clouds = 64
tries = [{lr = 0.01}]
"""


@pytest.fixture
def campaign(tmp_path):
    (tmp_path / "board.toml").write_text(CAMPAIGN.replace("{MODELS}", MODELS))
    data_folder(tmp_path / "work" / "data" / "toy", points=256)
    data_folder(
        tmp_path / "work" / "data" / "other", "toy-rooms", ("table", "chair"), points=256, seed=5
    )
    return load(tmp_path / "board.toml")


@pytest.fixture
def in_this_process(monkeypatch):
    """Jobs run here, one after the other; what they were, in order."""
    begun = []

    def run_here(order, stop):
        job = from_dict(order["job"])
        begun.append((job.kind, job.model.partition(":")[2], job.clouds))
        return worker.outcome_of(job, order, Path(stop))

    monkeypatch.setattr(running, "run_in_process", run_here)
    return begun
