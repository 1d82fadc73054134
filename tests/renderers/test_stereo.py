"""The rendered stereo sensors: what they measure, and what they refuse."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import trimesh

from benchmarks.stereo import (
    DISTANCES_M,
    camera_of,
    errors,
    fattening,
    filled,
    lowered,
    quad,
    spread,
)
from partialbench.dataset.others import Others
from partialbench.dataset.seeding import generator
from partialbench.dataset.sources import RejectedView
from partialbench.errors import InputError
from partialbench.geometry.camera import Camera, sample_pose
from renderers import stereo
from renderers.mitsuba_depth import MitsubaOccluder
from renderers.sensors import make_sensor
from renderers.sources.mesh import normalise
from renderers.variants import activate, pick_variant

pytest.importorskip("cv2")
SENSORS = ("stereo-d415", "stereo-kinect-v1")
TORUS = normalise(trimesh.creation.torus(1, 0.4))


@pytest.fixture(autouse=True)
def vectorised():
    """Mitsuba as these sensors need it."""
    variant = pick_variant()
    if variant.startswith("scalar"):
        pytest.skip("no vectorised Mitsuba variant here")
    activate(variant, 1)


def views(sensor, count=2, resolution=64, others=None, seed=0, **options):
    renderer = MitsubaOccluder(resolution, keep_depth=True, sensor=sensor, **options)
    poses = [sample_pose(generator(0, "stereo", k)) for k in range(count)]
    rngs = [generator(seed, "noise", k) for k in range(count)]
    return renderer.views(TORUS, poses, rngs, others)


@pytest.mark.parametrize("name", SENSORS)
def test_a_view_is_measured_about_where_it_is_and_the_same_again(name):
    exact, measured, again = views("ideal"), views(name), views(name)
    for one, other, same in zip(exact, measured, again, strict=True):
        np.testing.assert_array_equal(other.depth, same.depth)
        both = (one.depth > 0) & (other.depth > 0)
        assert not (other.depth[one.depth == 0] > 0).any()
        assert both.sum() > 0.9 * (one.depth > 0).sum()
        error = np.abs(other.depth - one.depth)[both]
        # σ is about 3.5 mm·z², and a unit half a metre.
        z_m = 0.5 * np.linalg.norm(one.t_camera_object)
        assert np.median(error) < 0.007 * z_m**2
        assert np.median(error) > 0.0005
    other_noise = views(name, seed=1)
    assert not np.array_equal(measured[0].depth, other_noise[0].depth)


@pytest.mark.parametrize("name", SENSORS)
def test_a_strength_makes_it_worse_in_proportion(name):
    def error(spec):
        pairs = zip(views("ideal", 3), views(spec, 3), strict=True)
        found = [np.abs(o.depth - e.depth)[(e.depth > 0) & (o.depth > 0)] for e, o in pairs]
        return float(np.median(np.concatenate(found)))

    assert error(f"{name}:2") > 1.4 * error(name)


def test_obstacles_are_in_its_images_and_not_in_its_points():
    pool = [normalise(trimesh.creation.box((1, 2, 3)))]
    clear = views("stereo-d415", 3)
    before = views(
        "stereo-d415", 3, others=Others(pool, [generator(k, "o") for k in range(3)]), occluders=0.3
    )
    for one, other in zip(clear, before, strict=True):
        assert (other.depth > 0).sum() < (one.depth > 0).sum()
        assert 0.1 < other.occluded_fraction < 0.5


def test_edges_are_fattened_and_grazing_surfaces_lost():
    sensor = stereo.d415()
    assert 0.5 < fattening(sensor) < 4
    assert filled(sensor, 0) > 0.95
    assert filled(sensor, 85) < 0.7
    assert filled(sensor, 80, albedo=0.03) < filled(sensor, 80) - 0.15


def test_slanted_surfaces_are_measured_at_their_place_but_for_what_the_docs_say():
    sensor = stereo.d415()
    assert 0.5 < lowered(sensor) < 1.2
    # Across the image there is no such lag: both cameras' pixels are where the rays are.
    left, right = (errors(sensor, 1.1, 2, a).mean() for a in (30, -30))
    slope = 1.1 / sensor.focal * np.tan(np.deg2rad(30))
    assert abs(left - right) / 2 / slope < 0.3


def test_a_part_of_an_object_is_dark_from_one_side_on():
    vertices, faces = TORUS.vertices, TORUS.faces
    for k in range(5):
        light, dark = stereo._split((vertices, faces), 0.3, generator(0, "dark", k))
        assert len(light[1]) + len(dark[1]) == len(faces)
        assert 0 < len(dark[1]) < len(light[1])
    light, dark = stereo._split((vertices, faces), 0.0, generator(0, "dark"))
    assert (len(light[1]), len(dark[1])) == (len(faces), 0)


@pytest.mark.slow
@pytest.mark.parametrize("make", [stereo.d415, stereo.kinect_v1])
def test_the_spread_grows_with_the_square_of_the_distance(make):
    sigma = np.array([spread(make(), distance)[0] for distance in DISTANCES_M])
    square = np.square(DISTANCES_M)
    law = (sigma * square).sum() / (square**2).sum() * square
    np.testing.assert_allclose(sigma, law, rtol=0.15)


def test_the_images_do_not_hang_on_the_number_of_threads():
    sensor = stereo.d415()
    found = []
    for threads in (1, 2):
        activate(pick_variant(), threads)
        found.append(
            sensor.measure(
                [(quad(1.2, 0.1), 0.4)], camera_of(sensor, 64), (0.9, 1.6), generator(0, "t")
            )
        )
    for one, two in zip(*found, strict=True):
        np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize("t", [(0, 0, 1.1), (0, 0, 0.9), (0.5, 0, 0.5)])
def test_what_is_too_near_is_turned_away_before_its_image_outgrows_memory(t):
    camera = Camera(np.array([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]), 16, 16)
    occluder = MitsubaOccluder(camera=camera, sensor="stereo-d415")
    pose = (np.eye(3), np.array(t, float))
    (view,) = occluder.views(trimesh.creation.icosphere(2), [pose], [np.random.default_rng(0)])
    assert isinstance(view, RejectedView)
    assert view.reason.startswith("nearer than 1.25 units")


def test_what_it_cannot_do_is_said(monkeypatch):
    with pytest.raises(InputError, match="renders its own images of meshes"):
        make_sensor("stereo-d415").apply(np.ones((4, 4)), np.eye(3), generator(0))
    with pytest.raises(InputError, match="scalar_rgb is too slow"):
        MitsubaOccluder(sensor="stereo-d415", variant="scalar_rgb").describe()
    with pytest.raises(InputError, match="strength must be a finite number"):
        make_sensor("stereo-d415:0")
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(InputError, match=r"pip install 'partialbench\[stereo\]'"):
        MitsubaOccluder(sensor="stereo-kinect-v1")
