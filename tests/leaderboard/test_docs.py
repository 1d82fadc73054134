"""The page on the leaderboard against the code: its columns, its commands, its figures."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import pytest
import typer

from leaderboard.build import build_leaderboard
from partialbench.cli import app
from tests.leaderboard.records import add, small_board

DOCS = Path(__file__).resolve().parents[2] / "docs"
TEXT = (DOCS / "leaderboard.md").read_text()
PAGES = ["leaderboard.md", "protocol.md", "conditions.md", "own_model.md"]


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    root = tmp_path_factory.mktemp("docs")
    small_board(root / "results")
    add(root / "results", "more", 0.8, digest="d", duplicates=3)
    build_leaderboard(root / "results", root / "board", with_figures=True)
    return root / "board"


def test_every_column_is_explained(board):
    meanings = re.search(r"\| column \| meaning \|(.*?)\n\n", TEXT, re.S)[1]
    explained = {
        name.strip() for row in meanings.splitlines()[2:] for name in row.split("|")[1].split(",")
    }
    heads = {
        head.strip()
        for line in (board / "leaderboard.md").read_text().splitlines()
        if line.startswith("| model |")
        for head in line.split("|")[1:-1]
    }
    assert len(heads) > 10
    assert {h for h in heads if not h.startswith("paper, ")} - explained == set()
    with open(board / "leaderboard.csv", newline="") as file:
        names = next(csv.reader(file))
    assert [n for n in names if n not in explained and f"`{n}`" not in TEXT] == []


def test_every_file_it_names_is_made(board):
    for name in re.findall(r"`(leaderboard\.\w+)`", TEXT):
        assert (board / name).is_file()
    assert any((board / "figures").glob("*.svg"))


@pytest.mark.parametrize("page", PAGES)
def test_every_option_of_a_command_exists(page):
    commands = typer.main.get_command(app).commands
    lines = re.findall(
        r"^(?:torchrun .*-m partialbench\.cli|partialbench) (\w+) (.*)", (DOCS / page).read_text(),
        re.M,
    )  # fmt: skip
    assert len(lines) >= 3
    for verb, rest in lines:
        known = {name for parameter in commands[verb].params for name in parameter.opts}
        assert set(re.findall(r"--[a-z-]+", rest)) <= known, (verb, rest)


@pytest.mark.parametrize("page", PAGES)
def test_options_named_in_passing_exist(page):
    commands = typer.main.get_command(app).commands.values()
    known = {name for c in commands for parameter in c.params for name in parameter.opts}
    assert set(re.findall(r"`(--[a-z-]+)", (DOCS / page).read_text())) <= known
