"""Damaged test clouds: what each kind does, and that it hangs on nothing but its arguments."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial import cKDTree

from partialbench.benchmark.records import results
from partialbench.benchmark.run import run_eval
from partialbench.benchmark.testing import damage
from partialbench.benchmark.testing.damage import KINDS, STRENGTHS, DamagedClouds, damaged
from partialbench.errors import InputError
from tests.benchmark.memory_clouds import MemoryClouds
from tests.benchmark.tiny_models import MODELS, SMALL

CLOUDS = MemoryClouds(objects=8, num_points=256)
KEY = ("chair_0001", 0)


def apart(one, other):
    """Chamfer distance: mean distance to the nearest point of the other, both ways."""
    return cKDTree(other).query(one)[0].mean() + cKDTree(one).query(other)[0].mean()


def of(kind, strength, row=0, points=256):
    cloud = CLOUDS.points([row])[0][:points]
    key = (str(CLOUDS.object_ids[row]), int(CLOUDS.views[row]))
    return cloud, damaged(cloud, f"{kind}:{strength}", key, CLOUDS.rotations[row])


def normalised(cloud, reference):
    """Both in the reference's normalised frame."""
    centre = reference.astype(float).mean(axis=0)
    return (cloud - centre) / np.linalg.norm(reference - centre, axis=1).max()


@pytest.mark.parametrize("kind", KINDS)
def test_strength_0_is_the_identity_and_more_is_farther_away(kind):
    rows = range(0, len(CLOUDS), 2)
    cloud, same = of(kind, 0)
    np.testing.assert_array_equal(same, cloud)
    assert same is not cloud
    distances = [np.mean([apart(*of(kind, s, row)) for row in rows]) for s in STRENGTHS]
    assert distances[0] > 0
    assert (np.diff(distances) > 0).all(), distances


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_a_function_of_seed_key_damage_and_strength(kind):
    cloud, one = of(kind, 3)
    _, again = of(kind, 3)
    np.testing.assert_array_equal(one, again)
    assert one.dtype == np.float32
    rotation = CLOUDS.rotations[0]
    if kind == "quantisation":  # draws nothing
        return
    for key, seed in ((("chair_0001", 1), 0), (("chair_0002", 0), 0), (KEY, 1)):
        other = damaged(cloud, f"{kind}:3", key, rotation, seed)
        assert not np.array_equal(other, damaged(cloud, f"{kind}:3", KEY, rotation))


@pytest.mark.parametrize("kind", KINDS)
def test_all_clouds_of_one_size_stay_of_one_size(kind):
    clouds = DamagedClouds(CLOUDS, f"{kind}:5")
    batch = clouds.points(np.arange(12))
    np.testing.assert_array_equal(batch[7], of(kind, 5, 7)[1])
    assert len(clouds) == len(CLOUDS)
    assert clouds.digest == CLOUDS.digest


@pytest.mark.parametrize(
    ("kind", "sizes"),
    [
        ("drop-global", [192, 160, 128, 96, 64]),
        ("drop-local", [231, 206, 181, 156, 131]),
        ("add-global", [258, 261, 264, 266, 268]),
        ("add-local", [281, 306, 331, 356, 381]),
        ("uneven-density", [230, 205, 179, 154, 128]),
        ("jitter", [256] * 5),
    ],
)
def test_as_many_points_as_modelnet_c_of_its_1024(kind, sizes):
    assert [len(of(kind, s)[1]) for s in STRENGTHS] == sizes


@pytest.mark.parametrize("kind", ["drop-global", "drop-local", "uneven-density"])
def test_what_is_left_are_points_of_the_cloud(kind):
    cloud, left = of(kind, 4)
    known = {tuple(p) for p in cloud.tolist()}
    assert {tuple(p) for p in left.tolist()} <= known


def test_jitter_has_modelnet_cs_spread():
    found = np.concatenate(
        [normalised(b, a) - normalised(a, a) for a, b in (of("jitter", 4, r) for r in range(12))]
    )
    assert found.std() == pytest.approx(0.04, rel=0.05)


