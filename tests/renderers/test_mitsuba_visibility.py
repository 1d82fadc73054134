"""The share of the surface that a viewpoint sees."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from partialbench.dataset.seeding import generator
from partialbench.geometry.camera import sample_pose
from renderers.mitsuba_depth import MitsubaOccluder
from renderers.sources.mesh import normalise
from renderers.visibility import inside_image, sight_lines, surface_samples
from tests.renderers.raycaster import segments_clear


def fraction(mesh: trimesh.Trimesh, t: list[float], R: np.ndarray | None = None) -> float:
    pose = (np.eye(3) if R is None else R, np.array(t))
    (view,) = MitsubaOccluder(resolution=16).views(mesh, [pose], [])
    return view.visible_fraction  # type: ignore[union-attr]


@pytest.mark.parametrize("t", [[0, 0, 2.0], [1.5, -2, 3], [0, 0, 5], [13, -20, 43]])
def test_of_a_sphere_a_cap_is_seen(t: list[float]) -> None:
    # From distance d the visible cap of a unit sphere has height 1 − 1/d of its diameter 2.
    sphere = normalise(trimesh.creation.icosphere(subdivisions=5))
    expected = (1 - 1 / np.linalg.norm(t)) / 2
    assert fraction(sphere, t) == pytest.approx(expected, abs=0.005)


def test_of_a_cube_one_two_or_three_faces_are_seen() -> None:
    cube = normalise(trimesh.creation.box((1, 1, 1)))
    side = 1 / np.sqrt(3)  # half the edge
    assert fraction(cube, [0, 0, 3]) == pytest.approx(1 / 6, abs=0.002)
    assert fraction(cube, [2 * side, 0, 3]) == pytest.approx(2 / 6, abs=0.002)
    assert fraction(cube, [2 * side, 2 * side, 3]) == pytest.approx(3 / 6, abs=0.002)


def test_of_a_sheet_everything_is_seen_from_both_sides_and_doubled() -> None:
    square = [[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
    faces = [[0, 1, 2], [0, 2, 3]]
    turned = np.diag([1.0, -1, -1])
    for doubled in (faces, faces + [face[::-1] for face in faces]):
        sheet = normalise(trimesh.Trimesh(square, doubled, process=False, validate=False))
        assert fraction(sheet, [0.5, 0.5, 3]) == 1
        assert fraction(sheet, [0.5, 0.5, 3], turned) == 1


def test_a_plate_hides_the_one_behind_it() -> None:
    # Two equal parallel squares, the eye on their axis: the far one lies in the near one's shadow.
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 0.3
    near, far = square - np.array([0, 0, 0.5]), square + np.array([0, 0, 0.5])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    mesh = trimesh.Trimesh(
        np.vstack([near, far]), np.vstack([faces, faces + 4]), process=False, validate=False
    )
    assert fraction(mesh, [0, 0, 3]) == pytest.approx(0.5, abs=0.001)


@pytest.mark.parametrize("name", ["torus", "annulus", "soup"])
def test_each_sample_is_seen_as_by_brute_force(name: str) -> None:
    soup = np.random.default_rng(3).normal(size=(90, 3))
    mesh = normalise(
        {
            "torus": lambda: trimesh.creation.torus(1, 0.3),
            "annulus": lambda: trimesh.creation.annulus(0.5, 1, 0.3),
            "soup": lambda: trimesh.Trimesh(soup, np.arange(90).reshape(30, 3), process=False),
        }[name]()
    )
    vertices = np.asarray(mesh.vertices, np.float32)
    samples = surface_samples(vertices, mesh.faces.astype(np.uint32), 1000)
    occluder = MitsubaOccluder(resolution=16, visibility_samples=1000)
    for k in range(3):
        R, t = sample_pose(generator(0, "visibility", name, k))
        (view,) = occluder.views(mesh, [(R, t)], [])
        eye = -R.T @ t
        directions, ends = sight_lines(samples, eye)
        clear = segments_clear(
            vertices[mesh.faces].astype(float), eye, directions.astype(float), ends.astype(float)
        )
        # Two samples in a thousand may lie within rounding of an outline.
        assert view.visible_fraction == pytest.approx(clear.mean(), abs=0.0021)


def test_samples_share_out_by_area_and_lie_on_the_surface() -> None:
    # A square of side 3 and one of side 1, cut along different diagonals.
    vertices = np.array(
        [[0, 0, 0], [3, 0, 0], [3, 3, 0], [0, 3, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]],
        np.float32,
    )
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 7], [5, 6, 7], [4, 4, 6]], np.uint32)
    samples = surface_samples(vertices, faces, 1000)
    assert samples.dtype == np.float32
    large = samples[samples[:, 2] == 0]
    small = samples[samples[:, 2] == 1]
    assert len(large) + len(small) == 1000
    assert abs(len(large) - 900) <= 1
    assert large[:, :2].min() >= 0
    assert large[:, :2].max() <= 3
    # Uniform on the square: each cell of a 5×5 grid gets its 25th part, far closer than chance
    # would bring it (a standard deviation of 6).
    counts, _, _ = np.histogram2d(large[:, 0], large[:, 1], bins=5, range=[[0, 3], [0, 3]])
    assert np.abs(counts - len(large) / 25).max() <= 5
    np.testing.assert_array_equal(samples, surface_samples(vertices, faces, 1000))


def test_a_surface_without_area_is_refused() -> None:
    with pytest.raises(ValueError, match="no area: 1 faces"):
        surface_samples(np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.uint32), 10)


def test_segments_end_just_before_their_sample() -> None:
    samples = np.array([[0, 0, 3], [4, 0, 0]], np.float32)
    directions, ends = sight_lines(samples, np.array([0.0, 0, 1]))
    np.testing.assert_allclose(directions, [[0, 0, 2], [4, 0, -1]])
    gap = (1 - ends.astype(float)) * np.linalg.norm(directions, axis=1)
    np.testing.assert_allclose(gap, 1e-4, rtol=2e-3)


def test_inside_image_counts_the_border_once_and_nothing_behind() -> None:
    K = np.array([[10.0, 0, 5], [0, 10, 4], [0, 0, 1]])
    points = np.array([[-0.5, -0.4, 1], [0.5, 0, 1], [0.49, 0.39, 1], [0, 0.4, 1], [0, 0, -1]])
    np.testing.assert_array_equal(inside_image(points, K, 10, 8), [True, False, True, False, False])
