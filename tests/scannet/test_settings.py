"""PS15 in the three settings: whose poses, whose symmetry."""

from __future__ import annotations

import pytest

from partialbench.dataset.build import BuildPlan, build
from partialbench.dataset.executors import InlineExecutor
from partialbench.dataset.rows import Job
from partialbench.dataset.shards import read_columns
from renderers.sources.scannet.occluder import ScanHprOccluder
from renderers.sources.scannet.source import ScanNetInstances
from renderers.whole import WholeOccluder
from tests.scannet.scenes import CHAIR, Thing, write_annotations, write_scene


def test_every_setting_keeps_the_instances_symmetry_and_rotated_has_all_rotations(tmp_path, things):
    chair = Thing("chair", CHAIR, (0.5, 0.5, 0.8), (1.4, 1.1), sym="__SYM_ROTATE_UP_4")
    write_annotations(tmp_path, [write_scene(tmp_path, "scene0001_00", [things[0], chair])])
    source = ScanNetInstances(tmp_path, tmp_path / "full_annotations.json", "standing")
    split = source.splits()[0]
    rows = {}
    for setting, occluder in (
        ("partial", ScanHprOccluder()), ("rotated", WholeOccluder()), ("aligned", WholeOccluder()),
    ):  # fmt: skip
        out = tmp_path / setting
        job = Job(source, occluder, "ps15", setting, {split: 40}, 64, 0)
        build(BuildPlan(job, out, (split,)), InlineExecutor)
        rows[setting] = read_columns(out / f"{split}-00000.h5")
        of = dict(zip(rows[setting]["object_id"], rows[setting]["symmetry"], strict=True))
        assert of == {b"scene0001_00/0": b"none", b"scene0001_00/1": b"z-90"}, setting
    # Where the object's up points in the image: a person holds the camera upright (y is down).
    up = {setting: r["R_camera_object"][:, 1, 2] for setting, r in rows.items()}
    assert up["partial"].max() < -0.4
    assert (up["rotated"] > 0).mean() == pytest.approx(0.5, abs=0.15)
