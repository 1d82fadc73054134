"""Records → tables: grouped by digest, stable to the byte, refused when they cannot be trusted."""

from __future__ import annotations

import csv
import dataclasses
import json
import re
import shutil
import subprocess
import time

import numpy as np
import pytest

from leaderboard.board import Column, make_board, ranked
from leaderboard.build import build_leaderboard
from leaderboard.check import problems
from leaderboard.comparison import compare
from leaderboard.figures import draw
from leaderboard.tables.latex import escape
from leaderboard.words import engineering, model_input
from partialbench.benchmark.protocol.protocol import protocol
from partialbench.benchmark.records import results
from partialbench.errors import InputError
from tests.leaderboard.records import add, predictions, record, small_board


@pytest.fixture
def folder(tmp_path):
    return small_board(tmp_path / "results")


def test_cells_average_their_seeds(folder):
    board = make_board(results.read_folder(folder))
    column = next(c for c in board if "→" not in c.title)
    cell = column.cells["good"]
    found = [r.scores["accuracy"] for r in cell.results]
    assert [r.seed for r in cell.results] == [0, 1]
    assert cell.mean() == pytest.approx(sum(found) / 2)
    assert cell.std() == pytest.approx(abs(found[0] - found[1]) / 2**0.5)
    assert ranked(column)[-1] == "poor"


def test_pose_turning_and_classes_are_means_over_seeds_too(folder, tmp_path):
    found = [
        dataclasses.replace(r, rotation_audit=r.rotation_audit | {"drift": 0.1 + 0.2 * r.seed})
        for r in results.read_folder(folder)
        if r.model == "good" and r.train_data.id == r.test_data.id
    ]
    cell = make_board(found)[0].cells["good"]
    poses, classes = (
        [r.scores[score] for r in cell.results] for score in ("pose", "per_class")
    )  # fmt: skip
    assert poses[0] != poses[1]
    assert cell.pose.top_1 == pytest.approx((poses[0]["top_k"][0] + poses[1]["top_k"][0]) / 2)
    assert cell.pose.top_5 == pytest.approx((poses[0]["top_k"][4] + poses[1]["top_k"][4]) / 2)
    for figure in ("median_deg", "within_30"):
        assert getattr(cell.pose, figure) == pytest.approx(np.mean([p[figure] for p in poses]))
    assert cell.drift == pytest.approx(0.2)
    assert cell.per_class == pytest.approx(
        {name: (classes[0][name] + classes[1][name]) / 2 for name in classes[0]}
    )
    assert classes[0] != classes[1]


def test_the_cost_is_of_the_last_seed(tmp_path):
    for seed in range(2):
        path = add(tmp_path, "one", 0.5, seed=seed)
    forge(path, lambda text: text["cost"].update(multiply_adds=7), honest_digest=True)
    (column,) = make_board(results.read_folder(tmp_path))
    assert column.cells["one"].cost["multiply_adds"] == 7


@pytest.mark.parametrize(
    "other",
    [
        {"digest": "d"}, {"test_digest": "d"}, {"preset": "paper"}, {"data": "pm40"},
        {"test": "pm40"},
    ],
)  # fmt: skip
def test_other_data_or_protocol_is_another_column(tmp_path, other):
    add(tmp_path, "one", 0.9)
    add(tmp_path, "two", 0.8)
    add(tmp_path, "two", 0.8, **other)
    board = make_board(results.read_folder(tmp_path))
    assert len(board) == 2
    assert len({c.title for c in board}) == 2
    assert sorted(sorted(c.cells) for c in board) == [["one", "two"], ["two"]]


def test_a_variant_is_a_row_of_its_own(tmp_path):
    add(tmp_path, "one", 0.9)
    add(tmp_path, "one", 0.8, variant="lr=0.1")
    (column,) = make_board(results.read_folder(tmp_path))
    assert set(column.cells) == {"one", "one [lr=0.1]"}


