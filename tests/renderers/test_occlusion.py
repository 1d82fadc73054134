"""Objects put before another: what they hide, held against a brute-force caster."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from partialbench.dataset.build import build
from partialbench.dataset.executors import InlineExecutor
from partialbench.dataset.loader import ShardDataset
from partialbench.dataset.others import Others, draw_others
from partialbench.dataset.render import plan_render
from partialbench.dataset.seeding import generator
from partialbench.dataset.sources import ObjectRef
from partialbench.dataset.verify import verify
from partialbench.errors import InputError
from partialbench.geometry.camera import Camera, sample_pose
from renderers import occlusion
from renderers.mitsuba_depth import MitsubaOccluder
from renderers.shapes.source import ParametricShapes
from renderers.sources.mesh import normalise
from tests.renderers.raycaster import cast

RESOLUTION = 32
TARGET = normalise(trimesh.creation.torus(1, 0.35, major_sections=24, minor_sections=12))
POOL = [
    normalise(trimesh.creation.box((1, 2, 3))),
    normalise(trimesh.creation.capsule(2, 0.3, count=(8, 8))),
    normalise(trimesh.creation.torus(1, 0.2, major_sections=16, minor_sections=8)),
]


def poses(count):
    return [sample_pose(generator(0, "occluded", k)) for k in range(count)]


def rngs(count, purpose="places"):
    return [generator(0, purpose, k) for k in range(count)]


def render(count, share=0.25, sensor="ideal", **options):
    renderer = MitsubaOccluder(RESOLUTION, occluders=share, sensor=sensor, **options)
    others = Others(POOL, rngs(count)) if share else None
    return renderer.views(TARGET, poses(count), rngs(count, "noise"), others)


def test_the_occluded_share_is_that_of_a_brute_force_caster(arranged):
    views = render(100)
    assert len(arranged) == 100
    for view, obstacles in zip(views, arranged, strict=True):
        camera = Camera(view.K, RESOLUTION, RESOLUTION)
        own = cast(
            TARGET.vertices, TARGET.faces, view.R_camera_object, view.t_camera_object, camera
        )
        nearest = np.full(own.depth.shape, np.inf)
        for each in obstacles:
            mesh = POOL[each.shape].copy()
            mesh.vertices = each.size * mesh.vertices @ each.R.T + each.t
            # An obstacle far aside may reach behind the camera; only what is before it is seen.
            mesh = mesh.slice_plane((0, 0, 1e-3), (0, 0, 1))
            depth = cast(mesh.vertices, mesh.faces, np.eye(3), np.zeros(3), camera).depth
            nearest = np.minimum(nearest, np.where(depth > 0, depth, np.inf))
        shown = own.depth > 0
        hidden = (shown & (nearest < own.depth)).sum() / shown.sum()
        # A pixel or two whose centre is within rounding of an edge.
        assert abs(view.occluded_fraction - hidden) <= 2.1 / shown.sum()
        assert len(view.points) == view.n_visible
        assert view.n_visible == pytest.approx((1 - hidden) * shown.sum(), abs=2.1)


@pytest.mark.parametrize("share", [0.25, 0.5])
def test_about_the_wanted_share_is_hidden(share):
    found = [view.occluded_fraction for view in render(60, share)]
    assert np.mean(found) == pytest.approx(share, abs=0.05)
    assert min(found) > 0.5 * share
    assert max(found) < 1.5 * share


def shares(renderer, distance, count=24):
    """What is hidden of objects straight ahead, all turned differently."""
    at = [(R, np.array([0, 0, distance])) for R, _ in poses(count)]
    views = renderer.views(TARGET, at, rngs(count), Others(POOL, rngs(count)))
    return np.array([view.occluded_fraction for view in views])


@pytest.mark.parametrize("distance", [8, 20])
def test_an_object_small_in_a_fixed_cameras_image_is_hidden_as_asked(distance):
    # 31 and 12 pixels across of 640×480, of which the coarse image has every fifteenth.
    camera = Camera(np.array([[120.0, 0, 320], [0, 120, 240], [0, 0, 1]]), 640, 480)
    found = shares(MitsubaOccluder(camera=camera, occluders=0.4), distance)
    assert found.mean() == pytest.approx(0.4, abs=0.06)
    assert found.min() > 0.15
    assert found.max() < 0.65


@pytest.mark.parametrize("distance", [1.15, 1.29, 1.31, 1.34, 1.5])
def test_so_is_one_whose_camera_is_near(distance):
    # At 1.3 the sum of the two cones' angles is a right one.
    found = shares(MitsubaOccluder(RESOLUTION, occluders=0.4), distance)
    assert found.mean() == pytest.approx(0.4, abs=0.06)
    assert found.min() > 0.2
    assert found.max() < 0.6


@pytest.mark.parametrize(("distance", "away", "size"), [(1.15, 0.09, 0.05), (1.31, 0.18, 0.115)])
def test_from_where_an_obstacle_is_pushed_in_it_hides_nothing(distance, away, size):
    aside = occlusion._reach(distance, away, size)
    # The edge of the ball's cone, from the camera: (cos, sin) of its half angle.
    half = np.arcsin(1 / distance)
    to_edge = aside * np.cos(half) - away * np.sin(half)
    assert to_edge == pytest.approx(size)


def test_obstacles_are_between_camera_and_object(arranged):
    views = render(40)
    for view, obstacles in zip(views, arranged, strict=True):
        centre = view.t_camera_object
        for each in obstacles:
            assert np.linalg.norm(each.t - centre) > 1 + each.size
            assert each.t @ centre > 0


def test_what_is_left_is_part_of_the_unoccluded_view():
    for whole, part in zip(render(20, 0.0), render(20, 0.4), strict=True):
        assert whole.occluded_fraction is None
        np.testing.assert_array_equal(whole.K, part.K)
        np.testing.assert_array_equal(whole.R_camera_object, part.R_camera_object)
        known = {tuple(p) for p in whole.points.tolist()}
        assert {tuple(p) for p in part.points.tolist()} < known
        assert part.visible_fraction < whole.visible_fraction
        lost = 1 - part.visible_fraction / whole.visible_fraction
        assert lost == pytest.approx(part.occluded_fraction, abs=0.15)


def test_a_sensor_sees_the_obstacles_too_and_draws_the_same_noise():
    for whole, part in zip(
        render(10, 0.0, "kinect-v1", keep_depth=True),
        render(10, 0.3, "kinect-v1", keep_depth=True),
        strict=True,
    ):
        both = (whole.depth > 0) & (part.depth > 0)
        assert both.sum() > 50
        # Away from the obstacle's edge a pixel measures what it measured.
        assert (whole.depth[both] == part.depth[both]).mean() > 0.9
        assert (part.depth > 0).sum() < (whole.depth > 0).sum()


def test_normals_stay_with_their_points():
    for view in render(8, 0.3, normals=True):
        assert view.normals.shape == view.points.shape
        assert ((view.normals * view.points).sum(axis=1) <= 1e-6).all()


def test_a_camera_at_the_object_has_no_room_before_it():
    camera = Camera(np.array([[32.0, 0, 16], [0, 32, 16], [0, 0, 1]]), 32, 32)
    renderer = MitsubaOccluder(camera=camera, occluders=0.25)
    pose = np.eye(3), np.array([0, 0, 1.05])
    (view,) = renderer.views(TARGET, [pose], rngs(1), Others(POOL, rngs(1)))
    assert view.reason == occlusion.NO_ROOM


@pytest.mark.parametrize("share", [-0.1, 0.95, 25, "0.2", True, None])
def test_an_impossible_share_is_refused(share):
    with pytest.raises(InputError, match=r"share of 0 to 0.9"):
        MitsubaOccluder(occluders=share)


def test_occluders_without_others_are_refused():
    with pytest.raises(InputError, match="needs others"):
        MitsubaOccluder(occluders=0.2).views(TARGET, poses(1), rngs(1))


# --- through the builder --------------------------------------------------------------------------


def folder(out, occluders, **options):
    chosen = {"resolution": RESOLUTION, **({"occluders": occluders} if occluders else {})}
    plan = plan_render(
        "pm40", out, splits=("test",), points=64, source_options={"counts": (1, 2)},
        objects_per_class=1, occluder_options=chosen, **options,
    )  # fmt: skip
    build(plan, InlineExecutor)
    return ShardDataset(out, "test", 64)


def test_rows_pair_with_the_unoccluded_ones(tmp_path):
    clear, before = folder(tmp_path / "clear", 0), folder(tmp_path / "before", 0.25)
    assert (clear.occluded_fraction == 0).all()
    assert before.occluded_fraction.mean() == pytest.approx(0.25, abs=0.06)
    names = [str(o) for o in before.object_ids]
    rows = [clear.object_ids.tolist().index(name) for name in names]
    assert len(names) > 30
    np.testing.assert_array_equal(clear.rotations[rows], before.rotations)
    np.testing.assert_array_equal(clear.intrinsics[rows], before.intrinsics)
    assert (before.n_visible < clear.n_visible[rows]).all()
    assert verify(tmp_path / "before", ParametricShapes((1, 2))).problems == []
    assert before.manifest.configuration["occluder"]["occluders"] == 0.25
    assert "occluders" not in clear.manifest.configuration["occluder"]


def test_a_source_of_clouds_takes_no_occluders(tmp_path):
    with pytest.raises(InputError, match=r"occluders=0.3 does not apply"):
        plan_render("pm40", tmp_path, setting="rotated", occluder_options={"occluders": 0.3})


class Some:
    """A source of three objects of which one cannot be read."""

    def objects(self, split):
        return [ObjectRef(name, 0, split, name) for name in "abc"]

    def load(self, ref):
        if ref.object_id == "b":
            raise InputError("broken")
        return ref.object_id


def test_others_are_other_objects_that_can_be_read():
    a, b, _ = Some().objects("test")
    assert set(draw_others(Some(), a, generator(0, "x"))) == {"c"}
    assert set(draw_others(Some(), b, generator(0, "x"))) == {"a", "c"}
    alone = Some()
    alone.objects = lambda split: [a]
    with pytest.raises(InputError, match="only object of the split 'test'"):
        draw_others(alone, a, generator(0, "x"))
    alone.objects = lambda split: [a, b]
    with pytest.raises(InputError, match="can be read"):
        draw_others(alone, a, generator(0, "x"))
