"""Whether data sets rank the models alike: what a parametric set says of the real one."""

from __future__ import annotations

import itertools

from scipy.stats import kendalltau, spearmanr

from leaderboard.board import Column, ranked
from leaderboard.layouts import Layout

FEWEST_ROWS = 4
"""Of fewer rows an order says next to nothing."""


def rank_agreement(board: list[Column]) -> list[Layout]:
    """One table of rank correlations for each protocol, over pairs of columns with enough rows.

    Only columns that were trained and tested on one data set are compared, and only rows that both
    have. Spearman's ρ is of the accuracies' ranks; Kendall's τ_b is the share of pairs of models in
    the same order minus the share in the opposite one.
    """
    protocols: dict[str, list[Column]] = {}
    for column in board:
        train_id, setting, _, test_id, test_setting, _, protocol = column.key
        if (train_id, setting) == (test_id, test_setting):
            protocols.setdefault(protocol, []).append(column)
    found = []
    for columns in protocols.values():
        rows = []
        for one, other in itertools.combinations(columns, 2):
            shared = [name for name in ranked(one) if name in other.cells]
            if len(shared) < FEWEST_ROWS:
                continue
            here, there = ([c.cells[n].mean() for n in shared] for c in (one, other))
            if min(len(set(here)), len(set(there))) == 1:
                continue  # all alike: there is no order to agree on
            rho, tau = spearmanr(here, there).statistic, kendalltau(here, there).statistic
            rows.append([one.title, other.title, str(len(shared)), f"{rho:+.2f}", f"{tau:+.2f}"])
        if rows:
            preset = next(iter(columns[0].cells.values())).results[0].protocol["preset"]
            found.append(
                Layout(
                    f"Do the data sets rank the models alike? {preset}",
                    "Rank correlation of the accuracies of the rows that two columns share: 1 is "
                    "the same order, −1 the opposite one.",
                    ["column", "other column", "rows", "Spearman's ρ", "Kendall's τ"],
                    rows,
                )
            )
    return found