def test_groups_tell_the_poor_from_the_good_and_not_equals_apart(folder):
    board = make_board(results.read_folder(folder))
    column = next(c for c in board if "→" not in c.title)
    found = compare(column, folder)
    assert set(found.groups["good"]) & set(found.groups["even"])
    assert not set(found.groups["good"]) & set(found.groups["poor"])
    for name, cell in column.cells.items():
        low, high = found.intervals[name]
        assert low < cell.mean() < high
        assert 0.02 < high - low < 0.25


def test_results_on_other_clouds_of_the_same_data_are_refused(tmp_path):
    add(tmp_path, "one", 0.9)
    fewer = predictions(0.9, 3)
    fewer = fewer.select(np.arange(60))
    results.write(tmp_path, record("two", fewer), fewer)
    (column,) = make_board(results.read_folder(tmp_path))
    with pytest.raises(InputError, match="was not tested on the same clouds"):
        compare(column, tmp_path)


def test_the_same_records_give_the_same_bytes(folder, tmp_path):
    first = {p.name: p.read_bytes() for p in build_leaderboard(folder, tmp_path / "a")}
    shutil.copytree(folder, tmp_path / "moved")
    again = {p.name: p.read_bytes() for p in build_leaderboard(tmp_path / "moved", tmp_path / "b")}
    assert first == again
    assert {"leaderboard.md", "leaderboard.csv", "leaderboard.tex"} <= first.keys()


def test_every_pair_of_rows_is_compared_with_an_interval(folder, tmp_path):
    build_leaderboard(folder, tmp_path)
    with open(tmp_path / "differences.csv", newline="") as file:
        lines = [line for line in csv.DictReader(file) if "→" not in line["column"]]
    assert len(lines) == 3
    column = next(c for c in make_board(results.read_folder(folder)) if "→" not in c.title)
    for line in lines:
        ahead = column.cells[line["row"]].mean() - column.cells[line["other"]].mean()
        assert float(line["difference"]) == pytest.approx(ahead, abs=1e-6)
        assert float(line["low"]) <= ahead <= float(line["high"])
    poor = {line["row"]: line for line in lines if line["other"] == "poor"}
    assert float(poor["good"]["low"]) > 0, "the interval of a clear difference excludes zero"
    assert float(poor["good"]["p_holm"]) < 0.05
    (best,) = (r for r in ranked(column)[:1])
    text = (tmp_path / "leaderboard.md").read_text()
    shown = f"{100 * float(poor[best]['difference']):.1f} ("
    assert any(shown in row for row in text.splitlines() if row.startswith("| POOR |"))


def test_the_tables_say_what_the_records_say(folder, tmp_path):
    build_leaderboard(folder, tmp_path)
    text = (tmp_path / "leaderboard.md").read_text()
    with open(tmp_path / "leaderboard.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 4
    by_model = {line["model"]: line for line in lines if line["test_data"] == "pm40-parametric"}
    for name, paper in (("good", "83.5"), ("even", "81.5"), ("poor", "–")):
        mean = float(by_model[name]["accuracy"])
        line = next(m for m in text.splitlines() if m.startswith(f"| {name.upper()} |"))
        assert f"{100 * mean:.1f} ± " in line
        assert line.endswith(f"| {paper} |")
    assert by_model["good"]["paper_reported_other_data"] == "0.835000"
    assert by_model["good"]["paper_reported"] == ""
    assert by_model["poor"]["paper_reported_other_data"] == ""
    assert float(by_model["good"]["pose_top1"]) < 0.1
    assert by_model["even"]["pose_top1"] == ""
    assert "paper, PM40 (reported, other data)" in text
    assert "paper, PM40 → PS15 (reported, other data)" in text


def test_latex_escapes_and_balances(folder, tmp_path):
    build_leaderboard(folder, tmp_path)
    text = (tmp_path / "leaderboard.tex").read_text()
    assert text.count(r"\begin{") == text.count(r"\end{")
    assert text.count("{") - text.count(r"\{") == text.count("}") - text.count(r"\}")
    tabulars = re.findall(r"\\begin\{tabular\}\{(l[lcr]*)\}(.*?)\\end\{tabular\}", text, re.S)
    assert tabulars
    for columns, body in tabulars:
        for line in body.splitlines():
            if line.endswith(r"\\"):
                assert len(re.findall(r"(?<!\\)&", line)) == len(columns) - 1
    assert not re.search(r"(?<!\\)%", text)
    assert escape("a_b & 5% × {x}") == r"a\_b \& 5\% $\times$ \{x\}"
    text.encode("ascii")  # every character is one that any LaTeX has


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="pdflatex is not installed")
def test_latex_compiles(folder, tmp_path):
    build_leaderboard(folder, tmp_path)
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "leaderboard.tex"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)


