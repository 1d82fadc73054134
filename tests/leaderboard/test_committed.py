"""The committed records are sound, and the committed tables are what they say."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from leaderboard.build import build_leaderboard

ROOT = Path(__file__).parents[2]
RECORDS, BOARD = ROOT / "leaderboard" / "records", ROOT / "docs" / "board"


@pytest.fixture(scope="module")
def rebuilt(tmp_path_factory):
    out = tmp_path_factory.mktemp("board")
    build_leaderboard(RECORDS, out, check=True)
    return out


@pytest.mark.parametrize(
    "name", ["leaderboard.md", "leaderboard.csv", "differences.csv", "curves.csv"]
)
def test_the_tables_are_made_from_the_records_alone(rebuilt, name):
    assert (rebuilt / name).read_bytes() == (BOARD / name).read_bytes()


def test_the_readme_shows_the_table_that_the_records_make(rebuilt):
    """Row by row: the README's columns are some of those of the table it names."""
    readme = (ROOT / "README.md").read_text()
    shown = re.search(r"<!-- leaderboard: (.*?) -->\n(.*?)<!-- end -->", readme, re.S)
    assert shown is not None
    made = (rebuilt / "leaderboard.md").read_text()
    (section,) = (part for part in made.split("\n## ") if part.startswith(f"{shown[1]}\n"))
    table = [line for line in section.splitlines() if line.count("|") > 9]
    rows = {line.split("|")[1].strip(): line for line in table[2:]}
    lines = [line for line in shown[2].splitlines() if line.startswith("|")][2:]
    assert len(lines) == len(rows) >= 3
    for line in lines:
        model, *figures = (cell.strip() for cell in line.strip("|").split("|"))
        there = [cell.strip() for cell in rows[model].split("|")]
        assert [f for f in figures if f not in there] == []
