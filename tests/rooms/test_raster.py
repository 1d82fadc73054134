"""Depth and nearest surfaces, against what is known in closed form and against Embree."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from renderers.rooms.owners import nearest_surface, triangle_distance
from renderers.rooms.raster import depth_image

FOCAL, WIDTH, HEIGHT = 60.0, 64, 48


def pixel_rays() -> np.ndarray:
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    return np.stack([x / FOCAL, y / FOCAL, np.ones_like(x)], axis=-1)


def test_a_plane_that_reaches_behind_the_camera_has_its_exact_depth():
    """n·p = 1 with a floor's slope: depth is 1 / n·ray where that is in front."""
    normal = np.array([0.1, 0.8, 0.05])
    u, v = np.array([8.0, -1.0, 0]), np.array([0, -0.5, 8.0])
    foot = normal / (normal @ normal)
    corners = np.array([foot + 20 * s * u + 20 * t * v for s, t in ((-1, -1), (1, -1), (1, 1),
                                                                    (-1, 1))])  # fmt: skip
    depth = depth_image(corners[[[0, 1, 2], [0, 2, 3]]], FOCAL, WIDTH, HEIGHT)
    along = pixel_rays() @ normal
    expected = np.where(along > 1e-2, 1 / np.where(along > 1e-2, along, 1), 0)
    seen = expected > 0
    assert seen.any()
    assert (~seen).any()
    np.testing.assert_allclose(depth[seen], expected[seen], rtol=1e-12)


def test_no_ray_slips_between_triangles_and_the_nearest_counts():
    """A closed ball's front in fine triangles, a wall behind: no pixel of the ball shows the wall.

    Its vertices lie on rays of pixel centres as often as not.
    """
    ball = trimesh.creation.icosphere(4, 0.5)
    front = ball.vertices + [0, 0, 2.0]
    wall = np.array([[-9, -9, 4.0], [9, -9, 4.0], [9, 9, 4.0], [-9, 9, 4.0]])
    corners = np.concatenate([front[ball.faces], wall[[[0, 1, 2], [0, 2, 3]]]])
    depth = depth_image(corners, FOCAL, WIDTH, HEIGHT)
    rays = pixel_rays()
    # |s·ray − c|² = r²: the nearer root.
    a, b = (rays * rays).sum(-1), rays @ [0, 0, 2.0]
    square = b * b - a * (4 - 0.25)
    inside = square > 0.05
    exact = (b - np.sqrt(np.maximum(square, 0))) / a
    assert inside.sum() > 300
    np.testing.assert_allclose(depth[inside], exact[inside], atol=4e-3)
    np.testing.assert_allclose(depth[square < 0], 4.0, rtol=1e-12)


def test_an_edge_through_pixel_centres_belongs_to_both_sides():
    """Two triangles meet on the column of centres x = 0.5 px: neither leaves it empty."""
    x = 0.5 / FOCAL * 2
    left = [[-1, -1, 2], [x, -1, 2], [x, 1, 2.0]]
    right = [[x, -1, 2], [1, 1, 2], [x, 1, 2.0]]
    depth = depth_image(np.array([left, right], float), FOCAL, WIDTH, HEIGHT)
    column = depth[:, WIDTH // 2]
    np.testing.assert_allclose(column[HEIGHT // 2 - 20 : HEIGHT // 2 + 20], 2, rtol=1e-12)


def test_nothing_behind_the_camera_is_seen():
    behind = np.array([[[-1, -1, -2], [1, -1, -2], [0, 1, -2.0]]])
    assert not depth_image(behind, FOCAL, WIDTH, HEIGHT).any()


def test_distance_to_triangles_is_right(rng):
    mesh = trimesh.creation.box((1, 2, 3))
    points = rng.uniform(-3, 3, (200, 3))
    expected = np.linalg.norm(np.maximum(np.abs(points) - [0.5, 1, 1.5], 0), axis=1)
    outside = expected > 0
    found = triangle_distance(points[outside], mesh.triangles)
    np.testing.assert_allclose(found, expected[outside], atol=1e-12)


def test_owners_follow_exact_distances_where_embree_cannot_tell(rng):
    """Points half way between two plates, up to less than a micrometre: the sign decides."""
    o3d = pytest.importorskip("open3d", exc_type=ImportError)
    plate = np.array([[[-1, -1, 0], [1, -1, 0], [1, 1, 0]], [[-1, -1, 0], [1, 1, 0], [-1, 1, 0.0]]])
    surfaces = [plate, plate + [0, 0, 0.06]]
    off = rng.uniform(-1e-8, 1e-8, 500)
    points = np.column_stack([rng.uniform(-0.9, 0.9, (500, 2)), 0.03 + off])
    owner = nearest_surface(o3d, points, surfaces, 0.05)
    np.testing.assert_array_equal(owner, (points[:, 2] > 0.03).astype(int))
    far = points + [0, 0, 0.05 + 0.03 + 1e-7]
    assert set(nearest_surface(o3d, far, surfaces, 0.05)) == {-1}
