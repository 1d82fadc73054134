"""Whether one record agrees with itself, with its test set and with the registry."""

from __future__ import annotations

import dataclasses
import json
import logging
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from partialbench import registry
from partialbench.benchmark import models
from partialbench.benchmark.preflight import FULL_PRECISION
from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.protocol import protocol as protocols
from partialbench.benchmark.protocol import recipe as recipes
from partialbench.benchmark.records import results, testsets
from partialbench.benchmark.records.results import Result
from partialbench.benchmark.testing import damage, given_pose, metrics
from partialbench.benchmark.variant import describe_changes, with_changes
from partialbench.dataset import grid
from partialbench.errors import InputError
from partialbench.extras import MissingExtraError
from partialbench.registry import ModelCard, Recipe

log = logging.getLogger(__name__)

PRINTED = ("title", "paper", "paper_scores", "representation", "invariances", "parameters")
"""What of a card the board sets beside others' figures; its prose may have been mended since."""


def own_faults(result: Result) -> Iterator[str]:
    """What a record says that cannot be true, by itself."""
    digest = protocols.from_dict(result.protocol).digest
    if digest != result.protocol_digest:
        yield (
            f"its protocol has the digest {digest[:12]}, it claims {result.protocol_digest[:12]}: "
            f"the column it stands in is another's"
        )
    training = result.training
    try:
        plan = milestones.plan(
            protocols.from_dict(result.protocol), Recipe(**result.recipe), result.clouds,
            result.train_data.clouds,
        )  # fmt: skip
    except (InputError, TypeError) as error:
        yield f"nothing can be trained as it says: {error}"
        return
    done = training["steps"], training["clouds_seen"]
    if done != (plan.steps, plan.clouds_seen):
        yield (
            f"it tells of {done[0]:,} steps and {done[1]:,} clouds seen; to the milestone "
            f"{milestones.name(result.clouds)} on {result.train_data.clouds:,} clouds its protocol "
            f"and recipe take {plan.steps:,} steps, {plan.clouds_seen:,} clouds"
        )
    if result.given_pose:
        try:
            given_pose.parse(result.given_pose)
        except InputError as error:
            yield str(error)
    if result.grid:
        try:
            grid.parse(result.grid)
        except InputError as error:
            yield str(error)
    if result.damage:
        try:
            named = damage.parse(result.damage)
        except InputError as error:
            yield str(error)
        else:
            if named != (result.damage,):
                yield f"{result.damage!r} is not one damage of one strength"
    yield from _curve_faults(training, plan.clouds_seen)
    try:
        changed = _changed(result)
    except InputError as error:
        yield f"nothing tells what was changed about its row: {error}"
        return
    if changed != result.variant:
        yield (
            f"its row is {result.row}, but by its options, recipe, start and precision it is "
            f"{with_changes(result.model, changed)}"
        )


def _curve_faults(training: dict[str, Any], clouds_seen: int) -> Iterator[str]:
    """A training's curve ends where the training does."""
    curve = training["curve"]
    ends = curve.get("clouds_seen", [clouds_seen])[-1:]
    if ends != [clouds_seen]:
        yield f"its curve ends at {ends[0] if ends else 'no'} clouds, it tells of {clouds_seen:,}"
    for name in ("train_loss", "validation_accuracy"):
        told, last = training[name], (curve[name] or [None])[-1]
        if (told is None) != (last is None) or (told is not None and abs(told - last) > 1e-5):
            yield f"its {name} is {told!r}, the last of its curve {last!r}"


def _changed(result: Result) -> str:
    """What was changed about the model, by all that the record says of it but the row's name."""
    card, training = result.card, result.training
    own = recipes.of_protocol(
        ModelCard(
            result.model, "", "", "", recipe=Recipe(**card["recipe"]), common=card.get("common", {})
        ),
        protocols.from_dict(result.protocol),
    )
    return describe_changes(
        recipes.changes(own, result.recipe), result.options, training.get("start"),
        training["environment"].get("precision", FULL_PRECISION),
    )  # fmt: skip


