"""The camera: identities, and the ball's outline against brute force."""

import numpy as np
import pytest

from partialbench.geometry.camera import Camera, fit_ball, sample_pose


def test_unproject_undoes_project_and_the_other_way_round(rng):
    camera = Camera(np.array([[310.0, 0, 111], [0, 290, 87], [0, 0, 1]]), 240, 180)
    points = rng.uniform((-2, -2, 1), (2, 2, 6), (1000, 3))
    pixels, z = camera.project(points)
    assert np.abs(camera.unproject(pixels, z) - points).max() < 1e-12
    again, _ = camera.project(camera.unproject(pixels, z))
    assert np.abs(again - pixels).max() < 1e-10


def test_pixel_zero_has_its_centre_at_one_half():
    camera = Camera(np.array([[100.0, 0, 8], [0, 100, 8], [0, 0, 1]]), 16, 16)
    pixels, _ = camera.project(np.array([0.0, 0, 3]))
    assert pixels.tolist() == [8.0, 8.0], "the axis meets the corner between the middle pixels"
    depth = np.zeros((16, 16))
    depth[8, 9] = 2.0
    assert camera.unproject_depth(depth) == pytest.approx(np.array([[0.03, 0.01, 2.0]]))


def test_depth_round_trip_is_row_major(rng):
    camera = fit_ball((0.3, -0.2, 3.0), 12, height=9)
    depth = rng.uniform(2, 4, (9, 12)) * (rng.random((9, 12)) > 0.4)
    pixels, z = camera.project(camera.unproject_depth(depth))
    assert np.array_equal(z, depth[depth > 0])
    assert np.abs(pixels - camera.pixel_centres()[depth > 0]).max() < 1e-12


def test_points_behind_the_camera_have_no_pixel():
    camera = fit_ball((0, 0, 3), 8)
    pixels, z = camera.project(np.array([[0, 0, -1.0], [0, 0, 0.0]]))
    assert np.isnan(pixels).all()
    assert z.tolist() == [-1, 0]


@pytest.mark.parametrize("height", [None, 96, 200])
def test_the_ball_just_fits(rng, height):
    directions = rng.normal(size=(200_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for _ in range(10):
        _, t = sample_pose(rng)
        camera = fit_ball(t, 128, height=height)
        pixels, _ = camera.project(directions + t)
        low, high = pixels.min(0), pixels.max(0)
        size = np.array([camera.width, camera.height])
        assert (low > -1e-9).all()
        assert (high < size + 1e-9).all()
        assert (low + high) / 2 == pytest.approx(size / 2, abs=0.3)
        assert ((high - low) / size).max() == pytest.approx(1, abs=5e-3)


def test_pose_ranges_are_the_papers(rng):
    translations = np.stack([sample_pose(rng)[1] for _ in range(3000)])
    assert translations.min(0) == pytest.approx([-2, -2, 2], abs=0.02)
    assert translations.max(0) == pytest.approx([2, 2, 5], abs=0.02)


@pytest.mark.parametrize(
    ("K", "size", "message"),
    [
        (np.eye(2), (4, 4), "finite \\(3,3\\)"),
        (np.diag([0.0, 1, 1]), (4, 4), "focal lengths must be positive"),
        (np.array([[1.0, 0.1, 0], [0, 1, 0], [0, 0, 1]]), (4, 4), "no skew"),
        (np.eye(3), (0, 4), "image size must be positive, got 0×4"),
    ],
)
def test_impossible_cameras_are_refused(K, size, message):
    with pytest.raises(ValueError, match=message):
        Camera(K, *size)


def test_a_ball_around_the_camera_is_refused():
    with pytest.raises(ValueError, match="reaches behind the camera plane"):
        fit_ball((0, 0, 0.9), 64)
    with pytest.raises(ValueError, match="expected \\(64, 64\\)"):
        fit_ball((0, 0, 3), 64).unproject_depth(np.zeros((3, 3)))
