"""Claims are answered by the rows they name, and by nothing that is not there."""

from __future__ import annotations

import pytest

from leaderboard.board import make_board
from leaderboard.claims import CLAIMS, Claim, answers, fill
from partialbench import registry
from partialbench.benchmark.records import results
from partialbench.errors import InputError
from tests.leaderboard.records import predictions, record

CLAIM = Claim("One beats two.", "one", "two")


def line(folder, claim=CLAIM):
    lines = answers(make_board(results.read_folder(folder)), folder, [claim])
    return [cell.strip() for cell in lines[2].split("|")[1:-1]]


def write(folder, model, accuracy, seed=0, **other):
    stored = predictions(accuracy, seed)
    results.write(folder, record(model, stored, seed, **other), stored)


def test_a_row_that_is_not_there_is_no_answer(tmp_path):
    write(tmp_path, "one", 0.9)
    assert line(tmp_path) == ["1", "One beats two.", "not yet", "–", "–", "–", "`one`, `two`"]


@pytest.mark.parametrize(
    ("accuracies", "told"),
    [((0.9, 0.3), "yes"), ((0.3, 0.9), "no"), ((0.6, 0.6), "not told apart")],
)
def test_one_seed_speaks_of_networks(tmp_path, accuracies, told):
    for model, accuracy in zip(("one", "two"), accuracies, strict=True):
        write(tmp_path, model, accuracy)
    cells = line(tmp_path)
    assert cells[2] == f"{told} (two networks)"
    assert cells[4] == "1 and 1"


def test_seeds_speak_of_methods_and_widen_the_interval(tmp_path):
    """Seeds that differ by more than the rows do tell nothing apart, whatever one of them says."""
    for seed, accuracy in enumerate((0.9, 0.3)):
        write(tmp_path, "one", accuracy, seed)
        write(tmp_path, "two", 0.5, seed)
    cells = line(tmp_path)
    assert cells[2] == "not told apart (methods)"
    assert cells[4] == "2 and 2"


def test_the_longest_milestone_of_both_answers(tmp_path):
    write(tmp_path, "one", 0.9, milestone=25_000)
    write(tmp_path, "two", 0.3, milestone=25_000)
    write(tmp_path, "one", 0.3, milestone=50_000)
    write(tmp_path, "two", 0.9, milestone=50_000)
    write(tmp_path, "one", 0.9, milestone=100_000)
    cells = line(tmp_path)
    assert cells[2].startswith("no")
    assert cells[5].endswith("50k")


def test_a_shorter_milestone_answers_too_where_both_rows_have_more_seeds(tmp_path):
    for seed in (0, 1):
        write(tmp_path, "one", 0.9, seed, milestone=25_000)
        write(tmp_path, "two", 0.3, seed, milestone=25_000)
    write(tmp_path, "one", 0.3, milestone=50_000)
    write(tmp_path, "two", 0.9, milestone=50_000)
    lines = answers(make_board(results.read_folder(tmp_path)), tmp_path, [CLAIM])
    surest, longest = ([cell.strip() for cell in line.split("|")] for line in lines[2:])
    assert (surest[3], surest[5], surest[6][-3:]) == ("yes (methods)", "2 and 2", "25k")
    assert (longest[3], longest[5], longest[6][-3:]) == ("no (two networks)", "1 and 1", "50k")


def test_claims_are_of_registered_models():
    for claim in CLAIMS:
        for row in (claim.better, claim.worse):
            assert registry.card(row.partition(" ")[0]).name == row.partition(" ")[0]


def test_a_document_without_the_block_is_refused(tmp_path):
    write(tmp_path, "one", 0.9)
    with pytest.raises(InputError, match="needs one block"):
        fill("# Findings\n", tmp_path)