def truth_faults(folder: Path, result: Result) -> Iterator[str]:
    """What of a record its test set contradicts.

    Raises:
        InputError: the truth of its test set is missing or damaged.
    """
    truth = testsets.load(folder, result.test_set_sha256)
    counted = len(truth), len(np.unique(truth.object_ids))
    told = result.test_data.clouds, result.test_data.objects
    if counted != told:
        yield (
            f"it tells of {told[0]:,} test clouds of {told[1]:,} objects, its test set has "
            f"{counted[0]:,} of {counted[1]:,}"
        )


def score_faults(folder: Path, result: Result) -> Iterator[str]:
    """The recorded scores that the stored predictions do not give.

    Raises:
        InputError: the predictions or their truth are missing or damaged.
    """
    predictions = results.read_predictions(folder, result)
    try:
        scores = metrics.scores(
            predictions, result.train_data.class_names, result.test_data.class_names
        )
    except ValueError as error:
        yield f"its predictions give no scores: {error}"
        return
    # As JSON has it, where a tuple is a list.
    scores = json.loads(json.dumps(scores))
    wrong = [name for name in scores if not _same(scores[name], result.scores.get(name))]
    wrong += sorted(result.scores.keys() - scores.keys())
    if wrong:
        yield (
            f"the stored predictions give another {', '.join(wrong)} than the record says "
            f"(accuracy {scores['accuracy']:.4f}, recorded {result.scores['accuracy']})"
        )


def registry_faults(result: Result) -> Iterator[str]:
    """What a record says of a registered model that the registry does not.

    A user's own model has a card without claims, whatever its record says.
    """
    release = result.environment["packages"].get("partialbench", "unknown")
    made = f"it was made by release {release}"
    try:
        card = models.card_of(result.model)
    except InputError as error:
        yield f"{error}; {made}"
        return
    ours, told = _as_told(card), result.card
    other = [name for name in PRINTED if told.get(name) != ours[name]]
    if other:
        yield (
            f"its card has another {', '.join(other)} than the registry's; {made}: test its "
            f"checkpoint again, or make the board with that release"
        )
    if ":" in result.model:
        return
    count = _parameters(result.model, len(result.train_data.class_names), result.options)
    if count is not None and count != result.cost["parameters"]:
        yield (
            f"{result.row} has {count:,} parameters, it says {result.cost['parameters']:,}; {made}"
        )


def _as_told(card: registry.ModelCard) -> dict[str, Any]:
    """A card's printed entries as JSON has them."""
    fields = {f.name: getattr(card, f.name) for f in dataclasses.fields(card)}
    fields["invariances"] = sorted(card.invariances)
    return json.loads(json.dumps({name: fields[name] for name in PRINTED}))


_counts: dict[str, int | None] = {}


def _parameters(name: str, num_classes: int, options: dict[str, Any]) -> int | None:
    """Of the card, which a test holds against the model; with options, counted on a fresh one.

    None where the options are no longer known, or nothing can be counted for want of torch.
    """
    known = registry.card(name).parameters
    if not options and num_classes in known:
        return known[num_classes]
    key = json.dumps([name, num_classes, options], sort_keys=True)
    if key not in _counts:
        try:
            _counts[key] = models.num_parameters(models.create(name, num_classes, options))
        except InputError:
            _counts[key] = None
        except MissingExtraError as error:
            log.warning("the parameters of %s with %s are not counted: %s", name, options, error)
            _counts[key] = None
    return _counts[key]


def _same(ours: Any, recorded: Any) -> bool:
    """Equal scores, numbers to rounding: another processor sums in another order."""
    if isinstance(ours, dict) and isinstance(recorded, dict):
        return ours.keys() == recorded.keys() and all(_same(ours[k], recorded[k]) for k in ours)
    if isinstance(ours, list) and isinstance(recorded, list):
        return len(ours) == len(recorded) and all(map(_same, ours, recorded))
    if isinstance(ours, float) and isinstance(recorded, float):
        return math.isclose(ours, recorded, rel_tol=1e-9, abs_tol=1e-12)
    return ours == recorded