# Integrity.


def forge(path, change, honest_digest):
    """Edits a record; ``honest_digest`` also corrects its digest, as a forger would."""
    text = json.loads(path.read_text())
    change(text)
    if honest_digest:
        text["record_sha256"] = results.record_digest(text)
    path.write_text(json.dumps(text))


def better(text):
    text["scores"]["accuracy"] = 0.99


def test_sound_records_have_no_problems(folder, made_up_models):
    assert problems(folder) == []


def test_everything_wrong_is_reported_at_once(made_up_models, folder):
    paths = sorted(folder.glob("*.json"))
    forge(paths[0], better, honest_digest=False)
    stored = results.read(paths[1]).predictions_file
    (folder / stored).unlink()
    shutil.copy(paths[2], folder / f"again_{paths[2].name}")
    forge(paths[3], better, honest_digest=True)
    (folder / "stray.predictions.npz").write_bytes(b"")
    found = "\n".join(problems(folder))
    assert "was changed after it was written" in found
    assert f"{stored} is missing" in found
    assert "record the same run" in found
    assert "give another accuracy than the record says" in found
    assert "belongs to no record" in found
    assert f"again_{paths[2].name} is the record of another run than its name says" in found
    assert len(found.splitlines()) == 6
    with pytest.raises(InputError, match=r"6 thing\(s\) wrong"):
        build_leaderboard(folder, folder / "out", check=True)
    assert not (folder / "out").exists()


def test_a_forger_who_mends_the_digest_is_found_by_check_alone(made_up_models, folder, tmp_path):
    forge(sorted(folder.glob("*.json"))[0], better, honest_digest=True)
    build_leaderboard(folder, tmp_path / "trusting")
    with pytest.raises(InputError, match="give another accuracy"):
        build_leaderboard(folder, tmp_path / "checking", check=True)


@pytest.mark.parametrize(("off", "wrong"), [(1e-15, 0), (1e-6, 1)])
def test_another_processors_rounding_is_no_forgery(folder, made_up_models, off, wrong):
    """Records come from other machines, where sums are taken in another order."""

    def shift(text):
        text["scores"]["calibration_error"] += off
        text["scores"]["pose"]["top_k"][3] += off

    posed = next(p for p in sorted(folder.glob("good*.json")) if "seed0" in p.name)
    forge(posed, shift, honest_digest=True)
    assert len(problems(folder)) == wrong


def test_an_empty_folder_says_how_to_fill_it(tmp_path):
    with pytest.raises(InputError, match=r"holds no records.*partialbench eval"):
        build_leaderboard(tmp_path, tmp_path / "out")
    with pytest.raises(InputError, match="no results folder"):
        build_leaderboard(tmp_path / "absent", tmp_path / "out")


@pytest.mark.slow
def test_a_board_of_the_papers_size_takes_less_than_half_a_minute(tmp_path):
    for i in range(12):
        for seed in range(5):
            for test, digest in (("pm40", "b"), ("ps15", "c")):
                add(tmp_path, f"model{i}", 0.6 + i / 50, seed, i > 8, 2468, 1, data="pm40",
                    test=test, test_digest=digest)  # fmt: skip
    start = time.perf_counter()
    build_leaderboard(tmp_path, tmp_path / "out")
    assert time.perf_counter() - start < 30


