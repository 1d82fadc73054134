"""The same build on a Dask cluster of two processes gives the same bytes."""

import sys
from pathlib import Path

import pytest

from partialbench.dataset.build import build
from partialbench.dataset.executors import InlineExecutor, dask_cluster
from partialbench.errors import InputError
from tests.dataset.test_build import contents
from tests.dataset.toy import ToySource, plan

distributed = pytest.importorskip("distributed")
dask = pytest.importorskip("dask")
REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def address():
    """A scheduler and two worker processes on loopback."""
    dask.config.set({"distributed.scheduler.allowed-failures": 0})  # one death, not four, is enough
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None,
        env={"PYTHONPATH": str(REPOSITORY)},
    ) as cluster:  # fmt: skip
        yield cluster.scheduler_address


def test_a_cluster_gives_the_same_bytes(tmp_path, address):
    build(plan(tmp_path / "inline"), InlineExecutor)
    cluster = dask_cluster(address)
    assert cluster.workers == 2
    build(plan(tmp_path / "cluster"), lambda: cluster, 2)
    assert contents(tmp_path / "cluster") == contents(tmp_path / "inline")


def test_an_object_that_kills_cluster_workers_is_recorded(tmp_path, address):
    source = ToySource(deadly=("dresser_0002",))
    manifest = build(
        plan(tmp_path, source=source, per_class={"train": 3, "test": 1}),
        lambda: dask_cluster(address),
        2,
    )
    assert {f["object_id"] for f in manifest.failures} == {"dresser_0002"}
    assert manifest.rows("train") == 15


def test_no_scheduler_is_a_clear_error():
    with pytest.raises(InputError, match="no Dask scheduler answers at"):
        dask_cluster("tcp://127.0.0.1:1", timeout_s=1)


def test_without_dask_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install 'partialbench\[cluster\]'"):
        dask_cluster("tcp://127.0.0.1:1")
