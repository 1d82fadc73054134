"""``partialbench tune``: recipes of one model compared on the validation split, and nowhere else.

The test split is never opened here. Every trial is recorded, also those that lost, so that a reader
of the table can see that each model was given as many.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from partialbench import given, user_code
from partialbench.benchmark import models, preflight
from partialbench.benchmark.environment import precision_of
from partialbench.benchmark.fabric import make_fabric
from partialbench.benchmark.preflight import FULL_PRECISION
from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.protocol import protocol as protocols
from partialbench.benchmark.protocol import recipe as recipes
from partialbench.benchmark.protocol.protocol import DEFAULT_PRESET
from partialbench.benchmark.records.trials import FILE, Trial, add_trial
from partialbench.benchmark.run import make_task, milestones_of, run_folder
from partialbench.benchmark.testing.evaluate import NotFiniteError
from partialbench.benchmark.training import dry_run, finetune
from partialbench.benchmark.training.held import hold
from partialbench.benchmark.training.memory import keep_freed_memory
from partialbench.benchmark.training.train import DivergedError, Task, train
from partialbench.benchmark.variant import describe_changes, pairs_text
from partialbench.dataset.loader import ShardDataset
from partialbench.errors import InputError

log = logging.getLogger(__name__)


def tune(
    model: str,
    data: Path | str,
    tries: Sequence[Mapping[str, Any]],
    preset: str = DEFAULT_PRESET,
    seed: int = 0,
    device: str = "auto",
    results_folder: Path | str = "results",
    *,
    clouds: str | int | None = None,
    runs_folder: Path | str | None = None,
    should_stop: Callable[[], bool] | None = None,
    start_from: Path | str | None = None,
    precision: str = FULL_PRECISION,
    options: Mapping[str, Any] | None = None,
    protocol: Mapping[str, Any] | None = None,
) -> list[Trial]:
    """Trains the model once with each recipe; adds the trials to ``tuning.csv`` of the folder.

    Interrupted, the same call continues; a finished trial is not repeated.

    Args:
        model, data, preset, device, runs_folder, should_stop, start_from, precision, options,
            protocol: as ``run_eval`` takes them.
        clouds: the milestone at which recipes are compared; the preset's by default.
        tries: fields of the recipe to change, one mapping a trial; {} is the recipe as it is.
        seed: of every trial.

    Returns:
        the trials, best validation accuracy first, then those that diverged.

    Raises:
        InputError: no trials, a protocol without a validation split, or anything about the
            arguments or files.
    """
    tries = [given.mapping(one, "a recipe to try") for one in given.several(tries, "tries")]
    if not tries:
        raise InputError("nothing to try: give at least one recipe, e.g. --try lr=0.001")
    results_folder = given.path(results_folder, "the folder of the results")
    runs_folder = given.path(runs_folder or results_folder / "runs", "the folder of the runs")
    data, seed = given.path(data, "a data folder"), given.whole_number(seed, "seed", 0)
    options, protocol = given.mapping(options, "options"), given.mapping(protocol, "protocol")
    model = user_code.named(model)
    preflight.check(
        model, data=[data], results=results_folder, device=device, precision=precision,
        checkpoints=[] if start_from is None else [start_from],
    )  # fmt: skip
    fabric = make_fabric(device, precision)
    if fabric.device.type == "cpu":
        keep_freed_memory()
    followed = protocols.protocol(preset, **protocol)
    if followed.validation_fraction == 0:
        raise InputError("validation_fraction is 0: there is nothing to choose on")
    train_set = ShardDataset(data, "train", followed.num_points)
    *_, goal = milestones_of(followed, None if clouds is None else [clouds])
    own = recipes.of_protocol(models.card_of(model), followed)
    chosen = models.chosen_options(model, options)
    start = None if start_from is None else finetune.load(start_from, model)
    origin, bits = None if start is None else start.origin, precision_of(fabric)
    tasks, lengths = [], []  # all are checked before the first is trained
    for changes in tries:
        recipe = recipes.override(own, changes)
        variant = describe_changes(recipes.changes(own, changes), chosen, origin, bits)
        task = make_task(model, train_set, followed, recipe, seed, chosen, variant, start)
        lengths.append(milestones.plan(followed, recipe, goal, len(task.train_rows)).clouds_seen)
        tasks.append(task)
    _require_validation(tasks[0])
    dry_run.try_out(make_task(model, train_set, followed, own, seed, chosen, "", start), fabric)
    trials = []
    for changes, task, length in zip(tries, tasks, lengths, strict=True):
        folder, tried = runs_folder / run_folder(task), pairs_text(changes)
        log.info("trying %s in %s", tried or "the recipe as it is", folder)
        try:
            with hold(folder, fabric.is_global_zero):
                summary = train(task, fabric, folder, goal, should_stop=should_stop).summary
        except (DivergedError, NotFiniteError) as error:
            log.warning("%s; recorded as diverged", error)
            summary = {"clouds_seen": length, "train_loss": None, "validation_accuracy": None}
        trial = Trial(
            model, describe_changes({}, chosen, origin, bits), tried, seed, train_set.digest,
            followed.digest, summary["clouds_seen"], summary["train_loss"],
            summary["validation_accuracy"],
        )  # fmt: skip
        trials.append(trial)
        if fabric.is_global_zero:
            add_trial(results_folder / FILE, trial)
        fabric.barrier()
    return sorted(trials, key=_best_first)


def _best_first(trial: Trial) -> float:
    return 1.0 if trial.validation_accuracy is None else -trial.validation_accuracy


def _require_validation(task: Task) -> None:
    """Raises ``InputError`` where nothing validates: there would be nothing to choose on."""
    if len(task.validation_rows):
        return
    data, fraction = task.dataset, task.protocol.validation_fraction
    objects = [
        f"{data.class_names[label]} {len(np.unique(data.object_ids[data.labels == label]))}"
        for label in np.unique(data.labels)
    ]
    shown = ", ".join(objects[:8]) + (f" and {len(objects) - 8} more classes" * (len(objects) > 8))
    raise InputError(
        f"no object is left to validate: validation_fraction={fraction:g} of each class's objects, "
        f"those made from the same bytes together, is none ({shown}). Give a larger one "
        f"(--protocol validation_fraction=0.3), or more objects"
    )
