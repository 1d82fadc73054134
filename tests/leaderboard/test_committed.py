"""The committed records are sound, and the committed tables are what they say."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from leaderboard import claims
from leaderboard.build import build_leaderboard
from leaderboard.excerpt import fill
from partialbench.benchmark.records import results, weights
from partialbench.benchmark.records.results import SUFFIX
from partialbench.benchmark.training import packed

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


PAGES = (
    "README.md",
    *(f"docs/{name}.md" for name in ("sceptic", "grid", "damage", "against_the_paper")),
)


@pytest.mark.parametrize("page", PAGES)
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


def test_the_weights_of_the_best_row_are_those_of_its_record():
    if (ROOT / "PKG-INFO").is_file():
        pytest.skip("a source archive leaves them out")
    folder = ROOT / "leaderboard" / "weights"
    files = list(folder.glob(f"*{weights.SUFFIX}"))
    rows = {record.weights_sha256: record for record in results.read_folder(RECORDS)}
    for file in files:
        card = weights.read_card(file)
        packed.load(file)  # held against the digests of its card
        record = rows[card["checkpoint_sha256"]]
        assert (record.model, record.clouds) == (file.stem, card["clouds"])
        assert card["licence"] != "MIT"
        assert file.stat().st_size <= 4_000_000
    page = (folder / "README.md").read_text()
    assert weights.block({file.stem: weights.read_card(file) for file in files}) in page
    # For research alone: the project's archives leave them out.
    built = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]
    for target in ("wheel", "sdist"):
        assert "leaderboard/weights" in built["targets"][target]["exclude"]
