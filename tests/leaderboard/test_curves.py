"""Curves from records that differ in a condition, and nothing else made of those."""

import csv
import io

import numpy as np
import pytest

from leaderboard.board import make_board
from leaderboard.build import build_leaderboard
from leaderboard.tables.curves import find_families
from partialbench.benchmark.records import results
from partialbench.errors import InputError
from tests.leaderboard.records import add, small_board


@pytest.fixture
def folder(tmp_path):
    """The small board, one row of it probed with fewer points and with a noisy sensor."""
    small_board(tmp_path)
    for seed in range(2):
        for points, accuracy in ((64, 0.3), (128, 0.6)):
            add(tmp_path, "good", accuracy, seed, posed=True, points=points)
        for sensor, digest in (("kinect-v1:0.5", "d"), ("kinect-v1:2", "e"), ("tof:1", "f")):
            add(tmp_path, "good", 0.5, seed, posed=True, sensor=sensor, test_digest=digest)
    return tmp_path


def families(folder):
    records = results.read_folder(folder)
    board = make_board(records)
    return board, find_families(board, records, folder)


def test_probes_make_curves_and_no_columns(folder):
    board, found = families(folder)
    assert len(board) == 2
    assert [f.condition for f in found] == ["kinect-v1", "points", "tof"]
    assert all(f.column is board[0] for f in found)
    assert all(set(f.curves) == {"good"} for f in found)


def test_a_curve_holds_the_rows_own_result_and_the_mean_over_seeds(folder):
    board, found = families(folder)
    by_condition = {f.condition: f.curves["good"] for f in found}
    assert [p.x for p in by_condition["points"]] == [64, 128, 256]
    assert [p.x for p in by_condition["kinect-v1"]] == [0, 0.5, 2]
    own = board[0].cells["good"].mean()
    assert by_condition["points"][-1].accuracy == pytest.approx(own)
    assert by_condition["tof"][0].accuracy == pytest.approx(own)
    probes = [r for r in results.read_folder(folder) if r.conditions == {"points": "64"}]
    expected = np.mean([r.scores["accuracy"] for r in probes])
    first = by_condition["points"][0]
    assert (first.seeds, first.accuracy) == (2, pytest.approx(expected))
    assert first.low < first.accuracy < first.high


def test_a_curve_is_of_the_seeds_tested_everywhere_on_it(folder):
    add(folder, "good", 0.4, 1, posed=True, points=32)
    board, found = families(folder)
    points = next(f for f in found if f.condition == "points").curves["good"]
    assert [(p.x, p.seeds) for p in points] == [(32, 1), (64, 1), (128, 1), (256, 1)]
    own = next(r for r in board[0].cells["good"].results if r.seed == 1)
    assert points[-1].accuracy == pytest.approx(own.scores["accuracy"])
    add(folder, "good", 0.4, 0, posed=True, points=16)  # and no seed is left
    assert [f.condition for f in families(folder)[1]] == ["kinect-v1", "tof"]


def test_a_condition_on_another_data_set_is_transfer_and_stays_a_column(tmp_path):
    small_board(tmp_path)
    add(tmp_path, "good", 0.5, test="ps15-rooms", test_digest="d", sensor="kinect-v1:1")
    board, found = families(tmp_path)
    assert len(board) == 3
    assert found == []


def test_probes_alone_make_no_board(tmp_path):
    add(tmp_path, "good", 0.5, points=64)
    with pytest.raises(InputError, match="holds only tests under other conditions"):
        build_leaderboard(tmp_path, tmp_path / "out")


def test_two_test_sets_under_one_condition_are_refused(folder):
    add(folder, "good", 0.5, 0, posed=True, sensor="tof:1", test_digest="9")
    with pytest.raises(InputError, match=r"2 data sets under the same condition \(tof 1\)"):
        families(folder)


def test_tables_and_figures_show_them(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("board")
    written = {path.name for path in build_leaderboard(folder, out, with_figures=True)}
    column, _ = make_board(results.read_folder(folder))
    assert column.slug == "pm40-parametric-partial-board-100k-clouds"
    expected = ("points", "pose_points", "kinect-v1", "tof", "pose_visibility")
    assert {f"{name}_{column.slug}.svg" for name in expected} <= written
    assert f"points_{column.slug}.png" in written
    assert "## Accuracy (%) against the points of a cloud" in (out / "leaderboard.md").read_text()
    lines = list(csv.DictReader(io.StringIO((out / "curves.csv").read_text())))
    assert len(lines) == 3 + 3 + 2
    assert all(float(line["pose_median_deg"]) > 0 for line in lines)
