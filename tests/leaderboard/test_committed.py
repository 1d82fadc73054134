"""The committed records are sound, and the committed tables are what they say."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from leaderboard.build import build_leaderboard
from leaderboard.excerpt import fill
from partialbench.benchmark.records.results import SUFFIX

ROOT = Path(__file__).parents[2]
RECORDS, BOARD = ROOT / "leaderboard" / "records", ROOT / "docs" / "board"
pytestmark = pytest.mark.skipif(
    not any(RECORDS.glob(f"*{SUFFIX}")), reason="no records are committed"
)


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


def test_the_readme_shows_the_tables_that_the_records_make(rebuilt):
    readme = (ROOT / "README.md").read_text()
    tables = re.findall(r"<!-- leaderboard: .*? -->\n(.*?)<!-- end -->", readme, re.S)
    # Header and rule, then the rows.
    assert all(len(table.splitlines()) > 2 for table in tables)
    assert fill(readme, (rebuilt / "leaderboard.md").read_text()) == readme
