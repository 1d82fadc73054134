"""Normals: of the surface at exactly the points of a view, turned to the camera, unit length."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from partialbench.dataset.sources import OrientedCloud
from partialbench.errors import InputError
from partialbench.geometry.camera import Camera, sample_pose
from renderers.hpr import HprOccluder
from renderers.mitsuba_depth import MitsubaOccluder
from renderers.normals import face_normals, plane_normals, towards_camera, unit_normals
from renderers.whole import WholeOccluder

VARIANTS = ("auto", "scalar_rgb")


def box() -> trimesh.Trimesh:
    """Inside the unit ball; its faces lie where one coordinate is at its bound."""
    return trimesh.creation.box((1.0, 0.8, 0.6))


def box_normals(points: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """Of the box's face that each object-frame point lies on, on the eye's side."""
    axis = np.argmin(np.abs(np.abs(points) - [0.5, 0.4, 0.3]), axis=1)
    side = np.sign(points[np.arange(len(points)), axis])
    normals = np.zeros_like(points)
    normals[np.arange(len(points)), axis] = side
    # Nothing but the outside of a box is seen from without.
    assert ((eye - points) * normals).sum(axis=1).min() > -1e-3
    return normals


def poses(count: int, rng: np.random.Generator) -> list:
    return [sample_pose(rng) for _ in range(count)]


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("flipped", [False, True])
def test_a_rendered_boxs_normals_are_its_faces(variant, flipped, rng) -> None:
    mesh = box()
    if flipped:
        mesh.invert()
    # 50 is no multiple of the tracer's tile; a sensor of its own size cuts nothing here.
    occluder = MitsubaOccluder(50, variant, normals=True)
    for view in occluder.views(mesh, poses(4, rng), []):
        R, t = view.R_camera_object, view.t_camera_object
        back = (view.points - t) @ R
        assert view.normals.shape == view.points.shape
        assert view.normals.dtype == np.float32
        # Points on an edge of the box, where two faces are as near, are left out.
        gaps = np.sort(np.abs(np.abs(back) - [0.5, 0.4, 0.3]), axis=1)
        clear = gaps[:, 1] > 1e-3
        assert clear.mean() > 0.9
        expected = box_normals(back[clear], -R.T @ t) @ R.T
        np.testing.assert_allclose(view.normals[clear], expected, atol=1e-6)
        assert ((view.normals * view.points).sum(axis=1) < 0).all()


@pytest.mark.parametrize("variant", VARIANTS)
def test_pixels_that_a_sensor_loses_take_their_normals_with_them(variant, rng) -> None:
    camera = Camera(np.array([[60.0, 0, 25], [0, 60, 22], [0, 0, 1]]), 50, 44)
    made = {}
    for sensor in ("ideal", "kinect-v1"):
        occluder = MitsubaOccluder(
            camera=camera, variant=variant, sensor=sensor, normals=True, keep_depth=True
        )
        pose = (np.eye(3), np.array([0.2, 0.1, 3.0]))
        [made[sensor]] = occluder.views(box(), [pose], [np.random.default_rng(0)])
    exact, noisy = made["ideal"], made["kinect-v1"]
    left = noisy.depth[exact.depth > 0] > 0
    assert 0.3 < left.mean() < 0.98, "some pixels are lost"
    np.testing.assert_array_equal(noisy.normals, exact.normals[left])


def test_without_normals_a_view_is_the_same(rng) -> None:
    at = poses(2, rng)
    for occluder in (MitsubaOccluder, HprOccluder, WholeOccluder):
        shape = box() if occluder is MitsubaOccluder else box().sample(500, seed=0)
        rngs = [np.random.default_rng(0)] * 2
        plain = occluder().views(shape, at, rngs)
        rich = occluder(normals=True).views(shape, at, rngs)
        for a, b in zip(plain, rich, strict=True):
            np.testing.assert_array_equal(a.points, b.points)
            assert a.normals is None
            assert b.normals.shape == b.points.shape
        assert "normals" not in occluder().describe()
        assert occluder(normals=True).describe()["normals"]


def test_a_clouds_own_normals_are_taken_and_turned(rng) -> None:
    """A sphere whose normals point inwards: seen from without they are turned out."""
    points = rng.normal(size=(800, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    cloud = OrientedCloud(points.astype(np.float32), -points.astype(np.float32))
    for occluder in (HprOccluder(normals=True), WholeOccluder(normals=True)):
        [view] = occluder.views(cloud, poses(1, rng), [rng])
        back = (view.points - view.t_camera_object) @ view.R_camera_object
        turned = view.normals @ view.R_camera_object
        assert np.abs((back * turned).sum(axis=1)) == pytest.approx(1, abs=1e-5)
        assert ((view.normals * view.points).sum(axis=1) <= 1e-6).all()
    with pytest.raises(InputError, match="expected one normal a point"):
        HprOccluder(normals=True).views(
            OrientedCloud(cloud.points, cloud.normals[:9]), poses(1, rng), [rng]
        )


def test_a_whole_meshs_normals_are_its_faces(rng) -> None:
    [view] = WholeOccluder(300, normals=True).views(box(), poses(1, rng), [rng])
    back = (view.points - view.t_camera_object) @ view.R_camera_object
    axis = np.argmin(np.abs(np.abs(back) - [0.5, 0.4, 0.3]), axis=1)
    turned = view.normals @ view.R_camera_object
    np.testing.assert_allclose(np.abs(turned), np.eye(3)[axis], atol=1e-5)
    assert ((view.normals * view.points).sum(axis=1) <= 1e-6).all()


def test_planes_are_those_of_least_squares(rng) -> None:
    points = rng.normal(size=(300, 3)) * [1, 0.7, 0.2]
    found = plane_normals(points, 10)
    for k in range(0, 300, 30):
        near = points[np.argsort(np.linalg.norm(points - points[k], axis=1))[:10]]
        expected = np.linalg.svd(near - near.mean(axis=0))[2][2]
        assert abs(found[k] @ expected) == pytest.approx(1, abs=1e-9)


def test_a_spheres_planes_are_tangents(rng) -> None:
    points = rng.normal(size=(4000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    slant = np.degrees(np.arccos(np.abs((plane_normals(points) * points).sum(axis=1)).clip(0, 1)))
    assert np.median(slant) < 3
    repeated = plane_normals(np.repeat(points, 20, axis=0))
    np.testing.assert_array_equal(repeated[::20], plane_normals(points))


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_a_handful_of_points_has_unit_normals(count, rng) -> None:
    normals = plane_normals(rng.normal(size=(count, 3)))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-12)
    line = plane_normals(np.outer(np.arange(20.0), [1, 2, 3]))
    np.testing.assert_allclose(line @ [1, 2, 3], 0, atol=1e-9)


def test_gaps_in_a_sources_normals_are_filled_from_the_plane(rng) -> None:
    points = np.column_stack([rng.normal(size=(50, 2)), np.zeros(50)])
    own = np.tile([0.0, 0.0, 3.0], (50, 1))
    own[7], own[9] = 0, np.nan
    filled = unit_normals(own, points)
    np.testing.assert_allclose(np.abs(filled), np.tile([0, 0, 1], (50, 1)), atol=1e-12)


def test_faces_without_area_have_no_normal_and_others_the_corners_order() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]], np.float32)
    normals = face_normals(vertices, np.array([[0, 1, 2], [0, 2, 1], [0, 1, 3]]))
    np.testing.assert_array_equal(normals, [[0, 0, 1], [0, 0, -1], [0, 0, 0]])


def test_turning_to_the_camera() -> None:
    at = np.array([[0, 0, 2.0], [0, 0, 2.0]])
    turned = towards_camera(np.array([[0, 0, 1.0], [0, 0.6, -0.8]]), at)
    np.testing.assert_allclose(turned, [[0, 0, -1], [0, 0.6, -0.8]], atol=1e-7)
