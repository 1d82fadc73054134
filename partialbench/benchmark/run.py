"""``partialbench eval``: train under the protocol (or take a checkpoint), test, write records."""

from __future__ import annotations

import inspect
import logging
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lightning.fabric import Fabric

from partialbench import given, registry, user_code
from partialbench.benchmark import inputs, models, preflight
from partialbench.benchmark.clouds import Clouds
from partialbench.benchmark.environment import precision_of
from partialbench.benchmark.fabric import make_fabric
from partialbench.benchmark.preflight import FULL_PRECISION
from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.protocol import protocol as protocols
from partialbench.benchmark.protocol import recipe as recipes
from partialbench.benchmark.protocol.protocol import DEFAULT_PRESET, Protocol
from partialbench.benchmark.protocol.split import balanced_subset, split_by_object
from partialbench.benchmark.records.results import Result
from partialbench.benchmark.testing import asked
from partialbench.benchmark.testing import run as testing
from partialbench.benchmark.testing.asked import Asked
from partialbench.benchmark.training import checkpoint, dry_run, finetune, made_again, packed
from partialbench.benchmark.training.find import find_checkpoint
from partialbench.benchmark.training.follow import check_log
from partialbench.benchmark.training.held import hold
from partialbench.benchmark.training.memory import keep_freed_memory
from partialbench.benchmark.training.train import Task, train
from partialbench.benchmark.training.trunk import RunFolder
from partialbench.benchmark.variant import describe_changes, file_name
from partialbench.dataset.loader import ShardDataset
from partialbench.errors import InputError
from partialbench.registry import Recipe

log = logging.getLogger(__name__)


