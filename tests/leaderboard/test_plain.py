"""Names are text in every format of the board, whatever signs are in them."""

from __future__ import annotations

import csv
import re
import shutil
import subprocess

import pytest

from leaderboard.build import build_leaderboard
from leaderboard.output import LIST, write_board
from leaderboard.tables.plain import csv_cell, markdown, visible
from partialbench.errors import InputError
from tests.leaderboard.records import CLASSES, add

NAMES = ["$x_1$ and $y^2$", "a|b", "=1+1|cmd", "+x", "-y", "@z", "<img src=x onerror=alert(1)>",
         r"a\b", r"\$a|", "*bold*", "[a](http://b)", "`c`", "&lt;", "100 % #_{}~^"]  # fmt: skip


def rendered(text):
    """A cell of GitHub's Markdown as it is shown, of the signs that the board escapes."""
    return re.sub(r"\\([\\|`*$\[\]_~])", r"\1", text).replace("&lt;", "<").replace("&amp;", "&")


@pytest.mark.parametrize("name", NAMES)
def test_markdown_shows_the_name_and_nothing_else(name):
    cell = markdown(name)
    assert rendered(cell) == name
    assert "<" not in cell
    assert not re.search(r"(?<!\\)(\\\\)*[|$`*]", cell.replace("\\\\", ""))


def test_a_sign_that_shows_nothing_is_told():
    name = "a\u202eb\u2066c\x1b[2Jd\ud800"
    shown = "a[U+202E]b[U+2066]c[U+001B][2Jd[U+D800]"
    assert (visible(name), csv_cell(name), rendered(markdown(name))) == (shown,) * 3
    assert visible("Ça, 猫 カップ, آب\u200cنما") == "Ça, 猫 カップ, آب\u200cنما"


def test_words_and_lists_of_changes_stay_as_they_are():
    assert markdown("papnet [grid=16; recipe lr=0.002], night_stand") == (
        "papnet [grid=16; recipe lr=0.002], night_stand"
    )
    assert markdown("two\nlines") == "two lines"


@pytest.mark.parametrize("name", NAMES)
def test_no_spreadsheet_runs_a_name(name):
    cell = csv_cell(name)
    assert not cell.startswith(("=", "+", "-", "@"))
    assert cell.removeprefix("'") == name


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A board whose models and options have such names."""
    root = tmp_path_factory.mktemp("names")
    for i, name in enumerate(NAMES):
        add(root / "results", f"m{i}:make", 0.3 + 0.04 * i, title=name, posed=i % 2 == 0)
    add(root / "results", "n:make", 0.5, variant="f=$x_1_2$", options={"f": "$x_1_2$"})
    build_leaderboard(root / "results", root / "board", with_figures=True)
    return root / "board"


def test_every_table_has_its_names_and_its_number_of_cells(built):
    for table in re.findall(r"(?:^\|.*\n)+", (built / "leaderboard.md").read_text(), re.M):
        cells = [re.split(r"(?<!\\)\|", line) for line in table.splitlines()]
        assert len({len(row) for row in cells}) == 1
    text = rendered((built / "leaderboard.md").read_text())
    assert all(name in text for name in [*NAMES, "f=$x_1_2$"])


def test_the_csv_files_begin_no_cell_as_a_formula(built):
    for name in ("leaderboard.csv", "differences.csv", "curves.csv"):
        with open(built / name, newline="") as file:
            for row in csv.reader(file):
                for cell in row:
                    assert not cell.startswith(("=", "+", "@")), cell
                    assert not cell.startswith("-") or float(cell) < 0


def test_figures_and_page_are_made(built):
    assert any((built / "figures").glob("accuracy_*.svg"))
    text = (built / "leaderboard.html").read_text()
    assert "<img src=x" not in text
    # The page's script sets what it reads as text; here it must not end the script's element.
    assert "\\u003cimg src=x onerror" in text


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no pdflatex on this machine")
def test_the_latex_compiles(built, tmp_path):
    done = subprocess.run(
        ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", f"-output-directory={tmp_path}",
         str(built / "leaderboard.tex")], capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-2000:]


def test_a_row_that_begins_with_a_bracket_is_no_argument_of_the_row_before(tmp_path):
    add(tmp_path / "r", "a:make", 0.5, title="[3pt] or *")
    add(tmp_path / "r", "b:make", 0.9, title="* star")
    build_leaderboard(tmp_path / "r", tmp_path / "b")
    text = (tmp_path / "b" / "leaderboard.tex").read_text()
    assert "\n{}[3pt] or *" in text
    assert "\n{}* star" in text


def test_an_earlier_boards_files_leave_and_nothing_else(tmp_path):
    results, out = tmp_path / "r", tmp_path / "b"
    add(results, "one", 0.5, data="pm40-old", posed=True)
    first = set(build_leaderboard(results, out, with_figures=True))
    (out / "figures" / "mine.svg").write_text("kept")
    (out / "notes.md").write_text("kept")
    shutil.rmtree(results)
    add(results, "one", 0.5, data="pm40-new")
    second = set(build_leaderboard(results, out, with_figures=True))
    gone = first - second
    assert len(gone) > 3
    assert not any(path.exists() for path in gone)
    there = {path for path in out.rglob("*") if path.is_file()}
    assert there == second | {out / LIST, out / "notes.md", out / "figures" / "mine.svg"}


def test_a_list_that_points_elsewhere_deletes_nothing(tmp_path):
    results, out = tmp_path / "r", tmp_path / "b"
    add(results, "one", 0.5)
    written = build_leaderboard(results, out, with_figures=True)
    victim = tmp_path / "victim"
    victim.write_text("kept")
    for names in (["../victim", str(victim), "figures"], {"a": 1}, "x", [1]):
        (out / LIST).write_text(str(names).replace("'", '"'))
        for path in written:
            path.unlink()
        build_leaderboard(results, out, with_figures=True)
    assert victim.exists()
    assert (out / "figures").is_dir()


def test_a_file_that_no_board_wrote_is_never_written_over(tmp_path):
    (tmp_path / "leaderboard.csv").write_text("mine")
    with pytest.raises(InputError, match=r"that no board wrote: leaderboard\.csv\. Choose another"):
        write_board(tmp_path, {"leaderboard.csv": b"ours", "leaderboard.md": b"ours"})
    assert (tmp_path / "leaderboard.csv").read_text() == "mine"
    assert not (tmp_path / "leaderboard.md").exists()


def test_class_names_may_hold_signs_too(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "tests.leaderboard.records.CLASSES", ["$a_b_c$ and $x^y^z$", "=1", "a|b", "<b>"]
    )
    assert CLASSES[0] == "bottle"
    add(tmp_path / "r", "one", 0.5)
    build_leaderboard(tmp_path / "r", tmp_path / "b")
    assert "$a_b_c$" in (tmp_path / "b" / "leaderboard.html").read_text()
