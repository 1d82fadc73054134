"""The trials of ``partialbench tune`` as tables: what each model was given, the lost ones too."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from leaderboard.layouts import Layout
from leaderboard.words import engineering, percent
from partialbench.benchmark.results import Result
from partialbench.benchmark.trials import FILE, Trial, read_trials

AS_IT_IS = "as it is"


def tuning_layouts(folder: Path, records: Sequence[Result]) -> list[Layout]:
    """A table for each data set and protocol that the trials in the folder were made under.

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
    return [_layout(groups[key], titles, data) for key in sorted(groups)]


def _layout(trials: list[Trial], titles: dict[str, str], data: dict[str, str]) -> Layout:
    recipes = sorted({trial.recipe for trial in trials})
    models: dict[str, list[Trial]] = defaultdict(list)
    for trial in trials:
        title = titles.get(trial.model, trial.model)
        models[f"{title} [{trial.options}]" if trial.options else title].append(trial)
    rows = []
    for title, tried in models.items():
        found = {trial.recipe: trial.validation_accuracy for trial in tried}
        best = [
            recipe or AS_IT_IS for recipe in recipes if found.get(recipe) == max(found.values())
        ]
        rows.append(
            [
                title,
                engineering(tried[0].clouds_seen),
                *(percent(found[r], None) if r in found else "–" for r in recipes),
                ", ".join(best),
            ]
        )
    rows.sort(key=lambda row: row[0])
    first = trials[0]
    return Layout(
        f"Tuning on {data.get(first.data, 'data')} ({first.data[:12]}), "
        f"protocol {first.protocol[:12]}, seed {first.seed}",
        "Accuracy (%) on the validation split after a training with each recipe, by "
        "`partialbench tune`; the test split was not opened.",
        ["model", "clouds seen", *(recipe or AS_IT_IS for recipe in recipes), "best"],
        rows,
    )
