"""Tables of tuning trials."""

from __future__ import annotations

from dataclasses import replace

import pytest

from leaderboard.board import make_board
from leaderboard.build import build_leaderboard
from leaderboard.tables.tuning import tuning_layouts
from partialbench.benchmark.records import results
from partialbench.benchmark.records.trials import FILE, Trial, add_trial
from partialbench.errors import InputError
from tests.leaderboard.records import add, hash_of

TRIAL = Trial("one", "", "lr=0.001", 0, hash_of("a"), "c" * 64, 4000, 1.5, 0.25)


def write(folder, *trials):
    for trial in trials:
        add_trial(folder / FILE, trial)


def layouts(folder):
    records = results.read_folder(folder)
    return tuning_layouts(folder, records, make_board(records))


def test_without_trials_there_is_no_table(tmp_path):
    add(tmp_path, "one", 0.5)
    assert layouts(tmp_path) == []


def test_each_recipe_has_its_accuracy_and_the_best_of_several_is_named(tmp_path):
    add(tmp_path, "one", 0.5)
    write(
        tmp_path,
        replace(TRIAL, model="my:model", options="grid=16", validation_accuracy=0.125),
        TRIAL,
        replace(TRIAL, recipe="lr=0.01", validation_accuracy=0.5),
        replace(TRIAL, recipe="", validation_accuracy=0.5),
    )
    (table,) = layouts(tmp_path)
    assert "pm40-parametric" in table.title
    assert table.head == ["model", "clouds seen", "as it is", "lr=0.001", "lr=0.01", "best"]
    assert table.rows == [
        ["ONE", "4.0 k", "50.0", "25.0", "50.0", "as it is, lr=0.01"],
        ["my:model [grid=16]", "4.0 k", "–", "12.5", "–", "–"],
    ]


def test_trials_of_several_lengths_stand_in_their_order_with_what_they_saw(tmp_path):
    add(tmp_path, "one", 0.5)
    for epochs in (16, 2):
        write(
            tmp_path,
            replace(TRIAL, recipe=f"epochs={epochs}", clouds_seen=4000 * epochs),
            replace(TRIAL, recipe="optimizer=muon"),
        )
    (table,) = layouts(tmp_path)
    assert table.head[1:-1] == ["clouds seen", "epochs=2", "epochs=16", "optimizer=muon"]
    assert table.rows[0][1] == "4.0 k – 64.0 k"


@pytest.mark.parametrize("change", [{"data": "d" * 64}, {"protocol": "d" * 64}, {"seed": 1}])
def test_trials_that_cannot_be_compared_are_tables_of_their_own(tmp_path, change):
    add(tmp_path, "one", 0.5)
    write(tmp_path, TRIAL, replace(TRIAL, **change))
    assert [len(table.rows) for table in layouts(tmp_path)] == [1, 1]


def test_the_best_trial_of_each_model_is_ranked_against_the_columns(tmp_path):
    for i, name in enumerate("abcd"):
        add(tmp_path, name, 0.9 - 0.2 * i)
        write(
            tmp_path,
            replace(TRIAL, model=name, validation_accuracy=0.01),
            replace(TRIAL, model=name, recipe="lr=0.01", validation_accuracy=0.5 - 0.1 * i),
        )
    write(tmp_path, replace(TRIAL, model="never-tested", validation_accuracy=0.99))
    _, table = layouts(tmp_path)
    assert table.rows == [["pm40-parametric, partial, board, 100k clouds", "4", "+1.00", "+1.00"]]


def test_the_options_of_a_trial_say_which_row_it_is_of(tmp_path):
    for i, grid in enumerate((16, 24, 32, 64)):
        add(tmp_path, "one", 0.9 - 0.2 * i, options={"grid": grid})
        write(tmp_path, replace(TRIAL, options=f"grid={grid}", validation_accuracy=0.1 * (i + 1)))
    _, table = layouts(tmp_path)
    assert table.rows == [["pm40-parametric, partial, board, 100k clouds", "4", "-1.00", "-1.00"]]


def test_the_board_shows_them_and_refuses_a_file_that_holds_none(tmp_path):
    add(tmp_path, "one", 0.5)
    write(tmp_path, TRIAL)
    build_leaderboard(tmp_path, tmp_path / "board")
    assert "Tuning on pm40-parametric" in (tmp_path / "board" / "leaderboard.md").read_text()
    (tmp_path / FILE).write_text("model,seed\none,first\n")
    with pytest.raises(InputError, match=r"tuning\.csv is not a file of trials"):
        build_leaderboard(tmp_path, tmp_path / "board")
