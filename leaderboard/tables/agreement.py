"""Whether data sets rank the models alike: what a parametric set says of the real one."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

from scipy.stats import kendalltau, spearmanr

from leaderboard.board import Column, own_columns
from leaderboard.tables.layouts import Layout

FEWEST_ROWS = 4
"""Of fewer rows an order says next to nothing."""
AGREEMENT = ("rows", "Spearman's ρ", "Kendall's τ")
"""The columns that ``agree`` fills."""


def rank_agreement(board: list[Column]) -> list[Layout]:
    """A table of rank correlations over the pairs of columns with enough rows in common, or none.

    Only columns that were trained and tested on one data set are compared, and only rows that both
    have.
    """
    rows = []
    for one, other in itertools.combinations(own_columns(board), 2):
        agreement = agree(accuracies(one), accuracies(other))
        if agreement:
            rows.append([one.title, other.title, *agreement])
    if not rows:
        return []
    return [
        Layout(
            "Do the data sets rank the models alike?",
            "Rank correlation of the accuracies of the rows that two columns share: 1 is the same "
            "order, −1 the opposite one. Columns of two protocols differ in their budgets too.",
            ["column", "other column", *AGREEMENT],
            rows,
        )
    ]


def accuracies(column: Column) -> dict[str, float]:
    """Row name → accuracy, the mean of its seeds."""
    return {name: cell.mean() for name, cell in column.cells.items()}


def agree(one: Mapping[str, float], other: Mapping[str, float]) -> list[str] | None:
    """How many names both have, and the rank correlations of their figures, as printed.

    Spearman's ρ is of the ranks; Kendall's τ_b is the share of pairs in the same order minus the
    share in the opposite one. None for fewer than ``FEWEST_ROWS`` names, and where all figures of
    one side are equal: there is no order to agree on.
    """
    shared = sorted(one.keys() & other.keys())
    here, there = ([figures[name] for name in shared] for figures in (one, other))
    if len(shared) < FEWEST_ROWS or min(len(set(here)), len(set(there))) == 1:
        return None
    rho, tau = spearmanr(here, there).statistic, kendalltau(here, there).statistic
    return [str(len(shared)), f"{rho:+.2f}", f"{tau:+.2f}"]