def test_scale_is_along_the_objects_axes_within_modelnet_cs_range():
    for row in range(8):
        cloud, scaled = of("scale", 5, row)
        before, after = (normalised(c, cloud) @ CLOUDS.rotations[row] for c in (cloud, scaled))
        factors = after.std(axis=0) / before.std(axis=0)
        np.testing.assert_allclose(after, before * factors, atol=1e-5)
        assert (factors >= 0.5 - 1e-4).all()
        assert (factors <= 2 + 1e-4).all()


def test_a_turn_is_about_the_line_of_sight_by_36_degrees_at_most():
    angles = []
    for row in range(12):
        cloud, turned = of("rotate-about-view", 5, row)
        sight = cloud.astype(float).mean(axis=0)
        sight /= np.linalg.norm(sight)
        before, after = normalised(cloud, cloud), normalised(turned, cloud)
        np.testing.assert_allclose(before @ sight, after @ sight, atol=1e-5)
        across = [p - (p @ sight)[:, None] * sight for p in (before, after)]
        cosine = (across[0] * across[1]).sum() / (across[0] ** 2).sum()
        angles.append(np.degrees(np.arccos(min(1, cosine))))
    assert max(angles) <= 30.01
    assert max(angles) > 15


def test_added_points_are_inside_the_ball():
    for kind in ("add-global", "add-local"):
        cloud, more = of(kind, 5)
        np.testing.assert_array_equal(more[:256], cloud)
        assert np.linalg.norm(normalised(more, cloud), axis=1).max() < 1 + 1e-5


def test_flying_pixels_move_along_their_rays_from_the_outline():
    cloud, flown = of("flying-pixels", 5)
    moved = (cloud != flown).any(axis=1)
    assert moved.sum() == round(0.2 * 256)
    away = flown[moved] - cloud[moved]
    rays = cloud[moved] / np.linalg.norm(cloud[moved], axis=1, keepdims=True)
    np.testing.assert_allclose(np.linalg.norm(np.cross(away, rays), axis=1), 0, atol=1e-5)
    assert ((away * rays).sum(axis=1) > 0).all()
    image = cloud[:, :2] / cloud[:, 2:]
    from_centre = np.linalg.norm(image - image.mean(axis=0), axis=1)
    assert from_centre[moved].mean() > 1.2 * from_centre[~moved].mean()


def test_quantised_distances_are_whole_steps():
    cloud, coarse = of("quantisation", 4)
    centre = cloud.astype(float).mean(axis=0)
    step = 0.08 * np.linalg.norm(cloud - centre, axis=1).max()
    steps = np.linalg.norm(coarse.astype(float), axis=1) / step
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-3)


def test_far_points_are_thinned_most():
    shares = []
    for row in range(12):
        cloud, left = of("uneven-density", 5, row)
        far = np.median(np.linalg.norm(cloud, axis=1))
        shares.append((np.linalg.norm(left, axis=1) > far).sum() / 128)
    assert np.mean(shares) == pytest.approx(0.27, abs=0.08)


def test_a_cloud_moved_to_the_origin_is_seen_along_z():
    cloud = CLOUDS.points([0])[0] - [0, 0, 3]
    for kind in KINDS:
        assert np.isfinite(damaged(cloud, f"{kind}:5", KEY, np.eye(3))).all()
    coarse = damaged(cloud, "quantisation:5", KEY, np.eye(3))
    np.testing.assert_array_equal(coarse[:, :2], cloud.astype(np.float32)[:, :2])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("cloud", [np.zeros((1, 3)), np.tile([[0.1, 0.2, 3]], (9, 1))])
def test_a_cloud_of_one_place_survives(kind, cloud):
    assert np.isfinite(damaged(cloud, f"{kind}:5", KEY, np.eye(3))).all()


def test_the_figures_are_the_same_on_every_machine():
    found = {kind: float(np.abs(of(kind, 3)[1].astype(float)).sum()) for kind in KINDS}
    assert found == pytest.approx(GOLDEN, rel=1e-5)


