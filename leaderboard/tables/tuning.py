"""The trials of ``partialbench tune`` as tables: what each model was given, the lost ones too."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from leaderboard.board import Column, own_columns
from leaderboard.tables.agreement import AGREEMENT, accuracies, agree
from leaderboard.tables.layouts import Layout
from leaderboard.words import engineering, percent
from partialbench.benchmark.records.results import Result
from partialbench.benchmark.records.trials import FILE, Trial, read_trials
from partialbench.benchmark.variant import with_changes

AS_IT_IS = "as it is"


def tuning_layouts(folder: Path, records: Sequence[Result], board: list[Column]) -> list[Layout]:
    """A table for each data set and protocol that the trials in the folder were made under.

    After each stands, where there is enough to compare, whether models rank in the board's columns
    as they do in those trials: there all had the same budgets, in a column they may not.

    Args:
        folder: of the records; its ``tuning.csv`` is read where there is one.
        records: models and data sets are called what these call them.

    Raises:
        InputError: a ``tuning.csv`` that is not one.
    """
    groups: dict[tuple[str, str, int], list[Trial]] = defaultdict(list)
    for trial in read_trials(folder / FILE):
        groups[trial.data, trial.protocol, trial.seed].append(trial)
    titles = {record.model: record.card["title"] for record in records}
    data = {record.train_data.digest: record.train_data.id for record in records}
    found = []
    for (digest, protocol, seed), trials in sorted(groups.items()):
        where = f"{data.get(digest, 'data')} ({digest[:12]})"
        name = f"on {where}, protocol {protocol[:12]}, seed {seed}"
        found.append(_layout(name, trials, titles))
        found += _agreement(name, trials, board)
    return found


def _agreement(name: str, trials: list[Trial], board: list[Column]) -> list[Layout]:
    best: dict[str, float] = {}
    for trial in trials:
        best[trial.row] = max(best.get(trial.row, 0.0), trial.validation_accuracy or 0.0)
    rows = []
    for column in own_columns(board):
        agreement = agree(best, accuracies(column))
        if agreement:
            rows.append([column.title, *agreement])
    if not rows:
        return []
    return [
        Layout(
            f"Do the columns rank the models as tuning did? Tuning {name}",
            "Rank correlation of each model's best validation accuracy in those trials, in which "
            "all had the same budgets, with its accuracy in the column.",
            ["column", *AGREEMENT],
            rows,
        )
    ]


def _layout(name: str, trials: list[Trial], titles: dict[str, str]) -> Layout:
    recipes = sorted({trial.recipe for trial in trials}, key=_by_number)
    models: dict[str, list[Trial]] = defaultdict(list)
    for trial in trials:
        title = titles.get(trial.model, trial.model)
        models[with_changes(title, trial.options)].append(trial)
    rows = []
    for title, tried in models.items():
        scores = {trial.recipe: trial.validation_accuracy for trial in tried}
        found = {recipe: score for recipe, score in scores.items() if score is not None}
        diverged = {trial.recipe for trial in tried if trial.diverged}
        best = [
            recipe or AS_IT_IS
            for recipe in recipes
            if len(found) > 1 and found.get(recipe) == max(found.values())
        ]
        rows.append(
            [
                title,
                _clouds_seen(tried),
                *(
                    percent(found[r], None) if r in found else "diverged" if r in diverged else "–"
                    for r in recipes
                ),
                ", ".join(best) or "–",
            ]
        )
    rows.sort(key=lambda row: row[0])
    return Layout(
        f"Tuning {name}",
        "Accuracy (%) on the validation split after a training with each recipe, by "
        "partialbench tune; the test split was not opened.",
        ["model", "clouds seen", *(recipe or AS_IT_IS for recipe in recipes), "best"],
        rows,
    )


def _by_number(recipe: str) -> list[tuple[str, float, str]]:
    """For sorting: "epochs=2" comes before "epochs=16", "lr=0.003" before "lr=0.01"."""
    key = []
    for part in recipe.split():
        name, _, value = part.partition("=")
        try:
            key.append((name, float(value), ""))
        except ValueError:
            key.append((name, math.inf, value))
    return key


def _clouds_seen(trials: list[Trial]) -> str:
    """The least and the most of the trials, where they are not one."""
    seen = [trial.clouds_seen for trial in trials if not trial.diverged] or [0]
    return " – ".join(dict.fromkeys(map(engineering, (min(seen), max(seen)))))
