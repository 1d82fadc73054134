"""Scanned objects put before another: what they hide, held against a brute-force caster."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from partialbench.dataset.build import build
from partialbench.dataset.executors import InlineExecutor
from partialbench.dataset.loader import ShardDataset
from partialbench.dataset.others import Others
from partialbench.dataset.render import plan_render
from partialbench.dataset.rows import make_rows
from partialbench.dataset.seeding import generator
from partialbench.dataset.sources import FEW_POINTS
from partialbench.errors import InputError
from partialbench.geometry.camera import sample_pose
from renderers.sources.scannet.occluder import ScanHprOccluder
from renderers.sources.scannet.source import ScanNetInstances
from tests.scannet.scenes import CHAIR, TABLE, Thing, write_annotations, write_scene


@pytest.fixture
def folder(tmp_path):
    """A scan of two chairs and a table with few faces, and one of a chair alone."""
    furnished = [
        Thing("chair", CHAIR, (0.5, 0.55, 0.9), (-1.5, -1.2), yaw=0.7, detail=3),
        Thing("chair", CHAIR, (0.5, 0.5, 0.8), (1.4, 1.1), yaw=-2.1, detail=3),
        Thing("table", TABLE, (0.8, 1.4, 0.7), (0.2, -0.4), yaw=0.2, detail=3),
    ]
    alone = [Thing("chair", CHAIR, (0.6, 0.6, 0.9), (0, 0), detail=3)]
    scenes = [
        write_scene(tmp_path, "scene0001_00", furnished),
        write_scene(tmp_path, "scene0002_00", alone),
    ]
    write_annotations(tmp_path, scenes)
    return tmp_path


@pytest.fixture
def source(folder):
    splits = {"scene0001_00": "train", "scene0002_00": "train"}
    return ScanNetInstances(folder, folder / "full_annotations.json", split_file=splits)


def rngs(count, purpose="places"):
    return [generator(0, purpose, k) for k in range(count)]


def poses(count):
    return [sample_pose(rng) for rng in rngs(count, "pose")]


def crosses(points, corners):
    """Which segments from the origin to (n,3) points meet one of (f,3,3) triangles, in float64.

    Source: Möller and Trumbore, "Fast, Minimum Storage Ray/Triangle Intersection", 1997.
    """
    a, b, c = corners.transpose(1, 0, 2)
    u, v = b - a, c - a
    way = points[:, None]
    across = np.cross(way, v)
    scale = (across * u).sum(axis=2)
    scale = np.where(np.abs(scale) < 1e-14, np.nan, scale)
    first = -(across * a).sum(axis=2) / scale
    beside = np.cross(-a, u)
    second = (way * beside).sum(axis=2) / scale
    along = (v * beside).sum(axis=1) / scale
    inside = (first >= 0) & (second >= 0) & (first + second <= 1)
    return (inside & (along > 0) & (along < 1)).any(axis=1)


def test_the_occluded_share_is_that_of_a_brute_force_caster(source, arranged):
    *shapes, target = [source.load(ref) for ref in source.objects("train")[:3]]
    count = 100
    rules = {"min_visible": 1, "max_back_facing": 1, "max_isolated": 1}
    whole = ScanHprOccluder(rules=rules).views(target, poses(count), rngs(count))
    others = Others(shapes, rngs(count))
    found = ScanHprOccluder(rules=rules, occluders=0.3).views(
        target, poses(count), rngs(count), others
    )
    pairs = list(zip(whole, found, strict=True))
    assert len(arranged) == count
    distinct = len(np.unique(target.points, axis=0))
    for (clear, view), obstacles in zip(pairs, arranged, strict=True):
        points = clear.points.astype(np.float64)
        hidden = np.zeros(len(points), bool)
        for each in obstacles:
            mesh = shapes[each.shape]
            corners = (each.size * mesh.points.astype(np.float64) @ each.R.T + each.t)[mesh.faces]
            hidden |= crosses(points, corners)
        # A point whose line passes within rounding of an edge.
        assert abs(view.occluded_fraction - hidden.mean()) <= 2.1 / len(points)
        assert (
            view.n_visible == len(view.points) == round((1 - view.occluded_fraction) * len(points))
        )
        assert view.visible_fraction == pytest.approx(view.n_visible / distinct)
        np.testing.assert_array_equal(view.R_camera_object, clear.R_camera_object)
        kept = {tuple(point) for point in view.points.tolist()}
        assert kept <= {tuple(point) for point in clear.points.tolist()}
    share = np.array([view.occluded_fraction for _, view in pairs])
    assert share.mean() == pytest.approx(0.3, abs=0.05)
    assert share.min() > 0.1
    assert share.max() < 0.5


def test_a_vertex_that_is_there_once_for_each_face_counts_once(source):
    shape = source.load(source.objects("train")[0])
    once = np.unique(shape.points, axis=0, return_index=True)[1]
    shape = replace(shape, points=shape.points[once], normals=shape.normals[once])
    soup = replace(
        shape, points=np.tile(shape.points, (3, 1)), normals=np.tile(shape.normals, (3, 1))
    )
    occluder = ScanHprOccluder(rules={"max_back_facing": 1, "max_isolated": 1})
    plain, repeated = occluder.views(shape, poses(3), []), occluder.views(soup, poses(3), [])
    for one, other in zip(plain, repeated, strict=True):
        assert 0.2 < one.visible_fraction < 0.9
        assert (one.visible_fraction, one.n_visible) == (other.visible_fraction, other.n_visible)


def render(folder, out, occluders=0.0, **rules):
    plan = plan_render(
        "ps15", out, views=4, points=64, normals=True,
        source_options={"scannet": folder, "scan2cad": folder / "full_annotations.json",
                        "rules": {"min_visible": 40, **rules}},
        occluder_options={"occluders": occluders} if occluders else {},
    )  # fmt: skip
    build(plan, InlineExecutor)
    return plan, {split: ShardDataset(out, split, 64) for split in plan.splits}


def test_rows_pair_with_the_unoccluded_ones(folder, tmp_path):
    _, clear = render(folder, tmp_path / "clear")
    plan, before = render(folder, tmp_path / "before", 0.25)
    assert "occluders" not in next(iter(clear.values())).manifest.configuration["occluder"]
    rows = 0
    for split, shown in before.items():
        whole = clear[split]
        assert shown.occluders == 0.25
        where = {(str(o), int(v)): i for i, (o, v) in enumerate(
            zip(whole.object_ids, whole.views, strict=True))}  # fmt: skip
        pair = [where[str(o), int(v)] for o, v in zip(shown.object_ids, shown.views, strict=True)]
        np.testing.assert_array_equal(shown.rotations, whole.rotations[pair])
        np.testing.assert_allclose(
            shown.n_visible, (1 - shown.occluded_fraction) * whole.n_visible[pair], atol=1e-3
        )
        assert shown.occluded_fraction.mean() == pytest.approx(0.25, abs=0.1)
        rows += len(shown)
    assert rows == 16
    described = plan.job.occluder.describe()
    assert described["occluders"] == 0.25
    assert described["variant"] in ("cuda_ad_rgb", "llvm_ad_rgb", "scalar_rgb")


def test_what_occluders_leave_too_little_of_is_not_drawn_again(folder, tmp_path):
    """Another pose would pair with no row."""
    _, clear = render(folder, tmp_path / "clear")
    most = min(int(part.n_visible.min()) for part in clear.values())
    plan, before = render(folder, tmp_path / "before", 0.1, min_visible=most)
    refs = [ref for split in plan.splits for ref in plan.job.source.objects(split)]
    failures = [failure for ref in refs for failure in make_rows(plan.job, ref).failures]
    assert failures
    for failure in failures:
        assert failure["reason"] == FEW_POINTS
        assert failure["details"]["visible"] < most
        assert "attempts" not in failure["details"]
    assert 0 < sum(map(len, before.values())) == 16 - len(failures)


def test_what_stands_before_an_object_is_of_its_own_scan_if_there_is_any(source):
    refs = source.objects("train")
    own = [ref for ref in refs if ref.location == "scene0001_00"]
    assert [ref.object_id for ref in source.beside(own[0])] == [r.object_id for r in own[1:]]
    (alone,) = [ref for ref in refs if ref.location == "scene0002_00"]
    assert source.beside(alone) == own


def test_faces_are_of_the_scans_own_surface(source):
    for ref in source.objects("train"):
        shape = source.load(ref)
        assert shape.faces.max() < len(shape.points)
        corners = shape.points[shape.faces].astype(np.float64)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        mean = shape.normals[shape.faces].sum(axis=1)
        assert ((normals * mean).sum(axis=1) > 0).mean() > 0.95


def test_what_cannot_be_is_said(source):
    target = source.load(source.objects("train")[0])
    with pytest.raises(InputError, match=r"share of 0 to 0.9"):
        ScanHprOccluder(occluders=25)
    with pytest.raises(InputError, match="variant 'scalar_rgb' does not apply"):
        ScanHprOccluder(variant="scalar_rgb")
    with pytest.raises(InputError, match="needs other scanned objects"):
        ScanHprOccluder(occluders=0.2).views(target, poses(1), rngs(1))