def run_eval(
    model: str,
    data: Path | str | None = None,
    test_data: Path | str | Sequence[Path | str] | None = None,
    checkpoint_file: Path | str | None = None,
    preset: str = DEFAULT_PRESET,
    seeds: int = 1,
    device: str = "auto",
    results_folder: Path | str = "results",
    *,
    clouds: str | int | Sequence[str | int] | None = None,
    restart: bool = False,
    runs_folder: Path | str | None = None,
    should_stop: Callable[[], bool] | None = None,
    first_seed: int = 0,
    start_from: Path | str | None = None,
    precision: str = FULL_PRECISION,
    log_to: str = "csv",
    checkpoint_every: int | None = None,
    test_points: int | Sequence[int] | Mapping[Path, Sequence[int]] = (),
    test_poses: str | float | Sequence[str | float] | Mapping[Path, Sequence[str]] = (),
    test_damages: str | Sequence[str] | Mapping[Path, Sequence[str]] = (),
    test_grid: Path | str | Sequence[Path | str] | None = None,
    recipe: Mapping[str, Any] | None = None,
    options: Mapping[str, Any] | None = None,
    protocol: Mapping[str, Any] | None = None,
    **protocol_overrides: Any,
) -> list[Result]:
    """Trains and tests a model; one record per milestone, seed and test set, each as it is done.

    Called again it goes on: a finished milestone is not trained again, an interrupted training
    continues, and a later milestone goes on from the trunk of the earlier ones.

    Args:
        model: registered name, or a user's "module:factory" in the current folder.
        data: folder of ``partialbench render``: trained on its train split, tested on its test
            split. With a checkpoint, only the test split is used.
        test_data: another such folder, or several; tested on their test splits as well.
        checkpoint_file: test these weights (see ``find_checkpoint``) instead of training, under the
            protocol they were trained by: what would change a training is an error then.
        preset: "smoke", "board" or "paper"; ``protocol`` and ``protocol_overrides`` change its
            fields (``num_points=512``), which makes it another protocol.
        clouds: the milestone to train to, or several, as ``milestones.parse`` takes them: "25k",
            [25_000, "100k"].
            By default those of the preset. A published recipe has one, the most clouds it may see.
        restart: delete what there is of these trainings and begin from the seed.
        runs_folder: of the trainings; "runs" in the results folder by default.
        should_stop: asked after every training step; where it says so the state is saved and
            ``TimeLimitError`` raised.
        seeds: how many, counted from ``first_seed``.
        start_from: weights of a finished training of this model (see ``find_checkpoint``), which
            each training begins from (fine-tuning); makes another row.
        device: "auto", "cpu", "cuda", "cuda:1". Started by torchrun, it uses every process.
        log_to: where a training's log goes while it grows: "csv", at the end only, or "tensorboard"
            too.
        checkpoint_every: save every so many steps, besides every few minutes.
        precision: as Fabric names it ("32-true", "bf16-mixed"); testing is always in 32 bits.
        test_points: test on clouds of so many points too, beside the number trained on. This and
            the next two are for every folder, or a mapping from a folder to what is asked of it.
        test_poses: test with the pose given too, see ``given_pose.parse``: "0" or 0 for the true
            one, "15" with noise, "class:0" under each class's own symmetry, "random". Only for a
            model that takes one.
        test_damages: test on damaged clouds too, see ``damage.parse``: "jitter:3", "all".
        test_grid: test on every cell of a folder of ``render --grid`` too, or on those whose own
            folders are given.
        recipe: fields of the model's recipe to change (``{"lr": 0.01}``); makes another row.
        options: for the model's factory; makes another row. With a checkpoint, those that its
            weights do not depend on, such as PAPNet's ``k``.
        protocol: fields of the protocol by name, for one that is an argument here too (``recipe``).

    Raises:
        InputError: anything about the arguments or files.
        TimeLimitError: see ``should_stop``.
    """
    preflight.check_names(protocol_overrides, inspect.signature(run_eval).parameters)
    results_folder = given.path(results_folder, "the folder of the results")
    runs_folder = given.path(runs_folder or results_folder / "runs", "the folder of the runs")
    seeds = given.whole_number(seeds, "seeds", 1)
    first_seed = given.whole_number(first_seed, "first_seed", 0)
    if checkpoint_every is not None:
        checkpoint_every = given.whole_number(checkpoint_every, "checkpoint_every", 1)
    restart = given.truth(restart, "restart")
    given.function(should_stop, "should_stop")
    clouds = None if clouds is None else given.several(clouds, "clouds")
    tests = asked.read(data, test_data, test_grid, test_points, test_poses, test_damages)
    options = given.mapping(options, "options")
    recipe, protocol = given.mapping(recipe, "recipe"), given.mapping(protocol, "protocol")
    if twice := sorted(protocol.keys() & protocol_overrides.keys()):
        raise InputError(
            f"{', '.join(twice)} of the protocol is given twice, by itself and in protocol="
        )
    model = user_code.named(model)
    preflight.check(
        model, data=tests.paths, results=results_folder, device=device, precision=precision,
        checkpoints=[path for path in (checkpoint_file, start_from) if path is not None],
    )  # fmt: skip
    check_log(log_to)
    fabric = make_fabric(device, precision)
    if checkpoint_file is not None:
        _refuse_with_checkpoint(
            {
                "--recipe": recipe, "--protocol": protocol or protocol_overrides,
                "--seeds": seeds != 1, "--first-seed": first_seed, "--clouds": clouds,
                "--precision": precision != FULL_PRECISION, "--restart": restart,
                "--log": log_to != "csv", "--checkpoint-every": checkpoint_every,
            },
            start_from,
        )  # fmt: skip
        return _test_checkpoint(
            model, find_checkpoint(checkpoint_file), tests, preset, options, fabric, results_folder
        )
    if data is None:
        raise InputError("nothing to train on: give --data, a folder made by partialbench render")

    if fabric.device.type == "cpu":
        keep_freed_memory()
    followed = protocols.protocol(preset, **{**protocol, **protocol_overrides})
    goals = milestones_of(followed, clouds)
    train_set = ShardDataset(data, "train", followed.num_points)
    tasks = _tasks(
        model, train_set, followed, recipe, models.chosen_options(model, options),
        range(first_seed, first_seed + seeds), start_from, precision_of(fabric),
    )  # fmt: skip
    to_test = tests.open(followed.num_points, train_set.class_names)
    # All that can be wrong is found before anything is trained or deleted.
    _require_testable(tasks[0], train_set, to_test)
    for task in tasks:
        for goal in goals:
            milestones.plan(followed, task.recipe, goal, len(task.train_rows))
    dry_run.try_out(tasks[0], fabric, [test for test in to_test if not test.clouds.grid])
    if restart and fabric.is_global_zero:
        for task in tasks:
            with hold(runs_folder / run_folder(task)):
                shutil.rmtree(runs_folder / run_folder(task), ignore_errors=True)
    fabric.barrier()

    written = []
    # The nearest milestone of every seed first: a table that is stopped is even.
    for goal in goals:
        for task in tasks:
            folder = runs_folder / run_folder(task)
            log.info("training %s, seed %d, to %d clouds in %s", model, task.seed, goal, folder)
            with hold(folder, fabric.is_global_zero):
                trained = train(
                    task, fabric, folder, goal, checkpoint_every, should_stop, log_to=log_to
                )
                if fabric.is_global_zero:
                    content = checkpoint.load(RunFolder(folder).branch(goal))
                    made_again.require_made_again(content, trained.model, task, fabric.device)
                    written += testing.run_tests(
                        content, trained.model, to_test, fabric, results_folder
                    )
            fabric.barrier()
    return written


