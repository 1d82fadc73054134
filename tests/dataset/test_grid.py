"""Grid files and their cells, and a grid rendered and tested from end to end."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

import partialbench as pb
from partialbench.benchmark.run import run_eval
from partialbench.cli import app
from partialbench.dataset import grid
from partialbench.dataset.grid import Cell
from partialbench.dataset.loader import ShardDataset
from partialbench.errors import InputError
from tests.benchmark.memory_clouds import data_folder
from tests.benchmark.tiny_models import MODELS, SMALL

WHOLE = """
rotation = ["none", "z", "so3"]
shown = ["complete", "one view"]
sensor = ["ideal", "kinect-v1", "tof", "stereo-d415"]
occluders = [0, 0.25, 0.5]
"""


def test_the_product_has_complete_clouds_once_a_rotation(tmp_path):
    (tmp_path / "grid.toml").write_text(WHOLE)
    cells = grid.load(tmp_path / "grid.toml")
    assert len(cells) == len(set(cells)) == 3 * (1 + 4 * 3)
    assert {cell.setting for cell in cells if cell.shown == "complete"} == {
        "aligned", "z-rotated", "rotated",
    }  # fmt: skip
    assert {cell.setting for cell in cells if cell.shown == "one view"} == {
        "partial-aligned", "partial-z", "partial",
    }  # fmt: skip
    assert len({cell.name for cell in cells}) == len(cells)
    assert all(grid.parse(cell.name) == cell for cell in cells)


def test_an_axis_left_out_has_one_value():
    assert grid.cells_of({}, "here") == [Cell("so3", "one view", "ideal", 0.0)]
    assert Cell("so3", "one view", "tof:2", 0.5).name == "so3_one-view_tof-x2_0.5"
    assert grid.parse("so3_one-view_tof-x2_0.5").sensor == "tof:2"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("rotations = ['z']", "no axis 'rotations'; did you mean rotation"),
        ("rotation = ['x']", "rotation has no value 'x'; expected none, z, so3"),
        ("occluders = ['much']", "occluders holds 'much'"),
        ("sensor = []", "sensor has no value"),
        ("sensor = ['ideal', 'kinekt']", r"grid\.toml: no sensor named 'kinekt'; did you mean"),
        ("sensor = 'tof:0'", r"grid\.toml: strength must be a finite number > 0"),
        ("occluders = [0, 0.95]", "must hide a share of 0 to 0.9, got 0.95"),
        ("occluders = [0.25, 0.25000001]", "named by six digits at most, got 0.25000001"),
        ("occluders = nan", "must hide a share of 0 to 0.9, got nan"),
        ("shown = ", "not TOML"),
    ],
)
def test_what_is_no_grid_is_refused(tmp_path, content, words):
    path = tmp_path / "grid.toml"
    path.write_text(content)
    with pytest.raises(InputError, match=words):
        grid.load(path)
    with pytest.raises(InputError, match="no cell"):
        grid.parse("so3_one-view_ideal")
    with pytest.raises(InputError, match="no grid of"):
        grid.read(tmp_path)


def test_a_folder_holds_one_grid(tmp_path):
    grid.write(tmp_path, [Cell()])
    grid.write(tmp_path, [Cell()])
    assert grid.read(tmp_path) == [Cell()]
    grid.write(tmp_path, [Cell("z")])  # none was rendered yet
    (tmp_path / Cell("z").name).mkdir()
    with pytest.raises(InputError, match="holds another grid: it has the cell z_one-view_ideal_0"):
        grid.write(tmp_path, [Cell()])
    assert grid.read(tmp_path) == [Cell("z")]
    grid.write(tmp_path, [Cell(), Cell("z")])
    assert grid.read(tmp_path) == [Cell(), Cell("z")]


@pytest.fixture
def cells(tmp_path):
    """A grid of two cells."""
    made = [Cell("z"), Cell()]
    grid.write(tmp_path, made)
    for cell in made:
        data_folder(tmp_path / cell.name, objects=4, points=16, setting=cell.setting)
    return [cell.name for cell in made]


def test_a_folder_under_the_name_of_another_cell_is_told(tmp_path, cells):
    grid.require_cells(tmp_path, cells)
    shutil.rmtree(tmp_path / cells[1])
    shutil.copytree(tmp_path / cells[0], tmp_path / cells[1])
    with pytest.raises(InputError, match="setting is 'partial-z', expected 'partial'"):
        grid.require_cells(tmp_path, cells)
    grid.write(tmp_path, [Cell("z"), Cell(), Cell("z", sensor="tof"), Cell("z", occluders=0.25)])
    for name, words in (
        ("z_one-view_tof_0", "sensor is '', expected 'tof:1'"),
        ("z_one-view_ideal_0.25", "occluders is 0.0, expected 0.25"),
    ):
        shutil.rmtree(tmp_path / cells[1], ignore_errors=True)
        shutil.copytree(tmp_path / cells[0], tmp_path / name)
        with pytest.raises(InputError, match=words):
            grid.require_cells(tmp_path, [name])
        shutil.rmtree(tmp_path / name)


@pytest.mark.parametrize(
    ("other", "words"),
    [({"seed": 1}, "seed of z_.* is 0, of so3_.* 1"), ({"objects": 5}, "source.* 4, of so3_.* 5")],
)
def test_cells_of_other_objects_pair_with_none(tmp_path, cells, other, words):
    """Built-in shapes of two seeds have the same names: a board would pair a chair with another."""
    shutil.rmtree(tmp_path / cells[1])
    data_folder(tmp_path / cells[1], points=16, **{"objects": 4, **other})
    for asked in (cells, cells[1:]):
        with pytest.raises(InputError, match=words):
            grid.require_cells(tmp_path, asked)


def test_conditions_of_no_folder_are_not_dropped(tmp_path, cells):
    with pytest.raises(InputError, match="--test-damage would have no effect"):
        run_eval("pointnet", checkpoint_file="x", test_grid=tmp_path, test_damages="jitter:1")
    with pytest.raises(InputError, match="--test-points, --test-pose would have no effect"):
        run_eval(
            "pointnet", checkpoint_file="x", test_grid=tmp_path, test_points=64, test_poses="0"
        )


@pytest.mark.parametrize(
    ("content", "command", "words"),
    [
        ("rotation = ['so3', 'z']", "pm40 --normals", "moves clouds out of their camera's frame"),
        ("rotation = ['so3', 'z']", "pm40 --keep-depth", "to which depth images belong"),
        ("sensor = ['ideal', 'tof']", "ps15", "the noise of their own scanner in every cell"),
        ("", "pm40 --counts 1,1 --views 3", "views=3 would have no effect"),
        ("shown = 'complete'", "pm40 --counts 1,1 --resolution 64", "resolution=64 does not apply"),
    ],
)
def test_what_a_cell_does_not_take_is_said_before_any_is_rendered(
    tmp_path, content, command, words
):
    (tmp_path / "grid.toml").write_text(content)
    out = tmp_path / "grid"
    render = ["render", *command.split(), "--grid", str(tmp_path / "grid.toml"), "--out", str(out)]
    done = CliRunner().invoke(app, render)
    assert done.exit_code == 1
    assert words in str(done.exception)
    assert not list(out.glob("*/*.h5"))


def test_a_sensor_that_the_source_does_not_take_is_said_before_any_cell_is_rendered(tmp_path):
    points = np.random.default_rng(0).normal(size=(64, 3))
    for split in ("train", "test"):
        (tmp_path / "clouds" / "cup" / split).mkdir(parents=True)
        np.savetxt(tmp_path / "clouds" / "cup" / split / f"{split}.xyz", points)
    with pytest.raises(InputError, match="cell so3_one-view_tof_0 of the grid: sensor='tof' does"):
        pb.render_grid(tmp_path / "clouds", tmp_path / "out", {"sensor": ["ideal", "tof"]})
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"setting": "rotated"}, "setting is an axis of a grid: give it there"),
        ({"occluder_options": {"occluders": 0.2}}, "occluders is an axis of a grid"),
        ({"pionts": 64}, "a grid has no option 'pionts'; did you mean points"),
        ({"data_set": "pm4"}, "no data set 'pm4'; did you mean pm40"),
        ({"points": 0}, "points must be at least 1, got 0"),
    ],
)
def test_wrong_options_of_a_grid_make_no_folder(tmp_path, options, words):
    with pytest.raises(InputError, match=words):
        pb.render_grid(None, tmp_path / "out", {}, **options)
    assert not (tmp_path / "out").exists()


def test_the_source_of_a_grid_is_listed_once(tmp_path):
    folder = tmp_path / "cad" / "box" / "test"
    folder.mkdir(parents=True)
    for i in range(2):
        trimesh.creation.box((1, 2, 3 + i)).export(folder / f"{i}.off")
    listings: list[str] = []
    made = pb.render_grid(
        tmp_path / "cad", tmp_path / "out", {"rotation": ["z", "so3"], "occluders": [0, 0.3]},
        points=32, occluder_options={"resolution": 16}, on_listing=listings.append,
    )  # fmt: skip
    assert [manifest.splits() for manifest in made.values()] == [["test"]] * 4
    assert list(made) == [cell.name for cell in grid.read(tmp_path / "out")]
    assert len(listings) == 1
    grid.require_cells(tmp_path / "out", made)


def test_a_grid_is_rendered_and_tested(tmp_path):
    (tmp_path / "grid.toml").write_text('rotation = ["z", "so3"]\nshown = ["complete", "one view"]')
    common = ["--counts", "2,1", "--points", "128", "--workers", "1", "--resolution", "48"]
    render = ["render", "pm40", *common, "--out"]
    grown = str(tmp_path / "grid")
    done = CliRunner().invoke(app, [*render, grown, "--grid", str(tmp_path / "grid.toml")])
    assert done.exit_code == 0, done.output
    again = CliRunner().invoke(
        app, [*render, grown, "--grid", str(tmp_path / "grid.toml"), "--json"]
    )
    told = json.loads(again.stdout)  # one document, of all cells
    assert [Path(one["folder"]).name for one in told] == [
        c.name for c in grid.read(tmp_path / "grid")
    ]
    assert all(one["rows"] == {"test": 40} for one in told)
    sets = {c.name: ShardDataset(tmp_path / "grid" / c.name, "test", 64)
            for c in grid.read(tmp_path / "grid")}  # fmt: skip
    first, *others = sets.values()
    assert len(sets) == 4
    for other in others:
        np.testing.assert_array_equal(first.object_ids, other.object_ids)
    refused = CliRunner().invoke(
        app, [*render, grown, "--grid", str(tmp_path / "grid.toml"), "--sensor", "tof"]
    )
    assert refused.exit_code == 1

    data = str(tmp_path / "data")
    assert CliRunner().invoke(app, [*render, data, "--views", "1"]).exit_code == 0
    results = tmp_path / "results"
    run_eval(f"{MODELS}:Posed", data, results_folder=results, **SMALL)
    (checkpoint,) = results.glob("runs/*/branch-*/checkpoint.pt")
    tested = run_eval(
        f"{MODELS}:Posed", checkpoint_file=checkpoint, test_grid=grown, results_folder=results
    )
    assert [r.grid for r in tested] == list(sets)
    assert all(r.conditions == {"grid": r.grid} for r in tested)
    assert {r.test_data.setting for r in tested} == {
        "z-rotated", "rotated", "partial-z", "partial",
    }  # fmt: skip
    assert json.loads((tmp_path / "grid" / grid.NAME).read_text())["format"] == grid.FORMAT
    # Trained and tested in one, on one of its cells.
    name = next(iter(sets))
    both = run_eval(
        f"{MODELS}:Posed", data, test_grid=f"{grown}/{name}", results_folder=results, **SMALL
    )
    assert [r.grid for r in both] == ["", name]
    assert both[1].predictions_sha256 == tested[0].predictions_sha256
