"""Sensor models against their published statistics, on planes whose geometry is known exactly."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.stats import norm

from partialbench import render_view
from partialbench.dataset.seeding import generator
from partialbench.errors import InputError
from partialbench.geometry.camera import Camera, look_at
from renderers.depth_images import displaced, edges, incidence_angle, projector_shadow
from renderers.sensors import SENSORS, STRENGTHS, KinectV1, TimeOfFlight, make_sensor

SIZE = 300
K = np.array([[585.0, 0, SIZE / 2], [0, 585.0, SIZE / 2], [0, 0, 1]])


def plane(z_m: float, tilt_deg: float = 0.0) -> np.ndarray:
    """z-depth in metres of a plane through (0, 0, z), turned about the camera's y axis."""
    columns = np.indices((SIZE, SIZE))[1]
    normal = np.array([np.sin(np.deg2rad(tilt_deg)), 0, np.cos(np.deg2rad(tilt_deg))])
    x = (columns + 0.5 - K[0, 2]) / K[0, 0]
    return normal[2] * z_m / (normal[0] * x + normal[2])


def two_steps() -> np.ndarray:
    """A near square before a far one before nothing, metres."""
    z = np.zeros((60, 60))
    z[5:55, 5:55] = 2.0
    z[20:40, 20:40] = 1.5
    return z


@pytest.mark.parametrize("tilt", [0.0, 30.0, 60.0])
def test_incidence_is_the_angle_between_normal_and_ray(tilt: float) -> None:
    measured = incidence_angle(plane(2.0, tilt), K)
    rows, columns = np.indices((SIZE, SIZE))
    rays = np.stack([(columns + 0.5 - K[0, 2]) / K[0, 0], (rows + 0.5 - K[1, 2]) / K[1, 1],
                     np.ones((SIZE, SIZE))], axis=-1)  # fmt: skip
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    normal = np.array([np.sin(np.deg2rad(tilt)), 0, np.cos(np.deg2rad(tilt))])
    np.testing.assert_allclose(measured, np.arccos(np.clip(rays @ normal, 0, 1)), atol=1e-6)


def test_incidence_does_not_look_across_an_edge() -> None:
    focal = np.array([[585.0, 0, 30], [0, 585.0, 30], [0, 0, 1]])
    angles = incidence_angle(two_steps(), focal)
    # Both squares face the camera: the angle is that of the ray alone, at most 30·√2/585.
    assert angles.max() < 30 * np.sqrt(2) / 585 + 1e-9


def test_edges_are_the_outlines_of_both_squares() -> None:
    expected = np.zeros((60, 60), bool)
    outline = np.ones((50, 50), bool)
    outline[1:-1, 1:-1] = False
    expected[5:55, 5:55] |= outline
    inner = np.ones((20, 20), bool)
    inner[1:-1, 1:-1] = False
    expected[20:40, 20:40] |= inner
    expected[19, 20:40] = expected[40, 20:40] = expected[20:40, 19] = expected[20:40, 40] = True
    np.testing.assert_array_equal(edges(two_steps(), 0.03), expected)


def test_the_projector_shadow_has_the_width_of_the_disparity_step() -> None:
    z = np.full((4, 200), 2.0)
    z[:, 120:160] = 1.0
    focal = np.array([[400.0, 0, 100], [0, 400.0, 2], [0, 0, 1]])
    shadow = projector_shadow(z, focal, 0.075)
    # Disparity 400·0.075/z: 30 px near, 15 px far. Far columns [105, 120) fall behind the near.
    expected = np.zeros(z.shape, bool)
    expected[:, 105:120] = True
    np.testing.assert_array_equal(shadow, expected)
    assert not projector_shadow(z, focal, 0.0).any()


