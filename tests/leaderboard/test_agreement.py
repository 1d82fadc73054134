"""Rank correlation between columns, against orders that can be counted by hand."""

import pytest

from leaderboard.board import make_board
from leaderboard.tables.agreement import rank_agreement
from leaderboard.tables.latex import escape
from partialbench.benchmark.records import results
from tests.leaderboard.records import add

ACCURACIES = {"a": 0.9, "b": 0.7, "c": 0.5, "d": 0.3, "e": 0.1}


def board(folder, second, **other):
    """Five models on one data set, and some of them on another."""
    for name, accuracy in ACCURACIES.items():
        add(folder, name, accuracy)
    for name, accuracy in second.items():
        add(folder, name, accuracy, data="pm40-clouds", digest="c", test_digest="d", **other)
    return make_board(results.read_folder(folder))


@pytest.mark.parametrize(
    ("order", "rho", "tau"),
    [
        ("abcde", "+1.00", "+1.00"),
        ("edcba", "-1.00", "-1.00"),
        # One swap of neighbours: Σd² = 2, ρ = 1 − 6·2/120; nine of ten pairs agree.
        ("bacde", "+0.90", "+0.80"),
    ],
)
def test_orders_that_can_be_counted_by_hand(tmp_path, order, rho, tau):
    second = dict(zip(order, ACCURACIES.values(), strict=True))
    (table,) = rank_agreement(board(tmp_path, second))
    assert [row[2:] for row in table.rows] == [["5", rho, tau]]
    assert "[U+" not in escape(" ".join([table.about, *table.head, *table.rows[0]]))


def test_only_rows_that_both_have_count_and_few_say_nothing(tmp_path):
    assert rank_agreement(board(tmp_path, {"a": 0.9, "b": 0.6, "c": 0.2})) == []


def test_equal_accuracies_have_no_order(tmp_path):
    assert rank_agreement(board(tmp_path, dict.fromkeys(ACCURACIES, 1.0))) == []


def test_columns_of_two_protocols_are_compared_and_say_so(tmp_path):
    (table,) = rank_agreement(board(tmp_path, ACCURACIES, preset="smoke"))
    (row,) = table.rows
    assert [title.split(", ")[2] for title in row[:2]] == ["smoke", "board"]
    assert "two protocols" in table.about
