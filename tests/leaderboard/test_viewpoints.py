"""Accuracy over what a view shows, from records made up for it."""

import csv
from dataclasses import dataclass

import numpy as np
import pytest

from leaderboard.board import make_board
from leaderboard.tables.viewpoints import (
    DISTANCE,
    EDGES,
    ELEVATION,
    FRACTION,
    as_csv,
    curves_over,
    find_curves,
    quantities,
)
from partialbench.benchmark.records import results
from partialbench.geometry.rotations import axis_rotation
from tests.leaderboard.records import add, hash_of


@dataclass
class Views:
    """A test set of known cameras."""

    digest: str
    rotations: np.ndarray
    translations: np.ndarray


@pytest.fixture
def folder(tmp_path):
    for seed in range(2):
        add(tmp_path, "posed", 0.8, seed, posed=True)
    add(tmp_path, "plain", 0.5)
    return tmp_path


def views_of(size):
    """Cameras at 3 units, from 80° below to 80° above the horizon."""
    elevations = np.linspace(-80, 80, size)
    # An object seen level has its z up in the image, which is −y of the camera.
    level = axis_rotation("x", np.pi / 2)
    R = np.stack([axis_rotation("x", np.deg2rad(-e)) @ level for e in elevations])
    return elevations, Views(hash_of("b"), R, np.tile([0.0, 0, 3], (size, 1)))


def test_a_camera_above_has_a_positive_elevation(folder):
    first = results.read_folder(folder)[0]
    predictions = results.read_predictions(folder, first)
    elevations, views = views_of(len(predictions))
    found = quantities(predictions, views)
    assert set(found) == {FRACTION, DISTANCE, ELEVATION}
    np.testing.assert_allclose(found[DISTANCE], 3)
    # Held against the camera's place itself.
    places = -np.einsum("mji,mj->mi", views.rotations, views.translations)
    expected = np.degrees(np.arctan2(places[:, 2], np.hypot(places[:, 0], places[:, 1])))
    np.testing.assert_allclose(found[ELEVATION], expected, atol=1e-6)
    np.testing.assert_allclose(np.abs(found[ELEVATION]), np.abs(elevations), atol=1e-6)


def test_bins_hold_what_lies_in_them():
    values = np.repeat([0.05, 0.15, 1.0], [24, 5, 20])
    right = np.where(values < 0.1, 0.25, 1.0)
    ids = np.arange(len(values)).astype(str)
    posed, plain = curves_over(
        values, np.stack([right, 0.5 * right], axis=1), ids, EDGES[FRACTION], [100 * values, None]
    )
    first, last = posed
    assert (first.start, first.end, first.clouds, first.accuracy) == (0.0, 0.1, 24, 0.25)
    assert (first.pose_deg, first.pose_low, first.pose_high) == pytest.approx((5, 5, 5))
    assert (last.start, last.end, last.clouds, last.accuracy) == (0.6, 1.0, 20, 1.0)
    assert [place.accuracy for place in plain] == [0.125, 0.5]
    assert plain[0].pose_deg is None


def test_every_quantity_that_is_known_has_curves(folder):
    board = make_board(results.read_folder(folder))
    (fraction,) = find_curves(board, folder)
    assert fraction.quantity == FRACTION
    assert [*fraction.rows] == ["posed", "plain"]
    clouds = sum(place.clouds for place in fraction.rows["plain"])
    weighted = sum(place.clouds * place.accuracy for place in fraction.rows["plain"]) / clouds
    assert weighted == pytest.approx(board[0].cells["plain"].mean(), abs=0.02)
    _, views = views_of(120)
    found = find_curves(board, folder, [views])
    assert [each.quantity for each in found] == [FRACTION, DISTANCE, ELEVATION]
    for place in found[2].rows["posed"]:
        assert place.low <= place.accuracy <= place.high
        assert place.pose_low <= place.pose_deg <= place.pose_high
    lines = list(csv.DictReader(as_csv(found).splitlines()))
    assert len(lines) == sum(len(places) for each in found for places in each.rows.values())
    elevation = [line for line in lines if line["quantity"] == ELEVATION]
    assert (elevation[0]["from"], elevation[0]["to"]) == ("-60", "-30")
    assert {line["pose_median_deg"] for line in lines if line["row"] == "plain"} == {""}
