"""A row of the page as JSON data: the figures of its line, and what it opens to."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leaderboard.board import Cell, Column, ranked
from leaderboard.comparison import LEVEL, Comparison, counted
from leaderboard.page.command import reproduce
from leaderboard.words import crosses, model_input, paper_score, row_title
from partialbench.benchmark.records.origin import clouds_before
from partialbench.benchmark.records.predictions import Predictions
from partialbench.benchmark.records.results import Result
from partialbench.benchmark.testing.metrics import confusion

CONFUSIONS = 40
"""Pairs of classes that a row keeps, the most frequent first."""
BINS = 10
"""Of the reliability diagram."""
LOG_POINTS = 24
"""Of a training curve; a longer one is thinned."""
_GITHUB = re.compile(r"([A-Za-z0-9_.-]+/[A-Za-z0-9_.-]+)@([0-9a-f]{7,40})")
_ARXIV = re.compile(r"arXiv:(\d{4}\.\d{4,5})")


def main_rows(column: Column) -> list[str]:
    """One row a model, best first: as its card declares it.

    A variant stands for its model only where that was not run as declared; then it is the most
    accurate one. The best of many variants would be chosen on the test set.
    """
    chosen: dict[str, str] = {}
    for name in ranked(column):
        result = column.cells[name].results[0]
        if not result.variant or result.model not in chosen:
            chosen[result.model] = name
    return sorted(chosen.values(), key=lambda name: (-column.cells[name].mean(), name))


def rows_of(column: Column, comparison: Comparison, folder: Path) -> list[dict[str, Any]]:
    """Every row of a column, best first."""
    main = main_rows(column)
    return [_row(column, comparison, name, main, folder) for name in ranked(column)]


def _row(
    column: Column, comparison: Comparison, name: str, main: list[str], folder: Path
) -> dict[str, Any]:
    cell = column.cells[name]
    first, cost, scores = cell.results[0], cell.cost, cell.results[0].scores
    low, high = comparison.intervals[name]
    alone = scores["accuracy_without_duplicates"] is not None and scores["duplicates"]
    training = first.training
    paper = paper_score(column, first)
    return {
        "id": name,
        "model": first.model,
        "title": row_title(first),
        "main": name in main,
        "rank": _ranks(main, comparison).get(name),
        "accuracy": _exact(cell.mean()),
        "std": _exact(cell.std()),
        "low": _exact(low),
        "high": _exact(high),
        "behind": _behind(main[0], name, comparison),
        "groups": " ".join(map(str, comparison.groups[name])),
        "over_classes": _exact(cell.mean("class_accuracy")),
        "without_duplicates": _exact(cell.mean("accuracy_without_duplicates")) if alone else None,
        "shared": _exact(cell.mean("restricted_accuracy")) if crosses(column) else None,
        "calibration": _exact(cell.mean("calibration_error")),
        "pose": cell.pose and {name: _exact(v) for name, v in cell.pose._asdict().items()},
        "claims": sorted(first.card["invariances"]),
        "turned": _exact(cell.drift),
        "input": model_input(first),
        "parameters": cost["parameters"],
        "multiply_adds": cost["multiply_adds"],
        "milliseconds": _exact(cost["batch_ms"]),
        "memory": training["peak_memory_bytes"],
        "seen": training["clouds_seen"] + clouds_before(training.get("start")),
        "minutes": _exact(training["seconds"] / 60),
        "seeds": cell.seeds,
        "date": cell.date or None,
        "paper": None if paper is None else _exact(paper / 100),
        "more": _details(column, cell, folder),
    }  # fmt: skip


def _ranks(main: list[str], comparison: Comparison) -> dict[str, int]:
    """1 and one more for each row that is better beyond doubt (the paired test, Holm's level).

    Never less than that of the row above: a row may be told apart from fewer than one before it.
    """
    ranks: dict[str, int] = {}
    for place, name in enumerate(main):
        better = sum(
            comparison.p_values.get((other, name), 1.0) <= LEVEL
            and comparison.differences[other, name][0] > 0
            for other in main[:place]
        )
        ranks[name] = max([1 + better, *ranks.values()])
    return ranks


def _behind(best: str, name: str, comparison: Comparison) -> list[float | None] | None:
    """Points behind the first line, with the interval; negative for a variant that is ahead."""
    if (best, name) in comparison.differences:
        return [_exact(value) for value in comparison.differences[best, name]]
    if (name, best) in comparison.differences:
        mean, low, high = comparison.differences[name, best]
        return [_exact(value) for value in (-mean, -high, -low)]
    return None


def _details(column: Column, cell: Cell, folder: Path) -> dict[str, Any]:
    # One seed's, whose minutes the row's line has too: two may have run on two machines.
    first, training = cell.results[0], cell.results[0].training
    tested = [counted(result, folder) for result in cell.results]
    environments = [*training.get("earlier_environments", []), training["environment"]]
    return {
        "command": reproduce(cell.results),
        "deviations": first.deviations,
        "per_class": [[label, _printed(share)] for label, share in cell.per_class.items()],
        "confusions": _confusions(first, tested),
        "reliability": _reliability(tested),
        "ensemble": _mean_curve([r.scores["ensemble"] for r in cell.results]),
        "top_k": _mean_curve([(r.scores["pose"] or {}).get("top_k") for r in cell.results]),
        "log": {
            title: _log(training, key)
            for key, title in (("train_loss", "training loss"),
                               ("validation_accuracy", "validation accuracy"))
        },
        "training": {
            "seed": first.seed,
            "clouds": training["clouds_seen"],
            "minutes": _exact(training["seconds"] / 60),
            "per_second": round(training["clouds_per_second"]),
            "device": ", then ".join(
                dict.fromkeys(f"{place['device']} ({place['cpu']})" for place in environments)
            ),
            "commit": (training["environment"]["git_commit"] or "none")[:12],
            "weights": [r.weights_sha256[:12] for r in cell.results],
            "seeds": [r.seed for r in cell.results],
        },
    }  # fmt: skip


def _confusions(first: Result, tested: list[tuple[Predictions, NDArray]]) -> list[list[Any]]:
    """[true class, named class, share of the true class's clouds], over all seeds."""
    names = first.train_data.class_names
    counts = sum(confusion(label, p.predicted, len(names)) for p, label in tested)
    assert isinstance(counts, np.ndarray)
    totals = counts.sum(axis=1)
    wrong = counts - np.diag(np.diag(counts))
    order = np.argsort(-wrong, axis=None, kind="stable")[:CONFUSIONS]
    return [
        [int(i), int(j), _printed(float(wrong[i, j] / totals[i]))]
        for i, j in zip(*np.unravel_index(order, wrong.shape), strict=True)
        if wrong[i, j]
    ]


def _reliability(tested: list[tuple[Predictions, NDArray]]) -> list[list[Any]]:
    """[mean confidence, share that is right, clouds] of equal bins of confidence that have any."""
    confidence = np.concatenate(
        [np.exp(p.log_probabilities[:, 0].astype(float)) for p, _ in tested]
    )
    right = np.concatenate([p.predicted == label for p, label in tested])
    which = np.clip(np.ceil(confidence * BINS).astype(int) - 1, 0, BINS - 1)
    return [
        [_short(float(confidence[here].mean())), _short(float(right[here].mean())), int(here.sum())]
        for here in (which == i for i in range(BINS))
        if here.any()
    ]


def _mean_curve(seeds: list[Any]) -> list[float | None]:
    return [_short(float(v)) for v in np.mean(seeds, axis=0)] if all(seeds) else []


def _log(training: dict[str, Any], key: str) -> list[list[float | None]]:
    """[clouds seen, value] of at most ``LOG_POINTS`` lines, the first and the last among them.

    Lines are as far apart as the training wrote them: a branch writes more of them. Where a record
    does not say at how many clouds, they are the ends of its epochs, which are equally long.
    """
    curve, values = training["curve"], training["curve"][key]
    ends = np.linspace(0, training["clouds_seen"], len(values) + 1)[1:].tolist()
    clouds = curve.get("clouds_seen", ends)
    chosen = np.unique(np.linspace(0, len(values) - 1, min(LOG_POINTS, len(values))).round())
    kept = [[clouds[int(i)], _short(values[int(i)])] for i in chosen]
    return [] if any(value is None for _, value in kept) else kept


def _exact(value: float | None) -> float | None:
    """None for what is not a number. What is rounded twice may be told otherwise than in a table
    that rounds once: 0.27746 as 27.7 %, and 0.2775 as 27.8 %.
    """
    return None if value is None or math.isnan(value) else value


def _printed(share: float) -> float:
    """A share rounded once, to what is printed of it in %."""
    return float(f"{100 * share:.1f}") / 100


def _short(value: float | None) -> float | None:
    """Four digits, for figures; None for what is not a number."""
    return None if value is None or math.isnan(value) else float(f"{value:.4g}")


def card(result: Result) -> dict[str, Any]:
    """What the page shows of a model's card; links are of (text, address) pairs."""
    stored = result.card
    return {
        "title": stored["title"],
        "paper": stored["paper"],
        "reference": stored["reference"],
        "licence": stored["reference_licence"],
        "choices": list(stored["choices"]),
        "deviations": list(stored["deviations"]),
        "links": [
            *([f"arXiv:{found}", f"https://arxiv.org/abs/{found}"]
              for found in _ARXIV.findall(stored["paper"])),
            *([f"{name}@{commit[:7]}", f"https://github.com/{name}/tree/{commit}"]
              for name, commit in _GITHUB.findall(stored["reference"])),
        ],
    }  # fmt: skip
