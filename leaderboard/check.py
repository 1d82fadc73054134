"""Whether a folder of records can be trusted: everything that is wrong, at once."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from leaderboard import consistency
from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.protocol import recipe as recipes
from partialbench.benchmark.records import results, testsets
from partialbench.benchmark.records.results import PREDICTIONS_SUFFIX, SUFFIX, Result
from partialbench.benchmark.records.testsets import GroundTruth
from partialbench.benchmark.records.trials import FILE, read_trials
from partialbench.errors import InputError

Found = dict[Path, Result]
"""The readable records of a folder, by path."""
Tested = dict[Path, tuple[NDArray, NDArray]]
"""Record → which rows of its test split it was tested on, and which of these are duplicates."""


def problems(folder: Path, recompute: bool = True) -> list[str]:
    """One sentence for each thing that is wrong with the records of ``folder``; empty when sound.

    Found are: records that are unreadable, incomplete, of another format or edited after they were
    written; entries that contradict each other (the protocol and its digest, milestone, steps,
    clouds seen and curve; the row's name and the options, recipe, start and precision), the names
    of the record's files, its test set or another record of the same row or data; prediction and
    test set files that are missing, damaged or not their record's, or that no model can have given;
    two records of one run, answers or weights of one training under two; records of one column, or
    of a condition beside it, with other test clouds or other duplicates; prediction files that
    belong to no record; a ``tuning.csv`` that is not one. With ``recompute`` also: scores that the
    stored predictions do not give, and cards and numbers of parameters that the registry does not
    have.
    """
    if not folder.is_dir():
        return [f"no results folder at {folder}"]
    wrong: list[str] = []
    found: Found = {}
    tested: Tested = {}
    named: set[str] = set()
    # Before the records: while tests are going on, a file's record comes right after it.
    predictions = sorted(folder.glob(f"*{PREDICTIONS_SUFFIX}"))
    for path in sorted(folder.glob(f"*{SUFFIX}")):
        # Where it cannot be read, its predictions are not to be called orphans because of that.
        named.add(path.name.removesuffix(SUFFIX) + PREDICTIONS_SUFFIX)
        try:
            result = results.read(path)
        except InputError as error:
            wrong.append(str(error))
            continue
        named.add(result.predictions_file)
        found[path] = result
        wrong += _names(path, result)
        wrong += [f"{path}: {fault}" for fault in consistency.own_faults(result)]
        try:
            wrong += [f"{path}: {fault}" for fault in consistency.truth_faults(folder, result)]
            said = results.read_predictions(folder, result)
            tested[path] = said.rows, said.duplicate
            faults = consistency.score_faults(folder, result) if recompute else ()
            wrong += [f"{path}: {fault}" for fault in faults]
        except InputError as error:
            wrong.append(str(error))
        if recompute:
            wrong += [f"{path}: {fault}" for fault in consistency.registry_faults(result)]
    wrong += [*_same_runs(found), *_unlike_trainings(found), *_weights(found), *_unlike_data(found)]
    wrong += [*_truths(folder, found), *_unlike_tests(found, tested)]
    wrong += [
        f"{path} belongs to no record; delete it" for path in predictions if path.name not in named
    ]
    try:
        read_trials(folder / FILE)
    except InputError as error:
        wrong.append(str(error))
    return wrong


def _names(path: Path, result: Result) -> Iterator[str]:
    """A run has its name, and so have its predictions."""
    stem = result.run_name
    if path.name != stem + SUFFIX:
        yield f"{path} is the record of another run than its name says, {stem}{SUFFIX}"
    if result.predictions_file != stem + PREDICTIONS_SUFFIX:
        yield f"{path} names the predictions of another run, {result.predictions_file}"


def _same_runs(found: Found) -> Iterator[str]:
    seen: dict[tuple[object, ...], Path] = {}
    for path, result in found.items():
        other = seen.setdefault(result.identity, path)
        if other != path:
            yield results.duplicate_message(path, other, result)


def _unlike_trainings(found: Found) -> Iterator[str]:
    """Seeds and milestones of one row are trainings of one thing, whatever they are tested on."""
    first: dict[tuple[object, ...], tuple[Path, Result]] = {}
    for path, result in found.items():
        train = result.train_data
        row = (result.row, train.id, train.setting, train.digest, result.protocol_digest)
        other, before = first.setdefault(row, (path, result))
        if before.model_code != result.model_code:
            yield (
                f"{path} and {other} are of one row, {result.row}, but the model's file was "
                f"another (SHA-256 {result.model_code[:12]}, {before.model_code[:12]}); train both "
                f"with one, or give the other a name of its own"
            )
        unlike = [
            f"{name} ({now!r}, {then!r})"
            for name, now, then in (
                ("options", result.options, before.options),
                ("recipe", recipes.of_training(result.recipe), recipes.of_training(before.recipe)),
                ("parameters", result.cost["parameters"], before.cost["parameters"]),
                ("training clouds", result.train_data.clouds, before.train_data.clouds),
            )
            if now != then
        ]
        if unlike:
            yield (
                f"{path} and {other} are of one row, {result.row}, but differ in "
                f"{', '.join(unlike)}; train both alike"
            )


def _weights(found: Found) -> Iterator[str]:
    """One training is tested with one set of weights, and two trainings end with two."""
    tested: dict[tuple[object, ...], tuple[Path, str]] = {}
    trained: dict[tuple[object, ...], tuple[Path, dict[str, str]]] = {}
    for path, result in found.items():
        train, weights = result.train_data, result.weights_sha256
        row = (
            result.row, train.id, train.setting, train.digest, result.protocol_digest,
            result.clouds,
        )  # fmt: skip
        other, before = tested.setdefault((*row, result.seed), (path, weights))
        if before != weights:
            yield (
                f"{path} and {other} are tests of one training, {result.row}, seed {result.seed}, "
                f"but of other weights (SHA-256 {weights[:12]}, {before[:12]}); test the same "
                f"checkpoint on both"
            )
        if not result.cost["parameters"] or not result.recipe["lr"]:
            continue  # nothing learns
        answers = (result.row, *result.column, result.predictions_sha256)
        training = _training(result)
        for what, same in (("weights", (result.model, weights)), ("answers", answers)):
            other, of_other = trained.setdefault(same, (path, training))
            unlike = [
                f"{name} {now} and {of_other[name]}"
                for name, now in training.items()
                if now != of_other[name]
            ]
            if unlike:
                yield (
                    f"{path} and {other} have the same {what} under the {', '.join(unlike)}: one "
                    f"training counts once"
                )
                break


def _training(result: Result) -> dict[str, str]:
    """What never leaves the weights of a training as they are, by name.

    Options, recipe and protocol may: some of their fields are of the test alone, or of what a model
    does not do.
    """
    return {"seeds": str(result.seed), "milestones": milestones.name(result.clouds)}


def _unlike_data(found: Found) -> Iterator[str]:
    """What records say of one training split under one protocol is the same."""
    told: dict[tuple[object, ...], tuple[Path, tuple[object, ...]]] = {}
    for path, result in found.items():
        data = result.train_data
        says = (data.class_names, data.clouds, data.objects, data.points, data.sensor)
        key = (data.id, data.setting, data.digest, result.protocol_digest)
        other, before = told.setdefault(key, (path, says))
        names = ("class names", "clouds", "objects", "points", "sensor")
        unlike = [n for n, now, then in zip(names, says, before, strict=True) if now != then]
        if unlike:
            yield (
                f"{path} and {other} were trained on one split ({data.digest[:12]}) by one "
                f"protocol, but tell of other {', '.join(unlike)} of it"
            )


def _truths(folder: Path, found: Found) -> Iterator[str]:
    """What is true of a test cloud is so in every record of that test split."""
    known: dict[str, list[tuple[str, Path, GroundTruth]]] = {}
    for path, result in found.items():
        try:
            truth = testsets.load(folder, result.test_set_sha256)
        except InputError:  # told already
            continue
        others = known.setdefault(result.test_data.digest, [])
        if any(digest == result.test_set_sha256 for digest, _, _ in others):
            continue
        for _, other, before in others:
            unlike = _unlike(truth, before)
            if unlike:
                yield (
                    f"{path} and {other} were tested on one test split "
                    f"({result.test_data.digest[:12]}) but were held against other "
                    f"{', '.join(unlike)} of its clouds; test again what does not fit the data "
                    f"(the board's --data tells which)"
                )
        others.append((result.test_set_sha256, path, truth))


def _unlike_tests(found: Found, tested: Tested) -> Iterator[str]:
    """What is set side by side was tested on the same clouds, and the same of them are duplicates.

    The protocol says which clouds of a split are tested, whatever is done to them; the two data
    sets say which are duplicates.
    """
    first: dict[tuple[object, ...], Path] = {}
    for path, (rows, duplicate) in tested.items():
        result = found[path]
        train, test = result.train_data, result.test_data
        split = (
            train.id, train.setting, train.digest, test.id, test.setting, test.digest,
            result.protocol_digest,
        )  # fmt: skip
        other = first.setdefault(split, path)
        if not np.array_equal(rows, tested[other][0]):
            yield (
                f"{path} was tested on {len(rows):,} clouds and {other} on "
                f"{len(tested[other][0]):,}, of which {np.isin(rows, tested[other][0]).sum():,} "
                f"are the same: one protocol tests the same clouds of one test split "
                f"({test.digest[:12]}) always; test again what does not"
            )
            continue
        # What the training before this one has seen is a duplicate as well.
        start = json.dumps(result.training.get("start"), sort_keys=True)
        other = first.setdefault((*split, start), path)
        unlike = np.count_nonzero(duplicate != tested[other][1])
        if unlike:
            yield (
                f"{path} and {other} were trained and tested on the same data, but of {unlike:,} "
                f"test clouds one says that they are of a training object's bytes and the other "
                f"that they are not; test both checkpoints again"
            )


def against_data(folder: Path, truth_of: Sequence[tuple[str, GroundTruth]]) -> list[str]:
    """A sentence for each test set of the folder that is not what the data say.

    Args:
        truth_of: (digest, truth) of whole test splits.
    """
    wrong = []
    told: set[tuple[str, str]] = set()
    for path in sorted(folder.glob(f"*{SUFFIX}")):
        result = results.read(path)
        for digest, whole in truth_of:
            key = digest, result.test_set_sha256
            if result.test_data.digest != digest or key in told:
                continue
            told.add(key)
            truth = testsets.load(folder, result.test_set_sha256)
            unlike = _unlike(truth, whole)
            if not np.isin(truth.rows, whole.rows).all():
                unlike.append("rows")
            if unlike:
                wrong.append(
                    f"{path} was held against other {', '.join(unlike)} than its data have "
                    f"({digest[:12]}); test its checkpoint again"
                )
    return wrong


def _unlike(one: GroundTruth, other: GroundTruth) -> list[str]:
    """In what two truths differ about the rows that both have."""
    _, here, there = np.intersect1d(one.rows, other.rows, return_indices=True)
    return [
        name
        for name, values in one.truth_arrays.items()
        if not (
            np.array_equal(values, other.truth_arrays[name])
            if name == "class_names"
            else np.array_equal(values[here], other.truth_arrays[name][there])
        )
    ]