@pytest.mark.parametrize("tilt", [0.0, 40.0, 75.0])
def test_a_displaced_ray_stays_at_its_depth_on_a_slanted_plane(
    tilt: float, rng: np.random.Generator
) -> None:
    z = plane(1.0, tilt)
    # Up to 3 px, which at 75° is 2 cm of depth a pixel.
    np.testing.assert_array_equal(displaced(z, rng.uniform(-3, 3, (2, SIZE, SIZE)), 0.03), z)


def test_a_displaced_ray_takes_the_depth_across_an_edge() -> None:
    z = two_steps()
    right = np.zeros((2, 60, 60))
    right[1] = 1.0
    # Everything is as if moved one pixel to the left; the last column falls onto itself.
    np.testing.assert_array_equal(displaced(z, right, 0.03)[:, :-1], z[:, 1:])
    np.testing.assert_array_equal(displaced(z, 0.4 * right, 0.03), z)


@pytest.mark.parametrize(("z_m", "tilt"), [(1.0, 0.0), (1.0, 50.0), (1.0, 70.0), (2.0, 70.0)])
@pytest.mark.parametrize("name", ["kinect-v1", "tof"])
def test_all_noise_together_spreads_depth_on_slanted_planes_as_the_cited_fit(
    name: str, z_m: float, tilt: float
) -> None:
    """Lateral noise included: in units of the fit's σ at each pixel, the spread is 1."""
    quiet = {"baseline_m": 0.0, "edge_dropout": 0.0} if name == "kinect-v1" else {}
    # At 70° a pixel at 2 m is 9 mm of depth; no edge on the plane itself.
    sensor = make_sensor(name, metres_per_unit=1.0, **quiet)
    z = plane(z_m, tilt)
    theta = incidence_angle(z, K)
    grazing = (theta / (np.pi / 2 - theta)) ** 2
    if name == "kinect-v1":
        sigma = 0.0012 + 0.0019 * (z - 0.4) ** 2
        sigma += np.where(theta < np.deg2rad(10), 0, 1e-4 / np.sqrt(z) * grazing)
    else:
        sigma = 1e-3 * (1.5 - 0.5 * z + 0.3 * z**2 + 0.1 * z**1.5 * grazing)
    measured = sensor.apply(z, K, generator(0, "slant", name, z_m, tilt))
    inside = np.abs(z / z_m - 1) < 0.2
    assert np.std(((measured - z) / sigma)[inside]) == pytest.approx(1, rel=0.03)


@pytest.mark.parametrize("strength", STRENGTHS)
@pytest.mark.parametrize(("z_m", "tilt"), [(0.8, 0.0), (1.5, 0.0), (3.0, 0.0), (1.5, 50.0)])
def test_the_kinects_spread_is_nguyens(z_m: float, tilt: float, strength: float) -> None:
    sensor = KinectV1(strength=strength, baseline_m=0.0, lateral_px=0.0, metres_per_unit=1.0)
    z = plane(z_m, tilt)
    inside = np.abs(z / z_m - 1) < 0.03
    theta = np.deg2rad(tilt)
    grazing = 1e-4 / np.sqrt(z_m) * (theta / (np.pi / 2 - theta)) ** 2
    expected = strength * (0.0012 + 0.0019 * (z_m - 0.4) ** 2 + (grazing if tilt >= 10 else 0))
    measured = sensor.apply(z, K, generator(0, "kinect", z_m, tilt))
    assert (measured > 0).all()
    # z and θ vary over the region by 3 % and 0.26 rad of ray; the model's σ by less than 5 %. The
    # remaining lateral term, 0.035·θ/(π/2 − θ) px, adds under 1 % here.
    assert np.std((measured - z)[inside]) == pytest.approx(expected, rel=0.07)
    assert np.mean((measured - z)[inside]) == pytest.approx(0, abs=0.05 * expected)


