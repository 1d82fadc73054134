"""``run_eval`` to several milestones: a record each, continued by the next call, or restarted."""

from __future__ import annotations

from partialbench.benchmark.records import results
from partialbench.benchmark.run import run_eval
from partialbench.benchmark.training import trunk
from tests.benchmark.tiny_models import MODELS, SMALL


def test_each_milestone_is_a_record_in_a_column_of_its_own(data, tmp_path):
    def grow(folder, clouds, **more):
        return run_eval(f"{MODELS}:Bare", data, results_folder=tmp_path / folder,
                        **{**SMALL, "clouds": clouds}, **more)  # fmt: skip

    first = grow("grown", [64], seeds=2)
    later = grow("grown", ["128", 256], seeds=2)
    # The nearest milestone of every seed first.
    assert [(r.training["clouds"], r.seed) for r in later] == [
        (128, 0), (128, 1), (256, 0), (256, 1),
    ]  # fmt: skip
    assert [r.training["clouds_seen"] for r in (*first, *later)] == [64, 64, 128, 128, 256, 256]
    assert len({r.column for r in (*first, *later)}) == 3
    assert len({r.protocol_digest for r in (*first, *later)}) == 1
    assert len(results.read_folder(tmp_path / "grown")) == 6
    (alone,) = grow("alone", [256])
    grown = later[2]
    assert alone.run_name == grown.run_name
    assert alone.predictions_sha256 == grown.predictions_sha256
    assert alone.scores == grown.scores
    assert alone.deviations == grown.deviations

    folder = next((tmp_path / "grown" / "runs").glob("*seed0"))
    assert trunk.progress(folder).milestones_done == (64, 128, 256)
    grow("grown", [64], restart=True)
    assert trunk.progress(folder).milestones_done == (64,)
    other = next((tmp_path / "grown" / "runs").glob("*seed1"))
    assert trunk.progress(other).milestones_done == (64, 128, 256)
