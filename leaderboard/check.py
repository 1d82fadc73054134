"""Whether a folder of records can be trusted: everything that is wrong, at once."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from partialbench.benchmark.records import results
from partialbench.benchmark.records.results import SUFFIX, Result
from partialbench.benchmark.records.trials import FILE, read_trials
from partialbench.benchmark.testing import metrics
from partialbench.errors import InputError


def problems(folder: Path, recompute: bool = True) -> list[str]:
    """One sentence for each thing that is wrong with the records of ``folder``; empty when sound.

    Found are: records that are unreadable, incomplete or edited after they were written; prediction
    files that are missing or not their record's; two records of one run; seeds of one row that two
    versions of a user's model file made; prediction files that belong to no record; a
    ``tuning.csv`` that is not one; and, with ``recompute``, scores that the stored predictions do
    not give.
    """
    if not folder.is_dir():
        return [f"no results folder at {folder}"]
    found: list[str] = []
    seen: dict[tuple[object, ...], Path] = {}
    codes: dict[tuple[object, ...], tuple[str, Path]] = {}
    named: set[str] = set()
    for path in sorted(folder.glob(f"*{SUFFIX}")):
        try:
            result = results.read(path)
        except InputError as error:
            found.append(str(error))
            # Its predictions are not to be called orphans because of that.
            named.add(path.name.removesuffix(SUFFIX) + ".predictions.npz")
            continue
        named.add(result.predictions_file)
        if result.identity in seen:
            found.append(results.duplicate_message(path, seen[result.identity], result))
        seen.setdefault(result.identity, path)
        code, other = codes.setdefault((result.row, *result.column), (result.model_code, path))
        if code != result.model_code:
            found.append(
                f"{path} and {other} are seeds of one row, {result.row}, but the model's file was "
                f"another (SHA-256 {result.model_code[:12]}, {code[:12]}); train both with one, or "
                f"give the other a name of its own"
            )
        found += _predictions_problems(folder, path, result, recompute)
    found += [
        f"{path} belongs to no record; delete it"
        for path in sorted(folder.glob("*.predictions.npz"))
        if path.name not in named
    ]
    try:
        read_trials(folder / FILE)
    except InputError as error:
        found.append(str(error))
    return found


def _same(ours: Any, recorded: Any) -> bool:
    """Equal scores, numbers to rounding: another processor sums in another order."""
    if isinstance(ours, dict) and isinstance(recorded, dict):
        return ours.keys() == recorded.keys() and all(_same(ours[k], recorded[k]) for k in ours)
    if isinstance(ours, list) and isinstance(recorded, list):
        return len(ours) == len(recorded) and all(map(_same, ours, recorded))
    if isinstance(ours, float) and isinstance(recorded, float):
        return math.isclose(ours, recorded, rel_tol=1e-9, abs_tol=1e-12)
    return ours == recorded


def _predictions_problems(folder: Path, path: Path, result: Result, recompute: bool) -> list[str]:
    try:
        predictions = results.read_predictions(folder, result)
    except InputError as error:
        return [str(error)]
    if not recompute:
        return []
    scores = metrics.scores(
        predictions, result.train_data.class_names, result.test_data.class_names
    )
    wrong = [name for name in scores if not _same(scores[name], result.scores.get(name))]
    if not wrong:
        return []
    return [
        f"{path}: the stored predictions give another {', '.join(wrong)} than the record says "
        f"(accuracy {scores['accuracy']:.4f}, recorded {result.scores.get('accuracy')})"
    ]