def test_the_kinects_levels_are_equal_steps_of_inverse_depth(rng: np.random.Generator) -> None:
    measured = KinectV1(metres_per_unit=0.5).apply(plane(2.0, 40.0) / 0.5, K, rng).astype(float)
    levels = 1 / (measured[measured > 0] * 0.5 * 2.85e-3)
    np.testing.assert_allclose(levels, np.rint(levels), rtol=3e-7)
    # At 2 m neighbouring levels are 2.85e-3·z² = 11.4 mm apart.
    metres = np.unique(0.5 * measured[measured > 0])
    at_two = np.searchsorted(metres, 2.0)
    assert metres[at_two] - metres[at_two - 1] == pytest.approx(0.0114, rel=0.01)


@pytest.mark.parametrize("focal", [585.0, 292.5])
def test_the_kinects_lateral_noise_is_in_its_own_pixels(focal: float) -> None:
    """A pixel whose centre is half a pixel from an outline crosses it in Φ(−1/2σ) of all cases."""
    k = np.array([[focal, 0, 20], [0, focal, 500], [0, 0, 1]])
    z = np.full((1000, 40), 2.0)
    z[:, :20] = 1.0
    sensor = KinectV1(baseline_m=0.0, metres_per_unit=1.0, edge_dropout=0.0)
    measured = sensor.apply(z, k, generator(0, "edge"))
    sigma = 0.8 * focal / 585  # sensor pixels to image pixels
    crossed = np.mean(measured[:, 19] > 1.5)
    expected = norm.cdf(-0.5 / sigma)
    assert crossed == pytest.approx(expected, abs=4 * np.sqrt(expected / 1000))


def test_kinect_pixels_at_edges_drop_out_at_the_stated_rate() -> None:
    z = np.zeros((400, 400))
    z[::4, :] = 1.0  # every surface pixel has an empty neighbour
    sensor = KinectV1(metres_per_unit=1.0, baseline_m=0.0, lateral_px=0.0)
    measured = sensor.apply(z, K, generator(0, "edges"))
    assert np.mean(measured[::4] == 0) == pytest.approx(0.3, abs=4 * np.sqrt(0.21 / 40_000))


@pytest.mark.parametrize("strength", STRENGTHS)
@pytest.mark.parametrize(("z_m", "tilt"), [(0.8, 0.0), (2.0, 0.0), (4.0, 0.0), (2.0, 60.0)])
def test_the_time_of_flight_spread_is_fankhausers(z_m: float, tilt: float, strength: float) -> None:
    sensor = TimeOfFlight(strength=strength, metres_per_unit=1.0, lateral_m=0.0)
    z = plane(z_m, tilt)
    inside = np.abs(z / z_m - 1) < 0.03
    theta = np.deg2rad(tilt)
    grazing = 0.1 * z_m**1.5 * (theta / (np.pi / 2 - theta)) ** 2
    expected = strength * 1e-3 * (1.5 - 0.5 * z_m + 0.3 * z_m**2 + grazing)
    measured = sensor.apply(z, K, generator(0, "tof", z_m, tilt))
    tolerance = 0.05 if tilt == 0 else 0.1
    assert np.std((measured - z)[inside]) == pytest.approx(expected, rel=tolerance)


def test_flying_pixels_lie_between_the_two_surfaces_and_only_at_their_edge() -> None:
    z = np.full((200, 200), 2.0)
    z[:, 100:] = 1.5
    sensor = TimeOfFlight(metres_per_unit=1.0, lateral_m=0.0)
    measured = sensor.apply(z, K, generator(0, "flying"))
    flying = np.abs(measured - z) > 0.02  # σ is 1.7 mm
    assert not np.delete(flying, [99, 100], axis=1).any()
    between = measured[:, 99:101]
    assert between.min() > 1.5 - 0.02
    assert between.max() < 2.0 + 0.02
    # Half of the 400 fly; of those 1 in 25 happens to land within 2 cm of its own surface.
    assert flying.sum() == pytest.approx(0.5 * 400 * 0.96, abs=4 * np.sqrt(100))


