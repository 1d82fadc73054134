"""The committed records are sound, and the committed tables are what they say."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from leaderboard import claims
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


@pytest.mark.parametrize("page", ["README.md", "docs/sceptic.md"])
def test_pages_show_the_tables_that_the_records_make(rebuilt, page):
    text = (ROOT / page).read_text()
    tables = re.findall(r"<!-- leaderboard: .*? -->\n(.*?)<!-- end -->", text, re.S)
    assert tables
    # Header and rule, then the rows.
    assert all(len(table.splitlines()) > 2 for table in tables)
    assert fill(text, (rebuilt / "leaderboard.md").read_text()) == text


def test_the_findings_answer_what_the_records_answer():
    findings = (ROOT / "docs" / "findings.md").read_text()
    assert claims.fill(findings, RECORDS) == findings
