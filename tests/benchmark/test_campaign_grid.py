"""A campaign that tests its rows on a grid, and on damaged clouds, after they were trained."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from partialbench.benchmark.campaign import run as running
from partialbench.benchmark.campaign import worker
from partialbench.benchmark.campaign.file import load
from partialbench.benchmark.campaign.jobs import Condition, all_jobs, from_dict
from partialbench.benchmark.campaign.status import status
from partialbench.benchmark.records import declared, results
from partialbench.dataset import grid
from partialbench.errors import InputError
from tests.benchmark.memory_clouds import data_folder
from tests.benchmark.tiny_models import MODELS

TEXT = f"""
results = "records"
work = "work"
preset = "smoke"

[data.toy]
render = "pm40 --counts 1,1"

[data.cells]
render = "pm40 --counts 1,1"
grid = "grid.toml"

[[train]]
models = "{MODELS}:Bare"
data = "toy"
clouds = 32
"""
TESTS = 'grids = "cells"\ndamages = ["jitter:1", "jitter:5"]\n'
CELLS = ("z_one-view_ideal_0", "so3_one-view_ideal_0")


@pytest.fixture
def board(tmp_path):
    """The campaign file; its data and its grid are there."""
    (tmp_path / "grid.toml").write_text('rotation = ["z", "so3"]\n')
    data_folder(tmp_path / "work" / "data" / "toy", points=256)
    cells = tmp_path / "work" / "data" / "cells"
    grid.write(cells, grid.load(tmp_path / "grid.toml"))
    for cell in CELLS:
        data_folder(cells / cell, points=256, seed=5, setting=grid.parse(cell).setting)
    path = tmp_path / "board.toml"
    path.write_text(TEXT + TESTS)
    return path


@pytest.fixture
def in_this_process(monkeypatch):
    """Jobs run here, one after the other; their tests, in order."""
    begun = []

    def run_here(order, stop):
        job = from_dict(order["job"])
        begun.append(job.tests)
        return worker.outcome_of(job, order, Path(stop))

    monkeypatch.setattr(running, "run_in_process", run_here)
    return begun


def test_a_row_is_tested_on_every_cell_and_damage_of_its_file(board, in_this_process):
    campaign = load(board)
    assert campaign.data["cells"].cells == CELLS
    (job,) = all_jobs(campaign)
    wanted = (
        Condition("toy"), Condition("toy", damage="jitter:1"), Condition("toy", damage="jitter:5"),
        *(Condition("cells", cell=cell) for cell in CELLS),
    )  # fmt: skip
    assert job.tests == wanted
    after = running.run(campaign, jobs=1)
    assert (len(after.done), after.missing) == (1, [])
    assert in_this_process == [wanted]
    records = results.read_folder(campaign.results)
    assert sorted((r.grid, r.damage) for r in records) == sorted(
        [("", ""), ("", "jitter:1"), ("", "jitter:5"), *((cell, "") for cell in CELLS)]
    )


def test_a_cell_is_no_row_that_a_board_could_be_lacking(board, in_this_process):
    """Said to be one, it would be asked for for ever: its record makes no column."""
    campaign = load(board)
    running.run(campaign, jobs=1)
    (row,) = declared.read_folder(campaign.results)
    assert (row.test_data, row.state) == ("toy", "done")


def test_a_row_that_was_trained_before_is_tested_on_what_is_new_alone(board, in_this_process):
    board.write_text(TEXT)
    campaign = load(board)
    running.run(campaign, jobs=1)
    weights = {r.weights_sha256 for r in results.read_folder(campaign.results)}
    board.write_text(TEXT + TESTS)
    campaign = load(board)
    before = status(campaign)
    # It costs no training.
    assert (len(before.missing), before.hours) == (1, 0.0)
    running.run(campaign, jobs=1)
    (lost,) = (r for r in results.read_folder(campaign.results) if r.grid == CELLS[0])
    (campaign.results / f"{lost.run_name}{results.SUFFIX}").unlink()
    after = running.run(campaign, jobs=1)
    assert after.missing == []
    assert Condition("toy") not in in_this_process[1]
    assert len(in_this_process[1]) == 4
    assert in_this_process[2] == (Condition("cells", cell=CELLS[0]),)
    assert {r.weights_sha256 for r in results.read_folder(campaign.results)} == weights


def test_a_grid_that_is_missing_is_rendered_first(board, in_this_process, monkeypatch):
    lost = board.parent / "work" / "data" / "cells" / CELLS[1] / "manifest.json"
    lost.unlink()
    asked = []

    own = subprocess.run

    def fails(command, **options):
        if "render" not in command:
            return own(command, **options)
        asked.append(command)
        return subprocess.CompletedProcess(command, 1)

    monkeypatch.setattr(running.subprocess, "run", fails)
    with pytest.raises(running.PartialbenchError, match="'cells' could not be rendered"):
        running.run(load(board), jobs=1)
    # It costs its own tests alone, and the next run asks for them again.
    assert len(results.read_folder(board.parent / "records")) == 3
    assert len(status(load(board)).missing) == 1
    (command,) = asked
    at = command.index("--grid")
    assert command[at + 1] == str(board.parent / "grid.toml")
    assert command[command.index("--out") + 1] == str(lost.parents[1])
    assert len(in_this_process) == 1


def test_cells_rendered_anew_are_tested_anew(board, in_this_process):
    running.run(load(board), jobs=1)
    cell = board.parent / "work" / "data" / "cells" / CELLS[0]
    shutil.rmtree(cell)
    data_folder(cell, points=256, seed=99)
    running.run(load(board), jobs=1)
    assert in_this_process[1] == (Condition("cells", cell=CELLS[0]),)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('grids = "cells"', 'grids = "cell"', "line 17: no data set named 'cell'; did you mean"),
        ('grids = "cells"', 'grids = "toy"', "line 15: grids names 'toy', which is one data set"),
        ('data = "toy"', 'data = "cells"', "line 15: data names 'cells', which is a grid"),
        ('grids = "cells"', 'test = "cells"', "line 17: test names 'cells', which is a grid"),
        ('grid = "grid.toml"', 'grid = "none.toml"', "line 11: .* not a readable grid file"),
        ('grid = "grid.toml"', "grid = 3", "line 11: grid must be text, got 3"),
        ("--counts 1,1\"\ngrid", "--grid x\"\ngrid", "line 10: .* says its grid by grid ="),
        (
            'grid = "grid.toml"', f'grid = "grid.toml"\ndigests = {{test = "{"a" * 64}"}}',
            "line 12: .* a grid, which declares no digests",
        ),
        ("damages", "damagse", "line 18: .* no field 'damagse'; did you mean damages"),
        ("jitter:5", "jitter:6", "line 18: the damage 'jitter:6' has the strength '6'"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_with_its_line(board, old, new, message):
    text = board.read_text()
    assert old in text
    board.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        load(board)


def test_a_wrong_grid_file_is_said(board):
    (board.parent / "grid.toml").write_text('rotation = ["x"]')
    with pytest.raises(InputError, match=r"line 11: \[data.cells\]: .* rotation has no value 'x'"):
        load(board)


def test_a_grid_s_folder_is_all_its_cells_and_a_cell_s_is_one(board):
    cells = board.parent / "work" / "data" / "cells"
    assert grid.folders(cells) == [cells / cell for cell in CELLS]
    assert grid.folders(cells / CELLS[1]) == [cells / CELLS[1]]
    with pytest.raises(InputError, match="is no grid"):
        grid.folders(board.parent / "work" / "data" / "toy")
    assert json.loads((cells / grid.NAME).read_text())["format"] == grid.FORMAT


def test_damages_and_numbers_of_points_are_of_the_data_that_asked_for_them(board, in_this_process):
    other = board.parent / "work" / "data" / "rooms"
    data_folder(other, "toy-rooms", ("table", "chair"), points=256, seed=5)
    rooms = '[data.rooms]\nrender = "pm40 --counts 1,1"\n'
    entry = f'[[train]]\nmodels = "{MODELS}:Bare"\ndata = "toy"\nclouds = 32\n'
    crossed, damaged = 'test = "rooms"\npoints = [32]\n', 'damages = "scale:1"\n'
    board.write_text("\n".join((TEXT, rooms, entry + crossed, entry + damaged)))
    campaign = load(board)
    assert running.run(campaign, jobs=1).missing == []
    found = {
        (r.test_data.id, r.test_data.points == 32, r.damage)
        for r in results.read_folder(campaign.results)
    }
    assert found == {
        ("toy", False, ""), ("toy", True, ""), ("toy", False, "scale:1"),
        ("toy-rooms", False, ""), ("toy-rooms", True, ""),
    }  # fmt: skip
