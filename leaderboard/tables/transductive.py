"""Rows that stand apart: their answer for a cloud hangs on the clouds scored beside it."""

from __future__ import annotations

from collections.abc import Iterable

from leaderboard.tables.layouts import Layout
from leaderboard.words import percent, row_title
from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.records.results import Result


def transductive_layouts(records: Iterable[Result]) -> list[Layout]:
    """A table of the results that no column has for that reason, or none."""
    apart = [result for result in records if set(result.conditions) == {"scored"}]
    if not apart:
        return []
    return [
        Layout(
            "Answers that are not a cloud's own",
            "These models answer for a cloud by the clouds that are scored beside it, so their "
            "accuracy is of a test set in its order, and they are not ranked. Moved: how far their "
            "logits move, in % of their size, when the others in a batch are other ones.",
            ["model", "trained on", "tested on", "clouds", "seed", "accuracy", "moved"],
            [
                [
                    row_title(result),
                    result.train_data.id,
                    result.test_data.id,
                    milestones.name(result.clouds),
                    str(result.seed),
                    percent(result.scores["accuracy"], None),
                    f"{100 * result.company_audit['drift']:.1f}",
                ]
                for result in sorted(apart, key=lambda result: result.run_name)
            ],
        )
    ]