def milestones_of(protocol: Protocol, clouds: Sequence[str | int] | None) -> tuple[int, ...]:
    """Those that are asked for, or the preset's, ascending.

    Raises:
        InputError: what is not a number of clouds, or more than one under published recipes.
    """
    if clouds is None:
        return protocols.default_clouds(protocol)
    goals = milestones.ordered(clouds)
    if protocol.recipe == "published" and len(goals) > 1:
        raise InputError(
            f"published recipes have one schedule over their whole length and no milestones on the "
            f"way, got {', '.join(map(milestones.name, goals))}; give one number of clouds"
        )
    return goals


def _tasks(
    model: str,
    train_set: ShardDataset,
    protocol: Protocol,
    changes: Mapping[str, Any],
    options: dict[str, Any],
    seeds: Iterable[int],
    start_from: Path | str | None,
    precision: str,
) -> list[Task]:
    """A training of each seed, by the model's own recipe with changes."""
    own = recipes.of_protocol(models.card_of(model), protocol)
    start = None if start_from is None else finetune.load(start_from, model)
    variant = describe_changes(
        recipes.changes(own, changes), options, None if start is None else start.origin, precision
    )
    used = recipes.override(own, changes)
    return [
        make_task(model, train_set, protocol, used, seed, options, variant, start) for seed in seeds
    ]


def _require_testable(task: Task, train_set: ShardDataset, tests: Sequence[testing.Test]) -> None:
    """Raises ``InputError`` where the data lack what the model reads, or it takes no pose."""
    _say_odd_classes(train_set, tests[0].clouds)
    if inputs.NORMALS in models.card_of(task.model).inputs:
        for part in (train_set, *(test.clouds for test in tests)):
            inputs.require(part, task.model)
    if any(test.poses for test in tests):
        fresh = models.create(task.model, len(train_set.class_names), task.options)
        asked.try_poses(task.model, fresh, tests, train_set.class_names)


def make_task(
    model: str,
    train_set: Clouds,
    protocol: Protocol,
    recipe: Recipe,
    seed: int,
    options: dict[str, Any],
    variant: str = "",
    start: finetune.Start | None = None,
) -> Task:
    """The training a protocol prescribes on a train split."""
    recipes.require_fits(recipe, protocol)
    if start is not None:
        finetune.check_split(start, train_set.dataset_id, protocol)
    train_rows, validation_rows = split_by_object(
        train_set.object_ids, train_set.labels, train_set.class_names,
        protocol.validation_fraction, protocol.split_seed, train_set.source_digests,
    )  # fmt: skip
    train_rows = balanced_subset(train_rows, train_set.labels, protocol.max_train_clouds)
    for limit in (protocol.max_train_clouds, protocol.max_test_clouds):
        validation_rows = balanced_subset(validation_rows, train_set.labels, limit)
    return Task(
        model, train_set, train_rows, validation_rows, protocol, recipe, seed, options, variant,
        start,
    )  # fmt: skip


