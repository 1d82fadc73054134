"""Rotations, bins and symmetry against closed forms, brute force and the released bins."""

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from partialbench.dataset.categories import MODELNET40, PS15, PS15_TO_PM40
from partialbench.geometry.bins import nearest_bins, rotation_bins
from partialbench.geometry.rotations import (
    axis_rotation,
    euler_noise,
    geodesic_angle,
    haar_rotations,
    is_rotation,
)
from partialbench.geometry.symmetry import CLASS_SYMMETRY, GROUPS, map_rotation, pose_error


def angle_cdf(angle):
    """Haar measure: the rotation angle has density (1 − cos θ)/π on [0, π]."""
    return (angle - np.sin(angle)) / np.pi


def test_haar_angles_follow_the_haar_law_and_euler_uniform_does_not(rng):
    angles = geodesic_angle(haar_rotations(rng, 20_000), np.eye(3))
    assert stats.kstest(angles, angle_cdf).pvalue > 0.01
    euler = Rotation.from_euler("zyx", rng.uniform(-np.pi, np.pi, (20_000, 3))).as_matrix()
    assert stats.kstest(geodesic_angle(euler, np.eye(3)), angle_cdf).pvalue < 1e-6


def test_haar_is_invariant_under_a_fixed_turn(rng):
    turned = axis_rotation("y", 1.1) @ haar_rotations(rng, 20_000)
    assert stats.kstest(turned[:, 2, 2], stats.uniform(-1, 2).cdf).pvalue > 0.01


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, np.pi - 1e-7, np.pi])
def test_geodesic_angle_keeps_its_precision_at_both_ends(angle):
    assert geodesic_angle(axis_rotation("x", angle), np.eye(3)) == pytest.approx(angle, abs=1e-15)


def test_geodesic_angle_equals_the_rotation_vector(rng):
    a, b = haar_rotations(rng, 500), haar_rotations(rng, 500)
    expected = (Rotation.from_matrix(a) * Rotation.from_matrix(b).inv()).magnitude()
    assert np.abs(geodesic_angle(a, b) - expected).max() < 1e-12


def test_euler_noise_is_rz_ry_rx_within_delta():
    noise = euler_noise(np.random.default_rng(3), 4, 0.7)
    a, b, c = np.random.default_rng(3).uniform(-0.7, 0.7, (4, 3)).T
    product = axis_rotation("z", c) @ axis_rotation("y", b) @ axis_rotation("x", a)
    assert np.abs(noise - product).max() < 1e-12


def test_is_rotation_rejects_reflections_scalings_and_nan(rng):
    good = haar_rotations(rng, 3)
    assert is_rotation(good).all()
    bad = np.stack([np.diag([1.0, 1, -1]), 1.01 * np.eye(3), np.full((3, 3), np.nan)])
    assert not is_rotation(bad).any()


def test_bins_are_a_group_of_sixty_with_the_identity_first(rng):
    bins = rotation_bins()
    assert np.array_equal(bins[0], np.eye(3))
    assert is_rotation(bins, 1e-12).all()
    products = np.einsum("aij,bjk->abik", bins, bins).reshape(-1, 3, 3)
    nearest = nearest_bins(products)[:, 0]
    assert np.abs(products - bins[nearest]).max() < 1e-12
    assert (np.bincount(nearest, minlength=60) == 60).all()


def test_bins_are_the_released_ones_in_order(shared):
    released = np.load(shared / "parity" / "papnet_40.npz")["rotation_bins"]
    assert np.abs(rotation_bins() - released).max() < 1e-12


def test_nearest_bins_equal_brute_force_and_cover_so3(rng):
    rotations = haar_rotations(rng, 4000)
    angles = geodesic_angle(rotations[:, None], rotation_bins())
    order = np.argsort(angles, axis=1)[:, :4]
    assert np.array_equal(nearest_bins(rotations, 4), order)
    means = np.degrees(np.sort(angles, axis=1)[:, :4].mean(0))
    assert means == pytest.approx([29.6, 46.9, 53.8, 58.1], abs=0.5)
    with pytest.raises(ValueError, match="between 1 and 60, got 61"):
        nearest_bins(rotations, 61)