def test_multipath_is_off_by_default_and_only_lengthens() -> None:
    z = plane(2.0)
    z[150, 150] = 1.99
    k = {"metres_per_unit": 1.0, "lateral_m": 0.0}
    off = TimeOfFlight(**k).apply(z, K, generator(0, "multipath"))
    on = TimeOfFlight(**k, multipath=0.5).apply(z, K, generator(0, "multipath"))
    assert on[150, 150] - off[150, 150] == pytest.approx(0.5 * 0.01 * 8 / 9, rel=0.01)
    assert (on - off).min() >= -1e-6


@pytest.mark.parametrize("name", [name for name in SENSORS if not name.startswith("stereo")])
def test_every_sensor_keeps_empty_pixels_empty_and_is_seeded(name: str) -> None:
    sensor = make_sensor(name)
    depth = np.stack([two_steps(), two_steps()]) / 0.5
    first = sensor.apply(depth, K, generator(0, name))
    assert first.dtype == np.float32
    assert first.shape == depth.shape
    assert (first[depth == 0] == 0).all()
    assert (first > 0).mean() > 0.5 * (depth > 0).mean()
    np.testing.assert_array_equal(first, sensor.apply(depth, K, generator(0, name)))
    if name == "ideal":
        np.testing.assert_array_equal(first, depth.astype(np.float32))
    else:
        assert not np.array_equal(first, sensor.apply(depth, K, generator(1, name)))
        assert not np.array_equal(first[0], first[1])


@pytest.mark.parametrize("name", ["kinect-v1", "tof"])
def test_nothing_out_of_range_is_measured(name: str, rng: np.random.Generator) -> None:
    sensor = make_sensor(name, metres_per_unit=1.0)
    for z_m in (0.4, 6.0):
        assert (sensor.apply(plane(z_m), K, rng) == 0).all()


@pytest.mark.parametrize("name", ["kinect-v1", "tof"])
def test_a_view_out_of_a_sensors_range_says_so(name: str) -> None:
    # 12 units are 6 m; the camera itself sees the box there.
    box = trimesh.creation.box((1, 1, 1))
    assert len(render_view(box, look_at((0, -12, 0))).points) == 1024
    with pytest.raises(InputError, match=rf"sensor measures nothing.*{name}, from 11\.\d+, to 1"):
        render_view(box, look_at((0, -12, 0)), sensor=name)
    aside = Camera(np.array([[50.0, 0, 0], [0, 50, 0], [0, 0, 1]]), 8, 8)
    with pytest.raises(InputError, match="no surface at any pixel centre"):
        render_view(box, (np.eye(3), (-2, 0, 3)), sensor=name, camera=aside)


def test_a_stack_takes_one_camera_or_one_each(rng: np.random.Generator) -> None:
    depth = np.stack([plane(1.0), plane(2.0)])
    sensor = make_sensor("kinect-v1", metres_per_unit=1.0)
    shared = sensor.apply(depth, K, generator(0))
    each = sensor.apply(depth, np.stack([K, K]), generator(0))
    np.testing.assert_array_equal(shared, each)
    with pytest.raises(InputError, match=r"K must have the shape"):
        sensor.apply(depth, np.stack([K, K, K]), rng)


def test_make_sensor_reads_a_strength() -> None:
    assert make_sensor("tof:0.5") == TimeOfFlight(strength=0.5)
    assert make_sensor("kinect-v1").describe()["strength"] == 1.0


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("kinect", "did you mean kinect-v1"),
        ("kinect-v1:much", "is no number"),
        ("tof:0", "strength must be a finite number > 0"),
        ("tof:nan", "strength must be"),
        ("ideal:2", "does not take this"),
        ("", "no sensor named ''"),
    ],
)
def test_make_sensor_says_what_is_wrong(spec: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        make_sensor(spec)


@pytest.mark.parametrize("bad", [-1.0, np.nan, np.inf])
def test_depth_must_be_finite_and_not_negative(bad: float, rng: np.random.Generator) -> None:
    z = plane(1.0)
    z[3, 4] = bad
    with pytest.raises(InputError, match="finite and ≥ 0"):
        make_sensor("tof").apply(z, K, rng)
