"""The tables of a grid, from records made up for them."""

import numpy as np
import pytest

from leaderboard.board import make_board
from leaderboard.build import build_leaderboard
from leaderboard.tables.grid import BASE, Step, find_grids, grid_layouts, steps_of
from partialbench.benchmark.records import results
from partialbench.dataset.grid import cells_of
from partialbench.errors import InputError
from tests.leaderboard.records import add

AXES = {
    "rotation": ["none", "z", "so3"], "shown": ["complete", "one view"],
    "sensor": ["ideal", "tof"], "occluders": [0, 0.5],
}  # fmt: skip


def accuracy(cell):
    """Each axis costs something, sensor and occluders together more."""
    share = 0.95 - {"none": 0, "z": 0.05, "so3": 0.15}[cell.rotation]
    share -= 0.1 * (cell.shown == "one view") + 0.1 * (cell.sensor == "tof") + 0.2 * cell.occluders
    return share - 0.3 * (cell.sensor == "tof" and cell.occluders > 0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("records")
    add(folder, "one", 0.7)
    for k, cell in enumerate(cells_of(AXES, "test")):
        add(folder, "one", accuracy(cell), grid=cell.name, test_digest=f"cell {k}", objects=200)
    return folder


def test_a_grid_makes_no_column(folder):
    assert len(make_board(results.read_folder(folder))) == 1


def test_each_step_costs_what_its_two_cells_differ_by(folder):
    (grid,) = find_grids(results.read_folder(folder), folder)
    assert len(grid.right) == 3 * 5
    steps = {(s.axis, s.value): s for s in steps_of(grid)}
    assert list(steps) == [
        ("rotation", "z, complete"), ("rotation", "so3, complete"), ("rotation", "z, one view"),
        ("rotation", "so3, one view"), ("shown", "one view"), ("sensor", "tof"),
        ("occluders", "0.5"),
    ]  # fmt: skip
    scores = {r.grid: r.scores["accuracy"] for r in results.read_folder(folder)}
    for step in steps.values():
        mean, low, high = grid.lost(step)
        assert mean == pytest.approx(scores[step.before.name] - scores[step.after.name])
        assert low < mean < high


def test_an_interaction_is_what_is_lost_beyond_the_sum(folder):
    (grid,) = find_grids(results.read_folder(folder), folder)
    steps = {s.axis: s for s in steps_of(grid) if s.before == BASE}
    found = grid.interaction(steps["sensor"], steps["occluders"])
    assert found == pytest.approx(grid.interaction(steps["occluders"], steps["sensor"]))
    assert found[0] == pytest.approx(0.3, abs=0.12)
    assert found[1] > 0
    assert grid.interaction(steps["sensor"], Step("rotation", "x", BASE, BASE)) is not None


def test_only_clouds_of_both_cells_are_compared(tmp_path):
    one, other = cells_of({"sensor": ["ideal", "tof"]}, "test")
    add(tmp_path, "one", 1.0, grid=one.name, test_digest="x", objects=40)
    add(tmp_path, "one", 1.0, grid=other.name, test_digest="y", objects=20)
    (grid,) = find_grids(results.read_folder(tmp_path), tmp_path)
    assert len(grid.right[one]) == 2 * len(grid.right[other])
    assert grid.lost(Step("sensor", "tof", one, other)) == (0, 0, 0)


def test_two_grids_under_one_name_are_refused(tmp_path):
    add(tmp_path, "one", 0.8, 0, grid=BASE.name, test_digest="x")
    add(tmp_path, "one", 0.8, 0, grid=BASE.name, test_digest="y")
    with pytest.raises(InputError, match="keep the records of one grid"):
        find_grids(results.read_folder(tmp_path), tmp_path)


def test_tables(folder):
    costs, interactions, multiple = grid_layouts(find_grids(results.read_folder(folder), folder))
    assert costs.head[1:3] == ["trained on", "rotation: z, complete"]
    assert costs.rows[0][:2] == ["ONE", "pm40-parametric, partial, board, 100k clouds"]
    assert any("sensor tof × occluders 0.5" in row for row in interactions.rows)
    assert multiple.head == ["clouds", "none", "z", "so3"]
    assert [row[0] for row in multiple.rows] == [
        "complete", "one view, ideal", "one view, tof", "one view, ideal, 50% occluded",
        "one view, tof, 50% occluded",
    ]  # fmt: skip
    assert np.array([[float(x) for x in row[1:]] for row in multiple.rows]).shape == (5, 3)
    assert grid_layouts([]) == []


def test_a_longer_training_is_a_row_of_its_own_and_comes_first(tmp_path):
    for milestone, share in ((25_000, 0.9), (50_000, 0.6)):
        add(tmp_path, "one", share, grid=BASE.name, milestone=milestone)
    grids = find_grids(results.read_folder(tmp_path), tmp_path)
    trained = "pm40-parametric, partial, board"
    assert [grid.training for grid in grids] == [f"{trained}, 50k clouds", f"{trained}, 25k clouds"]
    titles = [layout.title for layout in grid_layouts(grids)[1:]]
    assert titles == [f"Over the grid: ONE, {grid.training}" for grid in grids]


def test_the_board_has_them(folder, tmp_path):
    build_leaderboard(folder, tmp_path)
    assert "## What each axis of the grid costs" in (tmp_path / "leaderboard.md").read_text()
