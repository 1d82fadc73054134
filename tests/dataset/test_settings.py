"""Settings differ in what is seen and in the frame, and in nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from partialbench.dataset.build import build
from partialbench.dataset.executors import InlineExecutor
from partialbench.dataset.loader import ShardDataset
from partialbench.dataset.render import plan_render
from partialbench.dataset.settings import SETTINGS, turns_of

POINTS = 64


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    """Setting → the test rows of three classes of the built-in shapes, two views each."""
    found = {}
    for setting in SETTINGS:
        out = tmp_path_factory.mktemp(setting)
        plan = plan_render(
            "pm40", out, setting=setting, splits=("train",), views=2, points=POINTS,
            source_options={"counts": (1, 1)},
            occluder_options={} if SETTINGS[setting].whole else {"resolution": 32},
        )  # fmt: skip
        build(plan, InlineExecutor)
        found[setting] = ShardDataset(out, "train", POINTS)
        assert found[setting].setting == setting
    return found


def canonical(data):
    """Every row's points in its object's frame."""
    points = data.points(np.arange(len(data))) - data.translations[:, None]
    return np.einsum("mpi,mij->mpj", points, data.rotations)


def test_one_view_is_the_same_points_in_any_frame(rows):
    own = canonical(rows["partial"])
    for setting in ("partial-z", "partial-aligned"):
        np.testing.assert_allclose(canonical(rows[setting]), own, atol=1e-5)
        for name in ("object_ids", "views", "n_visible", "visible_fraction", "labels"):
            np.testing.assert_array_equal(
                getattr(rows[setting], name), getattr(rows["partial"], name)
            )
        assert (rows[setting].intrinsics == 0).all()


def test_complete_clouds_are_of_the_same_object(rows):
    for setting in ("rotated", "z-rotated", "aligned"):
        assert (rows[setting].visible_fraction == 1).all()
        np.testing.assert_allclose(canonical(rows[setting]), canonical(rows["aligned"]), atol=1e-5)


@pytest.mark.parametrize("setting", SETTINGS)
def test_turns_are_what_the_setting_says(rows, setting):
    R = rows[setting].rotations
    up = R[:, :, 2]
    if turns_of(setting) == "none":
        np.testing.assert_array_equal(R, np.broadcast_to(np.eye(3), R.shape))
    elif turns_of(setting) == "z":
        np.testing.assert_array_equal(up, np.broadcast_to([0, 0, 1], up.shape))
        angles = np.arctan2(R[:, 1, 0], R[:, 0, 0])
        assert len(np.unique(angles)) == len(R)  # each view its own
        assert abs(np.exp(1j * angles).mean()) < 3 / len(R) ** 0.5
    else:
        assert np.abs(up.mean(axis=0)).max() < 3 / (3 * len(R)) ** 0.5


def test_a_view_turns_alike_whether_complete_or_not(rows):
    np.testing.assert_array_equal(rows["z-rotated"].rotations, rows["partial-z"].rotations)
    np.testing.assert_array_equal(rows["rotated"].rotations, rows["partial"].rotations)