GOLDEN = {
    "scale": 860.4914,
    "jitter": 889.1364,
    "rotate-about-view": 888.8468,
    "drop-global": 448.7805,
    "drop-local": 643.3786,
    "add-global": 920.5729,
    "add-local": 1140.6735,
    "flying-pixels": 929.5782,
    "quantisation": 888.9324,
    "uneven-density": 596.5532,
}


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.zeros((0, 3)), "has no points, or some that are not finite"),
        (np.full((4, 3), np.nan), "has no points, or some that are not finite"),
        (np.zeros((3, 4)), r"is a ndarray of shape \(3, 4\), expected \(N,3\); transpose it"),
    ],
)
def test_what_is_no_cloud_cannot_be_damaged(points, words):
    with pytest.raises(InputError, match=words):
        damaged(points, "jitter:3", ("mug", 0), np.eye(3))


def test_damaged_clouds_have_no_normals_to_lead_astray():
    with pytest.raises(InputError, match="takes normals cannot be tested on damaged"):
        DamagedClouds(CLOUDS, "jitter:1").points_and_normals([0])


def test_names():
    assert damage.parse("jitter:3") == ("jitter:3",)
    assert damage.parse(["scale", "jitter:1"])[-2:] == ("scale:5", "jitter:1")
    assert len(damage.parse("all")) == len(damage.parse(["all", "scale:1"])) == 50


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("jiter", "no damage named 'jiter'; did you mean jitter"),
        ("jitter:6", "strength '6'; expected one of 1, 2, 3, 4, 5"),
        ("jitter:", "strength ''"),
        ("jitter:0", "damages nothing"),
        ("", "no damage named ''"),
        ([3], "a damage is named by a text such as 'jitter:3', got 3"),
    ],
)
def test_what_is_no_damage_is_refused(text, words):
    with pytest.raises(InputError, match=words):
        damage.parse(text)


def test_eval_tests_damaged_clouds_beside_its_own(data, tmp_path):
    model = f"{MODELS}:Posed"
    own, *tested = run_eval(
        model, data, results_folder=tmp_path, test_damages=["drop-local:5", "jitter:1"], **SMALL
    )
    assert [r.conditions for r in tested] == [{"damage": "drop-local:5"}, {"damage": "jitter:1"}]
    assert own.damage == ""
    for record in tested:
        assert record.test_data == own.test_data
        assert record.test_set_sha256 == own.test_set_sha256
        assert record.column[:-1] == own.column
    said = [results.read_predictions(tmp_path, r).log_probabilities[:, 0] for r in (own, *tested)]
    assert not np.array_equal(said[0], said[1])
    assert not np.array_equal(said[1], said[2])
    # Another model's, another time, the same clouds: only the model can make a difference.
    again = tmp_path / "again"
    (checkpoint,) = tmp_path.glob("runs/*/branch-*/checkpoint.pt")
    _, second = run_eval(
        model, data, checkpoint_file=checkpoint, results_folder=again, test_damages=["jitter:1"]
    )
    np.testing.assert_array_equal(
        results.read_predictions(again, second).log_probabilities[:, 0], said[2]
    )


def test_records_from_before_there_was_damage_are_read(data, tmp_path):
    run_eval(f"{MODELS}:Posed", data, results_folder=tmp_path, **SMALL)
    (path,) = tmp_path.glob(f"*{results.SUFFIX}")
    record = json.loads(path.read_text())
    assert record.pop("damage") == ""
    record["record_sha256"] = results.record_digest(record)
    path.write_text(json.dumps(record))
    assert results.read(path).damage == ""
    del record["given_pose"]
    record["record_sha256"] = results.record_digest(record)
    path.write_text(json.dumps(record))
    with pytest.raises(InputError, match=r"missing fields \['given_pose'\]"):
        results.read(path)


def test_a_bad_name_is_refused_before_anything_is_trained(data, tmp_path):
    with pytest.raises(InputError, match="no damage named 'rust'"):
        run_eval(f"{MODELS}:Posed", data, results_folder=tmp_path, test_damages=["rust"], **SMALL)
    assert not list(tmp_path.iterdir())
