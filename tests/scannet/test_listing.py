"""How scans are found, listed, told apart, and drawn again."""

from __future__ import annotations

import json

import numpy as np
import pytest

from partialbench.dataset.build import BuildPlan, build
from partialbench.dataset.executors import InlineExecutor
from partialbench.dataset.render import plan_render
from partialbench.dataset.rows import Job, make_rows
from partialbench.dataset.sources import RejectedView
from partialbench.errors import InputError
from renderers.sources.scannet import source as source_module
from renderers.sources.scannet.filters import BACK_FACING
from renderers.sources.scannet.occluder import ScanHprOccluder
from renderers.sources.scannet.source import ScanNetInstances
from tests.scannet.scenes import write_annotations, write_scene


def test_scans_itself_may_be_given(scannet):
    """The label map lies beside scans/, as ScanNet's download has it."""
    annotations = scannet / "full_annotations.json"
    inside = ScanNetInstances(scannet / "scans", annotations)
    assert inside.describe() == ScanNetInstances(scannet, annotations).describe()
    assert ScanNetInstances(scannet, scannet).describe() == inside.describe()  # its folder will do
    (scannet / "scans" / "scene0001_00" / "scene0001_00_vh_clean_2.ply").unlink()
    with pytest.raises(
        InputError, match=r"no PS15 instance in \S*/scans with .*Expected \S*scans/<"
    ):
        ScanNetInstances(scannet / "scans", annotations).objects("train")
    (scannet / "scannetv2-labels.combined.tsv").rename(scannet / "map.tsv")
    with pytest.raises(InputError, match="--label-map"):
        ScanNetInstances(scannet, annotations)
    ScanNetInstances(scannet, annotations, label_map=scannet / "map.tsv")


def test_annotations_are_parsed_once_however_many_scenes(tmp_path, things, monkeypatch):
    entries = [write_scene(tmp_path, f"scene000{i}_00", things[:1]) for i in range(6)]
    path = write_annotations(tmp_path, entries)
    parsed, told = [], []
    real = source_module.read_annotations
    monkeypatch.setattr(source_module, "read_annotations", lambda p: (parsed.append(p), real(p))[1])
    source = ScanNetInstances(tmp_path, path, on_scene=lambda *now: told.append(now))
    assert sum(len(source.objects(split)) for split in ("train", "test")) == 6
    assert len(parsed) == 1
    assert told == [(i, 6) for i in range(1, 7)]


def test_what_a_worker_gets_does_not_grow_with_the_annotations(tmp_path, things):
    import pickle

    path = write_annotations(tmp_path, [write_scene(tmp_path, "scene0001_00", things)])
    assert len(pickle.dumps(ScanNetInstances(tmp_path, path)._reader)) < 2000


@pytest.mark.parametrize(("viewpoints", "expected"), [
    (None, "ps15"), ("uniform", "ps15"), ("standing", "ps15-standing"),
])  # fmt: skip
def test_viewpoints_are_told_by_the_data_sets_id(scannet, tmp_path, viewpoints, expected):
    options = {"scannet": scannet, "scan2cad": scannet / "full_annotations.json"}
    options |= {"viewpoints": viewpoints} if viewpoints else {}
    plan = plan_render("ps15", tmp_path / "out", source_options=options)
    assert plan.job.dataset_id == expected


def test_rules_reach_the_source_and_the_occluder(scannet, tmp_path):
    options = {"scannet": scannet, "scan2cad": scannet / "full_annotations.json",
               "rules": {"min_visible": 20, "attempts": 3}}  # fmt: skip
    job = plan_render("ps15", tmp_path / "out", source_options=options).job
    assert job.source.describe()["rules"]["min_visible"] == 20
    assert job.occluder.describe()["rules"]["min_visible"] == 20
    assert job.occluder.attempts == 3
    assert job.min_visible == 20
    del options["rules"]
    job = plan_render("ps15", tmp_path / "out", source_options=options, min_visible=21).job
    assert job.min_visible == job.source.describe()["rules"]["min_visible"] == 21
    assert plan_render("ps15", tmp_path / "out", source_options=options).job.min_visible == 128


def plan(scannet, out, views=10, **rules) -> BuildPlan:
    source = ScanNetInstances(scannet, scannet / "full_annotations.json", rules=rules)
    split = source.splits()[0]
    occluder = ScanHprOccluder(1.75, rules=rules)
    job = Job(source, occluder, "ps15", "partial", {split: views}, 64, 0, occluder.min_visible)
    return BuildPlan(job, out, (split,))


def test_every_instance_has_all_its_views(scannet, tmp_path):
    """Views that show less than their median are turned away at first, and drawn again."""
    all_of_them = plan(scannet, tmp_path / "all")
    [ref, *_] = all_of_them.job.source.objects(all_of_them.splits[0])
    median = int(np.median(make_rows(all_of_them.job, ref).columns["n_visible"]))
    made = plan(scannet, tmp_path / "again", min_visible=median)
    once = plan(scannet, tmp_path / "once", min_visible=median, attempts=1)
    manifest = build(once, InlineExecutor)
    assert len([f for f in manifest.failures if "view" in f]) > 3
    assert build(made, InlineExecutor).rows(made.splits[0]) == 30
    # A view that was accepted at once is the same in both.
    first, all_ten = make_rows(once.job, ref).columns, make_rows(made.job, ref).columns
    kept = np.isin(all_ten["view"], first["view"])
    np.testing.assert_array_equal(all_ten["row_sha256"][kept], first["row_sha256"])
    assert all_ten["view"].tolist() == list(range(10))
    # And a view does not depend on how many were asked for.
    fewer = make_rows(plan(scannet, tmp_path / "x", 4, min_visible=median).job, ref).columns
    np.testing.assert_array_equal(fewer["row_sha256"], all_ten["row_sha256"][:4])


def test_attempts_are_bounded_and_the_reason_recorded(scannet, tmp_path):
    job = plan(scannet, tmp_path / "out", views=2, attempts=5, max_back_facing=0, min_visible=1).job
    calls = []
    real = job.occluder.views

    def views(shape, poses, rngs):
        calls.append(len(poses))
        return [RejectedView(BACK_FACING, {"share": 1.0}) for _ in real(shape, poses, rngs)]

    job.occluder.views = views
    [ref, *_] = job.source.objects(next(iter(job.views)))
    rows = make_rows(job, ref)
    assert calls == [2] * 5
    assert rows.columns is None
    assert [f["reason"] for f in rows.failures] == [BACK_FACING] * 2
    assert rows.failures[0]["details"] == {"share": 1.0, "attempts": 5}


def test_official_lists_decide_and_rescans_apart_are_refused(tmp_path, things):
    entries = [write_scene(tmp_path, f"scene000{i}_00", things[:1]) for i in (1, 2)]
    path = write_annotations(tmp_path, entries)
    train, val = tmp_path / "scannetv2_train.txt", tmp_path / "scannetv2_val.txt"
    train.write_text("scene0002_00\n")
    source = ScanNetInstances(tmp_path, path, split_file=train)
    assert [r.location for r in source.objects("train")] == ["scene0002_00"]
    assert source.splits() == ("train",)
    val.write_text("scene0001_00\n")
    both = ScanNetInstances(tmp_path, path, split_file=[train, val])
    assert [r.location for r in both.objects("test")] == ["scene0001_00"]
    apart = tmp_path / "split.json"
    apart.write_text(json.dumps({"train": ["scene0001_00"], "test": ["scene0001_01"]}))
    with pytest.raises(InputError, match="scene0001_00 and scene0001_01"):
        ScanNetInstances(tmp_path, path, split_file=apart)