def brute_force_group(name):
    """The group's elements, independently: a fine grid for the continuous one."""
    if name == "z-inf":
        return Rotation.from_euler("z", np.linspace(0, 2 * np.pi, 3601)[:-1, None]).as_matrix()
    return GROUPS[name].elements


@pytest.mark.parametrize("name", list(GROUPS))
def test_map_is_the_argmin_over_the_whole_group(name, rng):
    rotations = haar_rotations(rng, 300)
    mapped = map_rotation(rotations, GROUPS[name])
    candidates = rotations[:, None] @ np.swapaxes(brute_force_group(name), -1, -2)
    best = geodesic_angle(candidates, np.eye(3)).min(1)
    found = geodesic_angle(mapped, np.eye(3))
    assert np.abs(found - best).max() < (2e-3 if name == "z-inf" else 1e-9)
    assert (found <= best + 1e-9).all()
    assert np.abs(map_rotation(mapped, GROUPS[name]) - mapped).max() < 1e-9, "idempotent"


def test_sequential_flips_are_not_the_argmin(rng):
    """The release's X, Y, Z-180 one after the other: wrong for 8.5 % of rotations (facts)."""
    rotations = haar_rotations(rng, 20_000)
    one_by_one = rotations
    for axis in "xyz":
        one_by_one = map_rotation(one_by_one, GROUPS[f"{axis}-180"])
    excess = geodesic_angle(one_by_one, np.eye(3)) - geodesic_angle(
        map_rotation(rotations, GROUPS["xyz-180"]), np.eye(3)
    )
    assert (excess > 1e-6).mean() == pytest.approx(0.085, abs=0.008)


@pytest.mark.parametrize("name", list(GROUPS))
def test_equivalent_poses_map_alike_and_have_no_error(name, rng):
    rotations = haar_rotations(rng, 200)
    elements = brute_force_group(name)
    other = rotations @ elements[rng.integers(0, len(elements), 200)]
    assert pose_error(other, rotations, GROUPS[name]).max() < 1e-7
    mapped = map_rotation(other, GROUPS[name])
    assert np.abs(mapped - map_rotation(rotations, GROUPS[name])).max() < 1e-7


@pytest.mark.parametrize("name", list(GROUPS))
def test_pose_error_equals_brute_force(name, rng):
    predicted, true = haar_rotations(rng, 200), haar_rotations(rng, 200)
    brute = geodesic_angle(predicted[:, None], true[:, None] @ brute_force_group(name)).min(1)
    error = pose_error(predicted, true, GROUPS[name])
    assert np.abs(error - brute).max() < (1e-3 if name == "z-inf" else 1e-12)
    assert error.max() > 0.5


def test_symmetry_table_is_the_papers():
    """Ids by group as the release lists them (PM40)."""
    ids = {g: {i for i, n in enumerate(MODELNET40) if CLASS_SYMMETRY.get(n) == g} for g in GROUPS}
    assert ids["z-inf"] == {5, 6, 9, 10, 15, 19, 26, 32, 37}
    assert ids["xyz-180"] == {4, 11, 13, 14, 16, 18, 27, 38, 39}
    assert ids["y-180"] == {17}
    assert ids["z-180"] == {1, 23, 33, 34, 36}


def test_shared_classes_are_the_releases():
    assert PS15_TO_PM40 == {
        0: 1, 1: 2, 2: 8, 3: 12, 4: 14, 5: 19, 6: 22, 7: 23, 9: 4, 10: 29, 11: 30, 13: 33, 14: 35,
    }  # fmt: skip
    assert len(PS15) == 15
