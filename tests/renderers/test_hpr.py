"""Hidden point removal against its definition, Open3D, and shapes whose visibility is known."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial import ConvexHull

from partialbench.errors import InputError
from partialbench.geometry.camera import sample_pose
from partialbench.geometry.rotations import haar_rotations
from renderers import hpr
from renderers.hpr import HprOccluder, flip, hidden_point_removal, paper_radius
from renderers.hull_cull import possible_vertices
from renderers.whole import WholeOccluder, sample_surface


def sphere(rng: np.random.Generator, count: int) -> np.ndarray:
    points = rng.standard_normal((count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def by_definition(points: np.ndarray, viewpoint: np.ndarray, radius: float) -> list[int]:
    """Extreme points of flipped ∪ {viewpoint}: a linear program finds no mixture of the others."""
    offsets = points - viewpoint
    norms = np.linalg.norm(offsets, axis=1, keepdims=True)
    flipped = np.vstack([offsets + 2 * (radius - norms) * offsets / norms, np.zeros(3)])
    found = []
    for i in range(len(points)):
        others = np.delete(flipped, i, axis=0)
        equalities = np.vstack([others.T / radius, np.ones(len(others))])
        target = np.append(flipped[i] / radius, 1)
        if linprog(np.zeros(len(others)), A_eq=equalities, b_eq=target).status == 2:  # infeasible
            found.append(i)
    return found


@pytest.mark.parametrize("gamma", [0.3, 1.0, 2.0])
def test_it_is_the_hull_of_the_flip(rng: np.random.Generator, gamma: float) -> None:
    points = rng.uniform(-1, 1, (40, 3))
    viewpoint = np.array([0.5, 2.0, -2.5])
    radius = paper_radius(points, viewpoint, gamma)
    visible = hidden_point_removal(points, viewpoint, radius)
    assert visible.tolist() == by_definition(points, viewpoint, radius)
    assert 0 < len(visible) < 40


def test_a_sphere_shows_the_cap_before_the_horizon(rng: np.random.Generator) -> None:
    """From distance d a unit sphere shows the points with p·v ≥ 1/d."""
    points, distance = sphere(rng, 4000), 3.0
    viewpoint = np.array([0.0, 0.0, distance])
    visible = hidden_point_removal(points, viewpoint, paper_radius(points, viewpoint, 2.0))
    seen = np.zeros(4000, bool)
    seen[visible] = True
    height = points[:, 2] - 1 / distance
    # Mean spacing of 4,000 points is 0.056: the boundary is blurred by about that.
    assert seen[height > 0.06].all()
    assert not seen[height < -0.25].any()


def test_a_plate_hides_what_is_behind_it(rng: np.random.Generator) -> None:
    front = np.column_stack([rng.uniform(-1, 1, (3000, 2)), np.zeros(3000)])
    behind = np.column_stack([rng.uniform(-0.5, 0.5, (500, 2)), np.full(500, -1.0)])
    visible = hidden_point_removal(np.vstack([front, behind]), [0, 0, 3], 300.0)
    assert visible.tolist() == list(range(3000))


@pytest.mark.open3d
@pytest.mark.parametrize("split", ["train", "test"])
def test_indices_equal_open3ds_on_real_clouds(shared: Path, split: str) -> None:
    o3d = pytest.importorskip("open3d", exc_type=ImportError)
    rng = np.random.default_rng(0)
    with h5py.File(shared / "data" / "modelnet40_aligned_1024.h5") as file:
        rows = np.sort(rng.choice(len(file[split]["points"]), 100, replace=False))
        codes = file[split]["points"][rows]
    for cloud in codes.transpose(0, 2, 1) / 4095 * 2 - 1:
        rotation, translation = sample_pose(rng)
        points = cloud @ rotation.T + translation
        radius = paper_radius(points, np.zeros(3), rng.uniform(0.1, 4))
        pcd = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        _, theirs = pcd.hidden_point_removal(np.zeros((3, 1)), radius)
        ours = hidden_point_removal(points, np.zeros(3), radius)
        np.testing.assert_array_equal(ours, np.sort(theirs))


@pytest.mark.open3d
def test_indices_equal_open3ds_on_a_real_scene(shared: Path) -> None:
    """A room seen from inside: directions all around, culled before the hull."""
    o3d = pytest.importorskip("open3d", exc_type=ImportError)
    scene = shared / "data/scannet/scans/scene0470_00/scene0470_00_vh_clean_2.ply"
    points = np.asarray(o3d.io.read_triangle_mesh(str(scene)).vertices)
    viewpoint = points.mean(axis=0) + np.array([0.013, 0.017, 0.3])
    radius = paper_radius(points, viewpoint, 2.0)
    pcd = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    _, theirs = pcd.hidden_point_removal(viewpoint[:, None], radius)
    np.testing.assert_array_equal(hidden_point_removal(points, viewpoint, radius), np.sort(theirs))


@pytest.mark.parametrize("gamma", [0.5, 2.0, 4.0])
@pytest.mark.parametrize("viewpoint", [(0.3, 0.5, -4.0), (0.01, 0.02, 0.03)])
@pytest.mark.parametrize("kind", ["sphere", "ball", "boxes", "grid"])
def test_culling_drops_no_hull_vertex(rng, kind: str, viewpoint, gamma: float) -> None:
    count = 6000
    points = {
        "sphere": lambda: sphere(rng, count),
        "ball": lambda: sphere(rng, count) * np.cbrt(rng.random((count, 1))),
        # Axis-parallel sheets, as of furniture: many points in planes and on lines.
        "boxes": lambda: np.where(
            np.arange(3) == rng.integers(0, 3, (count, 1)),
            rng.choice([-1.0, -0.4, 0.4, 1.0], (count, 1)),
            rng.uniform(-1, 1, (count, 3)),
        ),
        "grid": lambda: np.round(rng.uniform(-1, 1, (count, 3)), 1),
    }[kind]()
    points = np.unique(points[np.linalg.norm(points - viewpoint, axis=1) > 1e-3], axis=0)
    flipped = flip(points - viewpoint, paper_radius(points, viewpoint, gamma))
    kept = possible_vertices(flipped)
    hull = ConvexHull(np.vstack([flipped, np.zeros(3)])).vertices
    assert set(hull[hull < len(points)]) <= set(kept)
    if gamma < 4 and kind in ("sphere", "ball") and viewpoint[2] == -4.0:
        assert len(kept) < 0.75 * len(points)  # it does cull


def test_a_culled_cloud_has_the_same_visible_points(rng, monkeypatch) -> None:
    points = np.vstack([sphere(rng, 5000) * r for r in (1.0, 0.8, 0.5)])
    viewpoint = np.array([0.3, 0.5, -4.0])
    whole = hidden_point_removal(points, viewpoint, 400.0)
    monkeypatch.setattr(hpr, "CULL_FROM", 100)
    np.testing.assert_array_equal(hidden_point_removal(points, viewpoint, 400.0), whole)


def test_what_is_visible_does_not_depend_on_the_frame(rng: np.random.Generator) -> None:
    points, viewpoint = rng.uniform(-1, 1, (500, 3)), np.array([2.0, 1.0, 2.0])
    rotation, shift = haar_rotations(rng, 1)[0], rng.uniform(-3, 3, 3)
    moved = hidden_point_removal(points @ rotation.T + shift, viewpoint @ rotation.T + shift, 90.0)
    np.testing.assert_array_equal(moved, hidden_point_removal(points, viewpoint, 90.0))


def test_a_larger_radius_keeps_more(rng: np.random.Generator) -> None:
    points, viewpoint = rng.uniform(-1, 1, (1000, 3)), np.array([0.0, 0.0, 4.0])
    counts = [len(hidden_point_removal(points, viewpoint, r)) for r in (6, 60, 600, 6000, 60000)]
    assert counts == sorted(counts)
    assert counts[0] < 0.2 * 1000
    assert counts[-1] > 0.9 * 1000


# --- degenerate clouds ----------------------------------------------------------------------------


def test_one_point_and_two_points_are_visible() -> None:
    assert hidden_point_removal([[1, 2, 3]], [0, 0, 0], 50).tolist() == [0]
    assert hidden_point_removal([[1, 2, 3], [0, 1, 1]], [0, 0, 0], 50).tolist() == [0, 1]


def test_on_one_ray_the_nearest_is_visible_on_each_side() -> None:
    line = np.outer([3.0, 1.0, 2.0, -4.0, -2.0], [1.0, 2.0, -1.0])
    assert hidden_point_removal(line, [0, 0, 0], 100).tolist() == [1, 4]


def test_in_a_plane_with_the_viewpoint_the_hull_is_the_planes(rng: np.random.Generator) -> None:
    angles = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    circle = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(60)])
    viewpoint = np.array([3.0, 0, 0])
    expected = by_definition(circle, viewpoint, 30.0)
    assert set(np.flatnonzero(circle[:, 0] > 0.34)) <= set(expected)  # it shows x ≥ 1/3
    assert len(expected) < 30
    assert hidden_point_removal(circle, viewpoint, 30.0).tolist() == expected
    turn = haar_rotations(rng, 1)[0]
    turned = hidden_point_removal(circle @ turn.T, turn @ viewpoint, 30.0)
    assert turned.tolist() == expected


def test_a_coplanar_cloud_off_the_viewpoint_is_seen_whole(rng: np.random.Generator) -> None:
    plate = np.column_stack([rng.uniform(-1, 1, (200, 2)), np.zeros(200)])
    assert hidden_point_removal(plate, [0.2, 0.1, 3], 400).tolist() == list(range(200))


def test_of_equal_points_one_is_reported(rng: np.random.Generator) -> None:
    points = sphere(rng, 200)
    viewpoint = np.array([0.0, 0.0, 3.0])
    once = hidden_point_removal(points, viewpoint, 300.0)
    twice = hidden_point_removal(np.vstack([points, points]), viewpoint, 300.0)
    np.testing.assert_array_equal(np.sort(twice % 200), once)
    assert hidden_point_removal(np.ones((7, 3)), viewpoint, 300.0).tolist() == [0]


@pytest.mark.parametrize(
    ("points", "viewpoint", "radius", "message"),
    [
        (np.zeros((0, 3)), [0, 0, 3], 9, r"shape \(N,3\) with N ≥ 1, got \(0, 3\)"),
        (np.zeros((4, 2)), [0, 0, 3], 9, r"got \(4, 2\)"),
        ([[0, 0, 0], [0, np.nan, 0]], [0, 0, 3], 9, "1 of 2 points are not finite.*index 1"),
        ([[0, 0, 0]], [0, 0], 9, "viewpoint must be three finite numbers"),
        ([[0, 0, 0]], [0, 0, np.inf], 9, "viewpoint must be three finite numbers"),
        ([[1, 1, 1], [0, 0, 3]], [0, 0, 3], 9, "lies on point 1"),
        ([[0, 0, 0]], [0, 0, 3], 2.9, "radius 2.9 is less than the largest distance 3"),
        ([[0, 0, 0]], [0, 0, 3], np.nan, "radius nan is less than"),
        ([[0, 0, 0]], [0, 0, 3], np.inf, "radius inf"),
    ],
)
def test_errors_say_what_is_wrong(points, viewpoint, radius, message) -> None:
    with pytest.raises(InputError, match=message):
        hidden_point_removal(points, viewpoint, radius)


# --- the occluders --------------------------------------------------------------------------------


def test_the_occluder_sees_what_the_removal_sees(rng: np.random.Generator) -> None:
    cloud = (0.9 * sphere(rng, 800)).astype(np.float32)
    poses = [sample_pose(rng) for _ in range(3)]
    views = HprOccluder(gamma=1.5).views(cloud, poses, [rng] * 3)
    for view, (rotation, translation) in zip(views, poses, strict=True):
        viewpoint = -rotation.T @ translation
        radius = paper_radius(cloud, viewpoint, 1.5)
        expected = hidden_point_removal(cloud, viewpoint, radius)
        back = (view.points - translation) @ rotation
        np.testing.assert_allclose(back, cloud[expected], atol=2e-6)
        assert view.points.dtype == np.float32
        assert view.n_visible == len(expected)
        assert view.visible_fraction == pytest.approx(len(expected) / 800)
        assert not view.K.any()
        assert view.depth is None


def test_the_radius_may_be_absolute(rng: np.random.Generator) -> None:
    cloud = sphere(rng, 100)
    pose = (np.eye(3), np.array([0, 0, 3.0]))
    view = HprOccluder(radius=50.0).views(cloud, [pose], [rng])[0]
    assert view.n_visible == len(hidden_point_removal(cloud, [0, 0, -3], 50.0))
    assert HprOccluder(radius=50.0).describe() == {"name": "hpr", "radius": 50.0}
    assert HprOccluder().describe() == {"name": "hpr", "gamma": hpr.DEFAULT_GAMMA}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gamma": 1, "radius": 9}, "not both"),
        ({"gamma": -0.1}, "gamma must be a finite number ≥ 0, got -0.1"),
        ({"radius": 0}, "radius must be a finite number > 0, got 0"),
    ],
)
def test_the_occluders_options_are_checked(options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        HprOccluder(**options)


def test_a_mesh_is_refused_by_name(rng: np.random.Generator) -> None:
    trimesh = pytest.importorskip("trimesh")
    with pytest.raises(InputError, match="the shape is a mesh, expected an"):
        HprOccluder().views(trimesh.creation.box(), [(np.eye(3), np.ones(3))], [rng])


def test_whole_clouds_are_only_moved(rng: np.random.Generator) -> None:
    cloud = sphere(rng, 50).astype(np.float32)
    rotation, translation = sample_pose(rng)
    view = WholeOccluder().views(cloud, [(rotation, translation)], [rng])[0]
    np.testing.assert_allclose(view.points, cloud @ rotation.T + translation, atol=1e-6)
    assert (view.visible_fraction, view.n_visible) == (1.0, 50)


def test_whole_meshes_are_sampled_by_area(rng: np.random.Generator) -> None:
    import trimesh

    box = trimesh.creation.box((1.0, 2.0, 4.0))
    points = sample_surface(box, 20_000, rng)
    # Exactly one coordinate of a surface point is on its face.
    on_face = np.isclose(np.abs(points), [0.5, 1.0, 2.0])
    assert (on_face.sum(axis=1) == 1).all()
    shares = np.array([8.0, 4.0, 2.0]) / 14
    np.testing.assert_allclose(on_face.mean(axis=0), shares, atol=4 * np.sqrt(0.25 / 20_000))
    along = points[on_face[:, 0]] / [0.5, 1.0, 2.0]
    # Uniform on [−1, 1]: mean 0, variance 1/3.
    np.testing.assert_allclose(along[:, 1:].mean(axis=0), 0, atol=0.03)
    np.testing.assert_allclose(along[:, 1:].var(axis=0), 1 / 3, atol=0.02)


def test_a_mesh_without_area_cannot_be_sampled(rng: np.random.Generator) -> None:
    import trimesh

    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(InputError, match="no surface: 1 faces with a total area of 0"):
        sample_surface(flat, 10, rng)
