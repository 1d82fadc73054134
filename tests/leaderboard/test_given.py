"""Tables and figures of models that were told the pose, from records made up for them."""

import csv
import io

import pytest

from leaderboard.board import make_board
from leaderboard.build import build_leaderboard
from leaderboard.tables.curves import find_families
from leaderboard.tables.given import as_layout, find_given_poses
from partialbench.benchmark.records import results
from tests.leaderboard.records import add, small_board

ACCURACIES = {"random": 0.3, "15": 0.95, "0": 0.99, "5": 0.97}


@pytest.fixture
def folder(tmp_path):
    """The small board, one row of it told four poses, in no order."""
    small_board(tmp_path)
    for seed in range(2):
        for pose, accuracy in ACCURACIES.items():
            add(tmp_path, "poor", accuracy, seed, given_pose=pose)
    return tmp_path


def found(folder):
    records = results.read_folder(folder)
    board = make_board(records)
    return board, find_given_poses(board, records, folder)


def test_a_given_pose_makes_no_column_and_no_curve(folder):
    board, given = found(folder)
    assert len(board) == 2
    assert board[0].cells["poor"].seeds == 2
    assert find_families(board, results.read_folder(folder), folder) == []
    assert [g.column for g in given] == [board[0]]
    assert [*given[0].rows] == ["poor"]


def test_a_row_has_its_own_pose_first_and_the_mean_over_seeds(folder):
    board, (given,) = found(folder)
    told = given.rows["poor"]
    assert given.poses == [*told.accuracy] == ["own", "0", "5", "15", "random"]
    records = [r for r in results.read_folder(folder) if r.model == "poor"]
    for pose, (mean, low, high) in told.accuracy.items():
        of_pose = [r for r in records if (r.given_pose or "own") == pose]
        assert len(of_pose) == told.seeds == 2
        assert mean == pytest.approx(sum(r.scores["accuracy"] for r in of_pose) / 2)
        assert low < mean < high
    own = board[0].cells["poor"].mean()
    gain, low, high = told.gain
    assert gain == pytest.approx(told.accuracy["0"][0] - own)
    # Paired: narrower than the two intervals side by side.
    (_, a, b), (_, c, d) = told.accuracy["0"], told.accuracy["own"]
    assert 0 < low < gain < high
    assert high - low < (b - a) + (d - c)


def test_only_seeds_told_every_pose_count(folder):
    add(folder, "poor", 0.8, 1, given_pose="45")
    _, (given,) = found(folder)
    assert given.rows["poor"].seeds == 1
    add(folder, "poor", 0.8, 0, given_pose="90")
    assert found(folder)[1] == []


def test_two_conditions_at_once_compare_with_no_row(tmp_path):
    small_board(tmp_path)
    add(tmp_path, "good", 0.9, posed=True, given_pose="0", points=64)
    assert found(tmp_path)[1] == []


def test_a_row_without_the_true_pose_has_no_gain(folder):
    for seed in range(2):
        add(folder, "good", 0.5, seed, posed=True, given_pose="random")
    layout = as_layout(found(folder)[1][0])
    assert layout.head == ["model", "own pose", "true pose", "± 5°", "± 15°", "random pose", "gain"]
    good, poor = layout.rows
    assert good[0] == "GOOD"
    assert good[2:5] == ["–"] * 3
    assert good[-1] == "–"
    assert poor[-1] != "–"


def test_tables_and_figures_show_them(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("board")
    written = {path.name for path in build_leaderboard(folder, out, with_figures=True)}
    column = make_board(results.read_folder(folder))[0]
    assert f"given_pose_{column.slug}.svg" in written
    text = (out / "leaderboard.md").read_text()
    assert f"## Accuracy (%) under a given pose: {column.title}" in text
    lines = list(csv.DictReader(io.StringIO((out / "curves.csv").read_text())))
    assert [line["x"] for line in lines] == ["own", "0", "5", "15", "random"]
    assert {line["condition"] for line in lines} == {"pose"}
    assert all(line["interval_low"] < line["accuracy"] < line["interval_high"] for line in lines)
