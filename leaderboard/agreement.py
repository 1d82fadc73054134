"""Whether data sets rank the models alike: what a parametric set says of the real one."""

from __future__ import annotations

import itertools

from scipy.stats import kendalltau, spearmanr

from leaderboard.board import Column, ranked
from leaderboard.layouts import Layout

FEWEST_ROWS = 4
"""Of fewer rows an order says next to nothing."""


def rank_agreement(board: list[Column]) -> list[Layout]:
    """A table of rank correlations over the pairs of columns with enough rows in common, or none.

    Only columns that were trained and tested on one data set are compared, and only rows that both
    have. Spearman's ρ is of the accuracies' ranks; Kendall's τ_b is the share of pairs of models in
    the same order minus the share in the opposite one.
    """
    own = [c for c in board if (c.key[0], c.key[1]) == (c.key[3], c.key[4])]
    rows = []
    for one, other in itertools.combinations(own, 2):
        shared = [name for name in ranked(one) if name in other.cells]
        if len(shared) < FEWEST_ROWS:
            continue
        here, there = ([c.cells[n].mean() for n in shared] for c in (one, other))
        if min(len(set(here)), len(set(there))) == 1:
            continue  # all alike: there is no order to agree on
        rho, tau = spearmanr(here, there).statistic, kendalltau(here, there).statistic
        rows.append([one.title, other.title, str(len(shared)), f"{rho:+.2f}", f"{tau:+.2f}"])
    if not rows:
        return []
    return [
        Layout(
            "Do the data sets rank the models alike?",
            "Rank correlation of the accuracies of the rows that two columns share: 1 is the same "
            "order, −1 the opposite one. Columns of two protocols differ in their budgets too.",
            ["column", "other column", "rows", "Spearman's ρ", "Kendall's τ"],
            rows,
        )
    ]