def run_folder(task: Task) -> str:
    """The name of a training's own folder: where its checkpoint and log are."""
    return file_name(
        task.model,
        task.variant,
        f"{task.dataset.dataset_id}-{task.dataset.digest[:8]}",
        f"{task.protocol.preset}-{task.protocol.digest[:8]}",
        f"seed{task.seed}",
    )


def _refuse_with_checkpoint(of_training: Mapping[str, Any], start_from: Path | str | None) -> None:
    """Raises ``InputError`` where something is asked for that finished weights take no more."""
    if start_from is not None:
        raise InputError(
            "--checkpoint tests weights as they are, --start-from trains on from them: give one"
        )
    if unused := [name for name, wanted in of_training.items() if wanted]:
        raise InputError(
            f"--checkpoint tests finished weights, so {', '.join(unused)} would have no "
            f"effect; leave it out, or train without --checkpoint"
        )


def _test_checkpoint(
    model_name: str,
    path: Path,
    tests: Asked,
    preset: str,
    options: Mapping[str, Any],
    fabric: Fabric,
    results_folder: Path,
) -> list[Result]:
    if not tests.folders and not tests.cells:
        raise InputError("nothing to test on: give --data, --test-data or --test-grid")
    content = packed.load(path)
    if content["model"] != model_name:
        raise InputError(f"{path} holds a {content['model']!r}, not a {model_name!r}")
    checkpoint.require_finished(content, path, "be tested")
    trained_by = content["protocol"]["preset"].removesuffix("+")
    if preset not in (DEFAULT_PRESET, trained_by):
        raise InputError(
            f"{path} was trained by the preset {trained_by!r} and is tested by it, not by "
            f"{preset!r}"
        )
    if options:
        content = _with_options(content, options)
    model = checkpoint.build_model(content, model_name)
    changed = checkpoint.changed_code(content, model_name)
    if changed:
        raise InputError(
            f"{path}: {changed}: one record would tell of two models. Test with the file as it "
            f"was, or train again"
        )
    to_test = tests.open(content["num_points"], tuple(content["class_names"]))
    if inputs.needs_normals(model):
        for test in to_test:
            inputs.require(test.clouds, model_name)
    asked.try_poses(model_name, model, to_test, content["class_names"])
    written = []
    if fabric.is_global_zero:
        written = testing.run_tests(content, model, to_test, fabric, results_folder)
    fabric.barrier()
    return written


def _with_options(content: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """A checkpoint's content with options of the model changed, as a row of its own."""
    card, followed = models.card_of(content["model"]), protocols.from_dict(content["protocol"])
    recipe = recipes.changes(recipes.of_protocol(card, followed), content["recipe"])
    merged = {**content["options"], **registry.options_of(content["model"], options)}
    merged = models.chosen_options(content["model"], merged)
    summary = content["summary"]
    variant = describe_changes(
        recipe, merged, summary.get("start"), summary["environment"]["precision"]
    )
    return {**content, "options": merged, "variant": variant}


def _say_odd_classes(train_set: ShardDataset, test_set: Clouds) -> None:
    """A class that is tested but not trained can only be got wrong; one not tested counts nothing.

    Of one data folder, whose two splits name the same classes.
    """
    trained, tested = (
        {names.class_names[i] for i in np.unique(names.labels)} for names in (train_set, test_set)
    )
    for have, lack, missing in (
        ("test", "training", tested - trained),
        ("training", "test", trained - tested),
    ):
        if missing:
            log.warning(
                "%s: of %s there are %s objects but no %s object%s",
                train_set.folder, ", ".join(sorted(missing)), have, lack,
                ": no model can name them rightly" if have == "test" else "",
            )  # fmt: skip
