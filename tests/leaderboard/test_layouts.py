"""The paper's tables as layouts of the board, and the figure of k and δ."""

from __future__ import annotations

import inspect
import re
import shutil
import subprocess

import pytest

from leaderboard.board import make_board
from leaderboard.build import build_leaderboard
from leaderboard.comparison import compare
from leaderboard.figures import draw as figures
from leaderboard.tables.layouts import (
    ABLATIONS,
    DEFAULT_DELTA_DEG,
    DEFAULT_VARIANT,
    GIVEN_POSE,
    layouts,
)
from leaderboard.words import without_duplicates
from papnet.model import VARIANTS, PAPNet
from partialbench import registry
from partialbench.benchmark.records import results
from tests.leaderboard.records import add


def laid_out(folder):
    board = make_board(results.read_folder(folder))
    return board, layouts(board, [compare(column, folder) for column in board])


def test_the_ablations_are_those_of_the_model():
    assert set(ABLATIONS) == set(VARIANTS)
    options = inspect.signature(PAPNet).parameters
    assert options["variant"].default == DEFAULT_VARIANT
    assert options["delta_deg"].default == DEFAULT_DELTA_DEG
    assert set(GIVEN_POSE) == {name for name, variant in VARIANTS.items() if variant.given}


def test_table_2s_last_row_is_the_models_row_of_table_1():
    scores = registry.card("papnet").paper_scores
    ours = ABLATIONS[DEFAULT_VARIANT]
    assert (ours.pm40, ours.ps15) == (scores["pm40"], scores["ps15"])


def test_the_papers_figures_are_the_papers(shared):
    """Every row of table 2 as the paper's source has it."""
    text = (shared / "reference" / "paper.tex").read_text()
    table = text[text.index(r"\label{tab:ablation}") :]
    table = table[: table.index(r"\end{table}")]
    for row in ABLATIONS.values():
        assert re.search(
            re.escape(row.title) + rf"( \(Ours\))? & {row.pm40} & {row.ps15}", table
        ), row.title


@pytest.fixture
def ablated(tmp_path):
    """Three of the eight variants in the table's way, one with another grid, one with a recipe."""
    for seed in range(2):
        add(tmp_path, "papnet", 0.8, seed, posed=True, candidates=True, paper={"pm40": 83.5})
        add(tmp_path, "papnet", 0.6, seed, options={"variant": "without-pose"})
        add(tmp_path, "papnet", 0.7, seed, options={"variant": "cascaded"}, posed=True)
    add(tmp_path, "papnet", 0.5, options={"variant": "cascaded", "grid": 32})
    add(tmp_path, "papnet", 0.5, options={"delta_deg": 15.0}, posed=True, candidates=True)
    add(tmp_path, "other", 0.9)
    return tmp_path


def test_table_2_has_the_papers_rows_and_figures_beside_ours(ablated):
    board, (table,) = laid_out(ablated)
    cells = board[0].cells
    rows = {row[0]: row for row in table.rows}
    assert list(rows) == [a.title for a in ABLATIONS.values()]
    full, without = cells["papnet"].mean(), cells["papnet [variant=without-pose]"].mean()
    assert rows["GT Tr. (Cls) + Ensem."][1].startswith(f"{100 * full:.1f} ± ")
    assert rows["GT Tr. (Cls) + Ensem."][4] == f"{100 * (full - without):+.1f}"
    assert rows["GT Tr. (Cls) + Ensem."][5:] == ["2", "83.5", "+1.9"]
    assert rows["PAPNet w/o. pose"][4:] == ["+0.0", "2", "81.6", "+0.0"]
    assert rows["Input Transformation"][1:] == ["–"] * 5 + ["82.7", "+1.1"]
    assert table.rows[table.best][0] == "GT Tr. (Cls) + Ensem."
    assert "grid" not in table.title


def test_a_variant_run_otherwise_does_not_enter_the_table(ablated):
    add(ablated, "papnet", 0.4, options={"variant": "multi-task", "grid": 32})
    _, tables = laid_out(ablated)
    assert len(tables) == 2
    (small,) = [t for t in tables if "[grid=32]" in t.title]
    rows = {row[0]: row for row in small.rows}
    assert [name for name, row in rows.items() if row[1] != "–"] == [
        "Cascaded PAPNet", "Multi-task PAPNet",
    ]  # fmt: skip
    assert rows["Cascaded PAPNet"][4] == "–"  # nothing to gain over


