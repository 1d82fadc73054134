"""Tables of poses, from records made up for them."""

import numpy as np
import pytest

from leaderboard.board import make_board
from leaderboard.tables.poses import DECIDING, TOP_K, pose_layouts
from partialbench.benchmark.records import results
from tests.leaderboard.records import add


def layouts(folder):
    return pose_layouts(make_board(results.read_folder(folder)), folder)


def test_rows_without_a_pose_make_no_table(tmp_path):
    add(tmp_path, "plain", 0.5)
    assert layouts(tmp_path) == []


def test_a_row_with_a_pose_has_its_recorded_scores_and_intervals_around_them(tmp_path):
    for seed in range(2):
        add(tmp_path, "posed", 0.5, seed, posed=True)
    add(tmp_path, "plain", 0.6)
    (table,) = layouts(tmp_path)
    (row,) = table.rows
    assert row[0] == "POSED"
    scores = [r.scores["pose"] for r in results.read_folder(tmp_path) if r.model == "posed"]
    expected = [np.mean([s["top_k"][k - 1] for s in scores]) for k in TOP_K]
    expected.append(np.mean([s["within_30"] for s in scores]))
    for text, share in zip(row[1:], expected, strict=True):
        mean, low, high = (
            float(x) for x in text.replace("(", "").replace(")", "").split(" ") if x != "–"
        )
        assert mean == pytest.approx(100 * share, abs=0.051)
        assert low <= mean <= high


def test_a_row_that_decides_over_poses_has_each_k_and_the_gain_of_all(tmp_path):
    add(tmp_path, "many", 0.5, posed=True, candidates=True)
    _, table = layouts(tmp_path)
    (row,) = table.rows
    ensemble = results.read_folder(tmp_path)[0].scores["ensemble"]
    assert [float(text.split()[0]) for text in row[1:-1]] == [
        pytest.approx(100 * ensemble[k - 1], abs=0.051) for k in DECIDING
    ]
    assert float(row[-1].split()[0]) == pytest.approx(100 * (ensemble[-1] - ensemble[0]), abs=0.051)
