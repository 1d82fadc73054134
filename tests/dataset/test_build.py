"""The builder: same bytes whatever happens, clear refusals, nothing valid lost."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from partialbench.dataset.build import build
from partialbench.dataset.executors import InlineExecutor
from partialbench.dataset.rows import draw
from partialbench.dataset.seeding import generator
from partialbench.dataset.shards import TEMPORARY_SUFFIX
from partialbench.dataset.sources import RejectedObject
from partialbench.errors import ConfigurationMismatchError, InputError, PartialbenchError
from tests.dataset.toy import ToyOccluder, ToySource, plan

REPOSITORY = Path(__file__).resolve().parents[2]


def contents(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir()) if p.name != ".lock"}


@pytest.fixture(scope="module")
def reference(tmp_path_factory) -> dict[str, bytes]:
    """The folder built inline, in one go."""
    out = tmp_path_factory.mktemp("reference")
    build(plan(out), InlineExecutor)
    return contents(out)


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_any_number_of_workers_gives_the_same_bytes(tmp_path, reference, workers):
    build(plan(tmp_path), workers=workers)
    assert contents(tmp_path) == reference


def test_so_it_does_with_all_that_rows_may_hold_and_after_a_loss(tmp_path):
    """Normals and depth images; then a shard, and the table of objects, are lost and made anew."""
    full = ToyOccluder(normals=True, depth=20)
    build(plan(tmp_path / "inline", occluder=full), InlineExecutor)
    expected = contents(tmp_path / "inline")
    out = tmp_path / "pool"
    build(plan(out, occluder=full), workers=2)
    assert contents(out) == expected
    (out / "train-00001.h5").unlink()
    build(plan(out, occluder=full), InlineExecutor)
    assert contents(out) == expected
    lines = (out / "objects.jsonl").read_text().splitlines(keepends=True)
    (out / "objects.jsonl").write_text("".join(lines[1:]))
    (out / "train-00000.h5").write_bytes(b"made anew with its lines")
    build(plan(out, occluder=full), InlineExecutor)
    assert contents(out) == expected
    (out / "objects.jsonl").write_text("{")
    build(plan(out, occluder=full), InlineExecutor)
    assert contents(out) == expected


def test_another_shard_size_gives_the_same_rows(tmp_path, reference):
    manifest = build(plan(tmp_path, rows_per_shard=15), InlineExecutor)
    assert manifest.digests == json.loads(reference["manifest.json"])["digests"]
    assert len(manifest.shards) < len(json.loads(reference["manifest.json"])["shards"])


def test_another_seed_gives_other_rows_and_seed_zero_is_a_seed(tmp_path, reference):
    other = build(plan(tmp_path, seed=1), InlineExecutor)
    assert other.digests != json.loads(reference["manifest.json"])["digests"]
    with pytest.raises(TypeError, match="seed must be an integer, got None"):
        generator(None, "x")


def test_rows_are_what_the_pose_says(tmp_path):
    build(plan(tmp_path), InlineExecutor)
    source = ToySource()
    with h5py.File(tmp_path / "train-00000.h5") as shard:
        object_id = shard["object_id"][0].decode()
        ref = next(r for r in source.objects("train") if r.object_id == object_id)
        back = (shard["points"][0] - shard["t_camera_object"][0]) @ shard["R_camera_object"][0]
        distance = np.abs(source.load(ref).nearest.signed_distance(back))
        assert shard["symmetry"][0] == b"xyz-180"
    assert distance.max() < 1e-6


def test_aligned_views_are_canonical(tmp_path):
    build(plan(tmp_path, setting="aligned"), InlineExecutor)
    with h5py.File(tmp_path / "test-00000.h5") as shard:
        assert np.array_equal(shard["R_camera_object"][0], np.eye(3))


def test_draw_is_without_replacement_until_the_points_run_out(rng):
    assert len(np.unique(draw(50, 40, rng))) == 40
    more = draw(50, 80, rng)
    assert len(np.unique(more[:50])) == 50, "every point once before any repeat"
    with pytest.raises(InputError, match="no visible point"):
        draw(0, 4, rng)


def test_kill_at_any_moment_then_continue(tmp_path, reference):
    """``kill -9`` during the run, again and again, then finish: the bytes of an unbroken run."""
    script = (
        "from pathlib import Path; from tests.dataset.toy import *; "
        "from partialbench.dataset.build import build\n"
        "if __name__ == '__main__':\n"
        f"    build(plan(Path({str(tmp_path)!r}), source=ToySource(slow_s=0.12)), workers=2)\n"
    )
    main = tmp_path.parent / f"{tmp_path.name}_main.py"
    main.write_text(script)
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    delays = iter([0.9, 1.4, 2.1, 3.0])
    finished_shards = []
    for delay in delays:
        process = subprocess.Popen([sys.executable, str(main)], env=environment,
                                   start_new_session=True)  # fmt: skip
        time.sleep(delay)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        # Whatever is there under a final name is whole.
        for path in tmp_path.glob("*.h5"):
            assert path.read_bytes() == reference[path.name]
        finished_shards.append(len(list(tmp_path.glob("*.h5"))))
        time.sleep(0.2)
    subprocess.run([sys.executable, str(main)], env=environment, check=True, timeout=120)
    assert contents(tmp_path) == reference
    assert finished_shards == sorted(finished_shards), "a finished shard was lost"


def test_a_partly_written_file_is_swept_and_a_deleted_shard_is_made_anew(tmp_path, reference):
    build(plan(tmp_path), InlineExecutor)
    (tmp_path / f".train-00009.h5{TEMPORARY_SUFFIX}").write_bytes(b"half")
    (tmp_path / "train-00001.h5").unlink()
    build(plan(tmp_path), InlineExecutor)
    assert contents(tmp_path) == reference


@pytest.mark.parametrize("name", ["CARD.md", "failures.jsonl", "croissant.json", "train-00001.h5"])
def test_what_a_complete_folder_lost_is_made_anew(tmp_path, reference, name):
    build(plan(tmp_path), InlineExecutor)
    (tmp_path / name).unlink()
    build(plan(tmp_path), InlineExecutor)
    assert contents(tmp_path) == reference


def test_a_shard_cut_short_does_not_count_as_finished(tmp_path, reference):
    build(plan(tmp_path), InlineExecutor)
    os.truncate(tmp_path / "train-00001.h5", 1000)
    build(plan(tmp_path), InlineExecutor)
    assert contents(tmp_path) == reference


def test_another_configuration_is_refused_by_name_and_nothing_is_touched(tmp_path):
    build(plan(tmp_path), InlineExecutor)
    before = contents(tmp_path)
    with pytest.raises(ConfigurationMismatchError) as error:
        build(plan(tmp_path, seed=7, points=32), InlineExecutor)
    assert "seed: folder has 0, asked for 7" in str(error.value)
    assert "points: folder has 64, asked for 32" in str(error.value)
    assert contents(tmp_path) == before


def test_a_folder_with_other_things_in_it_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(PartialbenchError, match=r"not empty and not a data folder.*thesis\.tex"):
        build(plan(tmp_path), InlineExecutor)
    assert (tmp_path / "thesis.tex").read_text() == "x"


def test_two_runs_cannot_write_into_one_folder(tmp_path):
    import fcntl

    with open(tmp_path / ".lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(PartialbenchError, match="another run is writing"):
            build(plan(tmp_path), InlineExecutor)


def test_a_broken_object_is_recorded_and_costs_only_itself(tmp_path, reference):
    source = ToySource(broken=("dresser_0002",))
    manifest = build(plan(tmp_path, source=source), InlineExecutor)
    lines = [json.loads(x) for x in (tmp_path / "failures.jsonl").read_text().splitlines()]
    assert [(f["kind"], f["split"], f["object_id"]) for f in lines] == [
        ("failed", "train", "dresser_0002"),
        ("failed", "test", "dresser_0002"),
    ]
    assert lines[0]["reason"] == "toy/train/2 has 0 faces, expected at least 1"
    assert manifest.rows("train") == 15
    # The rows of the others are untouched by the loss.
    with h5py.File(tmp_path / "train-00002.h5") as shard:
        whole = tmp_path / "reference.h5"
        whole.write_bytes(reference["train-00002.h5"])
        with h5py.File(whole) as expected:
            assert np.array_equal(shard["row_sha256"][()], expected["row_sha256"][()])


def test_an_object_that_kills_its_worker_is_recorded_and_the_run_goes_on(tmp_path):
    source = ToySource(deadly=("bottle_0003",))
    manifest = build(plan(tmp_path, source=source), workers=2)
    assert [f["object_id"] for f in manifest.failures] == ["bottle_0003", "bottle_0003"]
    assert "worker process died" in manifest.failures[0]["reason"]
    assert manifest.rows("train") == 15


def test_rules_turn_views_away_without_failing_them(tmp_path):
    source = ToySource(rejected=[RejectedObject("bin_0", "train", "no PS15 class", "scene/1")])
    manifest = build(plan(tmp_path, source=source, occluder=ToyOccluder(reject=True)),
                     InlineExecutor)  # fmt: skip
    assert {f["kind"] for f in manifest.failures} == {"rejected"}
    assert manifest.failures[0]["reason"] == "no PS15 class"
    views = [f for f in manifest.failures if "view" in f]
    assert manifest.rows("train") + manifest.rows("test") + len(views) == 6 * 3 + 6


def test_nothing_usable_is_an_error_with_the_first_reason(tmp_path):
    source = ToySource(count=1, broken=("dresser_0000",))
    with pytest.raises(InputError, match=r"no object of split 'train' gave a row.*0 faces"):
        build(plan(tmp_path, source=source), InlineExecutor)
    with pytest.raises(InputError, match="lists no objects"):
        build(plan(tmp_path / "empty", source=ToySource(count=0)), InlineExecutor)


def test_a_full_disk_loses_nothing_that_was_finished(tmp_path, reference):
    """A write the system refuses (here: a file size limit) ends the run with its reason."""
    out = tmp_path / "out"
    script = (
        "import resource, sys; from pathlib import Path; from tests.dataset.toy import *\n"
        "from partialbench.dataset.build import build\n"
        "from partialbench.dataset.executors import InlineExecutor\n"
        "from partialbench.errors import PartialbenchError\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (8000, resource.RLIM_INFINITY))\n"
        f"try: build(plan(Path({str(out)!r})), InlineExecutor)\n"
        "except PartialbenchError as error: sys.exit(str(error))\n"
    )
    assert len(reference["train-00000.h5"]) > 8000 > len(reference["CARD.md"])
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True,
                         env={**os.environ, "PYTHONPATH": str(REPOSITORY)})  # fmt: skip
    assert run.returncode == 1
    assert "could not write train-00000.h5" in run.stderr
    assert "File too large" in run.stderr
    assert "run the same command again" in run.stderr
    assert not list(out.glob("*.h5"))
    assert not list(out.glob(f".*{TEMPORARY_SUFFIX}"))
    build(plan(out), InlineExecutor)
    assert contents(out) == reference


def test_a_disk_full_from_the_start_leaves_a_folder_that_can_be_continued(
    tmp_path, reference, monkeypatch
):
    def refuse(path, data):
        if data:
            raise PartialbenchError(f"could not write {path.name}")
        path.write_bytes(data)

    with monkeypatch.context() as patched:
        patched.setattr("partialbench.dataset.manifest.write_atomically", refuse)
        with pytest.raises(PartialbenchError, match=r"could not write manifest\.json"):
            build(plan(tmp_path), InlineExecutor)
    assert sorted(p.name for p in tmp_path.iterdir()) == [".lock", "failures.jsonl"]
    build(plan(tmp_path), InlineExecutor)
    assert contents(tmp_path) == reference


def test_what_failed_is_made_when_asked_once_it_is_mended(tmp_path, reference):
    build(plan(tmp_path, source=ToySource(broken=("dresser_0002",))), InlineExecutor)
    before = {p.name: p.stat().st_mtime_ns for p in tmp_path.glob("*.h5")}
    assert len(build(plan(tmp_path), InlineExecutor).failures) == 2
    assert build(plan(tmp_path), InlineExecutor, retry_failed=True).failures == []
    assert contents(tmp_path) == reference
    again = {p.name for p in tmp_path.glob("*.h5") if p.stat().st_mtime_ns != before.get(p.name)}
    assert again == {"train-00001.h5", "test-00000.h5"}


def test_a_shard_without_rows_is_made_when_asked_and_rejections_stay(tmp_path, reference):
    broken = ToySource(broken=("dresser_0002", "bottle_0003"))
    manifest = build(plan(tmp_path, source=broken), InlineExecutor)
    assert [e.rows for e in manifest.shards if e.split == "train"] == [6, 0, 6]
    build(plan(tmp_path), InlineExecutor, retry_failed=True)
    assert contents(tmp_path) == reference
    # The other way round: a shard that had rows and is made anew without leaves no file behind.
    for name in ("train-00001.h5", "test-00000.h5"):
        (tmp_path / name).unlink()
    build(plan(tmp_path, source=broken), InlineExecutor)
    (tmp_path / "train-00001.h5").write_bytes(reference["train-00001.h5"])
    build(plan(tmp_path, source=broken), InlineExecutor, retry_failed=True)
    assert not (tmp_path / "train-00001.h5").exists()
    rejecting = tmp_path / "rejecting"
    build(plan(rejecting, occluder=ToyOccluder(reject=True)), InlineExecutor)
    whole = contents(rejecting)
    never = ToySource(broken=tuple(f"{n}_{i:04d}" for i in range(6) for n in ("dresser", "bottle")))
    build(plan(rejecting, source=never, occluder=ToyOccluder(reject=True)), InlineExecutor,
          retry_failed=True)  # fmt: skip
    assert contents(rejecting) == whole


def test_nothing_usable_can_be_mended_and_made(tmp_path, reference):
    every = ToySource(broken=tuple(f"{n}_{i:04d}" for i in range(6) for n in ("dresser", "bottle")))
    with pytest.raises(InputError, match="with --retry-failed"):
        build(plan(tmp_path, source=every), InlineExecutor)
    build(plan(tmp_path), InlineExecutor, retry_failed=True)
    assert contents(tmp_path) == reference


def test_first_objects_of_each_class(tmp_path):
    manifest = build(plan(tmp_path, per_class={"train": 2, "test": 1}), InlineExecutor)
    assert (manifest.rows("train"), manifest.rows("test")) == (2 * 2 * 3, 2)