def test_table_1_has_a_column_for_each_pair_of_data_sets(tmp_path):
    paper = {"pm40": 68.8, "ps15": 73.5, "pm40>ps15": 35.0}
    for data, test in (("pm40", "pm40"), ("ps15", "ps15"), ("pm40", "ps15")):
        add(tmp_path, "one", 0.8, data=data, test=test, test_digest=test[1], paper=paper)
    add(tmp_path, "two", 0.6, data="ps15", test="ps15", test_digest="s")
    _, (table,) = laid_out(tmp_path)
    assert [text.split(",")[0] for text in table.head[2::2]] == ["pm40", "ps15", "pm40 → ps15"]
    one, two = sorted(table.rows)
    assert one[3::2] == ["68.8", "73.5", "35.0"]
    assert two[2::2] == ["–", two[4], "–"]
    assert float(two[4]) < float(one[4])
    # The same pair of another digest, with fewer rows, is not shown beside it.
    add(tmp_path, "one", 0.1, data="ps15", test="ps15", digest="A", test_digest="S", paper=paper)
    _, (again,) = laid_out(tmp_path)
    assert (again.head, sorted(again.rows)) == (table.head, sorted(table.rows))


def test_each_delta_is_a_curve_over_k(ablated):
    board = make_board(results.read_folder(ablated))
    drawn = figures.draw_all(board, [compare(board[0], ablated)], [], [], ablated)
    caption, figure = drawn[f"ensemble_{board[0].slug}"]
    assert "number of poses" in caption
    lines = {line.get_label(): line.get_ydata() for line in figure.axes[0].lines}
    assert set(lines) == {"PAPNET, δ = 45°", "PAPNET, δ = 15°"}
    seeds = [r.scores["ensemble"] for r in board[0].cells["papnet"].results]
    expected = [50 * (a + b) for a, b in zip(*seeds, strict=True)]
    assert lines["PAPNET, δ = 45°"].tolist() == pytest.approx(expected)


def test_duplicates_get_a_column_where_there_are_any(tmp_path):
    add(tmp_path / "a", "one", 0.6)
    build_leaderboard(tmp_path / "a", tmp_path / "plain")
    add(tmp_path / "b", "one", 0.6, duplicates=10)
    build_leaderboard(tmp_path / "b", tmp_path / "marked")
    for kind in ("md", "tex"):
        texts = [(tmp_path / n / f"leaderboard.{kind}").read_text() for n in ("plain", "marked")]
        head = "| without duplicates |" if kind == "md" else "& without duplicates"
        assert [text.lower().count(head) for text in texts] == [0, 1]
    pages = [(tmp_path / n / "leaderboard.html").read_text() for n in ("plain", "marked")]
    assert ['"duplicates":30,' in text for text in pages] == [False, True]
    assert ['"without_duplicates":null' in text for text in pages] == [True, False]
    (column,) = make_board(results.read_folder(tmp_path / "b"))
    cell = column.cells["one"]
    stored = results.read_predictions(tmp_path / "b", cell.results[0])
    right = (stored.predicted == stored.labels)[30:]  # ten objects, three views each, come first
    assert without_duplicates(cell) == f"{100 * right.mean():.1f}"


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="pdflatex is not installed")
def test_a_document_of_many_tables_and_odd_names_compiles(ablated):
    for i in range(9):
        add(ablated, "one", 0.5, data=f"pm40-{i}", title="µ_net {x} ~ 5 % & <φ> \\ “Ü”")
    build_leaderboard(ablated, ablated / "out")
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "leaderboard.tex"]
    run = subprocess.run(command, cwd=ablated / "out", capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout[-2000:]
    assert "Overfull" not in run.stdout
    assert "LaTeX Warning: Float" not in run.stdout


def test_a_changed_model_does_not_wear_the_papers_figure(ablated):
    build_leaderboard(ablated, ablated / "out")
    columns = (ablated / "out" / "leaderboard.md").read_text().partition("## Ablations")[0]
    lines = columns.splitlines()
    ends = {line.split(" | ")[0][2:]: line.split(" | ")[-1] for line in lines if "PAPNET" in line}
    assert ends.pop("PAPNET") == "83.5 |"
    assert set(ends.values()) == {"– |"}