def test_numbers_read_well():
    assert [engineering(n) for n in (12, 1_234, 3_480_049, 7_100_000_000)] == [
        "12", "1.2 k", "3.5 M", "7.1 G",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("card", "options", "seen"),
    [
        ("pc (1024×3)", {}, "pc (256×3)"),
        ("voxel (1×64³)", {"grid": 16}, "voxel (1×16³)"),
        ("voxel (1×64³)", {"k": 5}, "voxel (1×64³)"),
        ("views (6×128²)", {"image": 64}, "views (6×64²)"),
        ("", {"grid": 16}, "–"),
    ],
)
def test_the_input_is_what_this_run_saw(card, options, seen):
    """A row on a 16³ grid of 256 points does not claim the published sizes."""
    run = record("a", predictions(0.9, 0), options=options)
    assert run.protocol["num_points"] == 256
    run.card["representation"] = card
    assert model_input(run) == seen


def test_the_run_name_is_a_file_name_and_depends_on_what_the_run_is():
    stored = predictions(0.9, 0)
    base = record("my_model:make", stored)
    names = {base.run_name}
    for change in ({"seed": 1}, {"variant": "lr=0.1"}, {"protocol_digest": "f" * 64}):
        names.add(dataclasses.replace(base, **change).run_name)
    assert len(names) == 4
    assert all(re.fullmatch(r"[A-Za-z0-9._=+-]+", name) for name in names)


def test_a_column_says_what_was_changed_about_its_preset():
    stored = predictions(0.9, 0)
    base = record("one", stored)
    changed = protocol("board", split_seed=3, jitter_sigma=0.01)
    other = dataclasses.replace(base, protocol=changed.as_dict(), protocol_digest=changed.digest)
    older = dataclasses.replace(
        other, protocol=changed.as_dict() | {"version": changed.version - 1}, protocol_digest="0"
    )
    titles = [column.title for column in make_board([base, other, older])]
    assert sorted(titles) == [
        "pm40-parametric, partial, board split_seed=3 jitter_sigma=0.01, 100k clouds",
        "pm40-parametric, partial, board+, 100k clouds",
        "pm40-parametric, partial, board, 100k clouds",
    ]


def test_columns_that_differ_in_protocol_or_direction_name_their_figures_differently():
    titles = [
        "pm40-parametric, partial, mini", "pm40-parametric, partial, mini+",
        "pm40-parametric → ps15-rooms, partial, mini",
        "ps15-rooms → pm40-parametric, partial, mini",
        "my_data, aligned → rotated, mini (1a2b3c 4d5e6f 789abc)",
    ]  # fmt: skip
    slugs = [Column((), title, "").slug for title in titles]
    assert len(set(slugs)) == len(titles)
    assert slugs[1:3] == [
        "pm40-parametric-partial-mini+", "pm40-parametric-to-ps15-rooms-partial-mini",
    ]  # fmt: skip
    # What follows a file's last underscore is the column: the page looks it up by that.
    assert not any("_" in slug for slug in slugs)


def test_no_figure_takes_the_place_of_another_and_every_axis_of_costs_has_numbers(tmp_path):
    for i, data in enumerate(("my_data", "my-data", "My-Data", "データ")):
        for name in ("abcdefg", "abcdefgh"):
            add(tmp_path, name, 0.5, data=data, digest=f"d{i}", test_digest=f"t{i}")
    board = make_board(results.read_folder(tmp_path))
    drawn = draw.draw_all(board, [compare(column, tmp_path) for column in board], [], [], tmp_path)
    named = [name for name in drawn if name.startswith("cost_")]
    assert len(named) == len(board) == 4
    for name in named:
        (axes,) = drawn[name][1].axes
        # 7 and 8 million: no power of ten, nor 2 or 5 times one, lies there.
        assert [label.get_text() for label in axes.get_xticklabels()] == ["7.0 M", "8.0 M"]
    assert draw._log_places([3e6, 7e8]) == [1e7, 1e8]
    assert draw._log_places([3e6, 4e7]) == [5e6, 1e7, 2e7]
    assert draw._log_places([4e6]) == [4e6]
