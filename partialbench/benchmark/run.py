"""``partialbench eval``: train under the protocol (or take a checkpoint), test, write records."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lightning.fabric import Fabric

from partialbench import registry, user_code
from partialbench.benchmark import models, preflight
from partialbench.benchmark.clouds import Clouds
from partialbench.benchmark.environment import precision_of
from partialbench.benchmark.fabric import make_fabric
from partialbench.benchmark.preflight import FULL_PRECISION
from partialbench.benchmark.protocol import protocol as protocols
from partialbench.benchmark.protocol import recipe as recipes
from partialbench.benchmark.protocol.protocol import Protocol
from partialbench.benchmark.protocol.split import balanced_subset, split_by_object
from partialbench.benchmark.records.results import Result
from partialbench.benchmark.testing import given_pose
from partialbench.benchmark.testing import run as testing
from partialbench.benchmark.training import checkpoint, dry_run, finetune
from partialbench.benchmark.training.held import hold
from partialbench.benchmark.training.memory import keep_freed_memory
from partialbench.benchmark.training.train import Task, train
from partialbench.benchmark.variant import describe_changes, file_name
from partialbench.dataset.loader import ShardDataset
from partialbench.errors import InputError
from partialbench.registry import Recipe

log = logging.getLogger(__name__)

DEFAULT_PRESET = "mini"


def run_eval(
    model: str,
    data: Path | str | None = None,
    test_data: Path | str | None = None,
    checkpoint_file: Path | str | None = None,
    preset: str = DEFAULT_PRESET,
    seeds: int = 1,
    device: str = "auto",
    results_folder: Path | str = "results",
    resume: bool = False,
    *,
    first_seed: int = 0,
    start_from: Path | str | None = None,
    precision: str = FULL_PRECISION,
    checkpoint_every: int | None = None,
    test_points: Sequence[int] = (),
    test_poses: Sequence[str | float] = (),
    recipe: Mapping[str, Any] | None = None,
    options: Mapping[str, Any] | None = None,
    protocol: Mapping[str, Any] | None = None,
    **protocol_overrides: Any,
) -> list[Result]:
    """Trains and tests a model; one record per seed and test set, written as each is done.

    Args:
        model: registered name, or a user's "module:factory" in the current folder.
        data: folder of ``partialbench render``: trained on its train split, tested on its test
            split. With a checkpoint, only the test split is used.
        test_data: another such folder; each seed is tested on its test split as well.
        checkpoint_file: test these weights instead of training, under the protocol they were
            trained by: what would change a training is an error then.
        preset: "smoke", "small", "mini", "equal" or "paper"; ``protocol`` and
            ``protocol_overrides`` change its fields (``epochs=2``), which makes it another
            protocol.
        seeds: how many, counted from ``first_seed``.
        start_from: checkpoint of a finished training of this model, whose weights each training
            begins from (fine-tuning); makes another row.
        device: "auto", "cpu", "cuda", "cuda:1". Started by torchrun, it uses every process.
        resume: continue interrupted seeds; a finished training is not repeated.
        checkpoint_every: save every so many steps, besides after every epoch.
        precision: as Fabric names it ("32-true", "bf16-mixed"); testing is always in 32 bits.
        test_points: test on clouds of so many points too, beside the number trained on.
        test_poses: test with the pose given too, see ``given_pose.parse``: "0" or 0 for the true
            one, "15" with noise, "random". Only for a model that takes one.
        recipe: fields of the model's recipe to change (``{"lr": 0.01}``); makes another row.
        options: for the model's factory; makes another row. With a checkpoint, those that its
            weights do not depend on, such as PAPNet's ``k``.
        protocol: fields of the protocol by name, for one that is an argument here too (``recipe``).

    Raises:
        InputError: anything about the arguments or files.
    """
    results_folder = Path(results_folder)
    model = user_code.named(model)
    folders = [folder for folder in (data, test_data) if folder is not None]
    preflight.check(
        model, data=folders, results=results_folder, device=device, precision=precision,
        checkpoints=[path for path in (checkpoint_file, start_from) if path is not None],
    )  # fmt: skip
    fabric = make_fabric(device, precision)
    poses = list(dict.fromkeys(map(given_pose.parse, test_poses)))
    if checkpoint_file is not None:
        if start_from is not None:
            raise InputError(
                "--checkpoint tests weights as they are, --start-from trains on from them: give one"
            )
        asked = {
            "--recipe": recipe, "--protocol": protocol or protocol_overrides,
            "--seeds": seeds != 1, "--first-seed": first_seed,
            "--precision": precision != FULL_PRECISION,
        }  # fmt: skip
        unused = [name for name, given in asked.items() if given]
        if unused:
            raise InputError(
                f"--checkpoint tests finished weights, so {', '.join(unused)} would have no "
                f"effect; leave it out, or train without --checkpoint"
            )
        return _test_checkpoint(
            model, Path(checkpoint_file), folders, preset, test_points, poses, options or {},
            fabric, results_folder,
        )  # fmt: skip
    if data is None:
        raise InputError("nothing to train on: give --data, a folder made by partialbench render")
    if seeds < 1:
        raise InputError(f"seeds must be at least 1, got {seeds}")
    if checkpoint_every is not None and checkpoint_every < 1:
        raise InputError(f"checkpoint_every must be at least 1 step, got {checkpoint_every}")

    if fabric.device.type == "cpu":
        keep_freed_memory()
    followed = protocols.protocol(preset, **{**(protocol or {}), **protocol_overrides})
    card = models.card_of(model)
    own = recipes.of_protocol(card, followed)
    changed = recipes.changes(own, recipe or {})
    used = recipes.override(own, recipe or {})
    chosen = models.chosen_options(model, options or {})
    train_set = ShardDataset(data, "train", followed.num_points)
    test_sets = _open_test_sets(folders, [followed.num_points, *test_points], train_set.class_names)
    _say_odd_classes(train_set, test_sets[0])
    if poses:  # before a training that could not be tested so
        fresh = models.create(model, len(train_set.class_names), chosen)
        testing.try_given_pose(model, fresh, test_sets[0], poses[0], len(train_set.class_names))

    written = []
    start = None if start_from is None else finetune.load(start_from, model)
    origin = None if start is None else start.origin
    variant = describe_changes(changed, chosen, origin, precision_of(fabric))
    for seed in range(first_seed, first_seed + seeds):
        task = make_task(model, train_set, followed, used, seed, chosen, variant, start)
        if "epochs" in (recipe or {}):
            followed.require_epochs(used, len(task.train_rows))
        folder = results_folder / "runs" / run_folder(task)
        log.info("training %s, seed %d, in %s", task.model, seed, folder)
        with hold(folder, fabric.is_global_zero):
            if seed == first_seed:
                dry_run.try_out(task, fabric, test_sets, poses)
            trained = train(task, fabric, folder, resume, checkpoint_every)
            if fabric.is_global_zero:
                content = checkpoint.load(folder / "checkpoint.pt")
                written += testing.run_tests(
                    content, trained.model, test_sets, poses, fabric, results_folder
                )
        fabric.barrier()
    return written


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


def _test_checkpoint(
    model_name: str,
    path: Path,
    folders: Sequence[Path | str],
    preset: str,
    test_points: Sequence[int],
    test_poses: Sequence[str],
    options: Mapping[str, Any],
    fabric: Fabric,
    results_folder: Path,
) -> list[Result]:
    if not folders:
        raise InputError("nothing to test on: give --data or --test-data")
    content = checkpoint.load(path)
    if content["model"] != model_name:
        raise InputError(f"{path} holds a {content['model']!r}, not a {model_name!r}")
    if "summary" not in content:
        raise InputError(
            f"{path} is of an unfinished training (epoch {content['epoch']}); finish it with "
            f"--resume, the protocol reports the last epoch only"
        )
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
    test_sets = _open_test_sets(
        folders, [content["num_points"], *test_points], tuple(content["class_names"])
    )
    if test_poses:
        classes = len(content["class_names"])
        testing.try_given_pose(model_name, model, test_sets[0], test_poses[0], classes)
    written = []
    if fabric.is_global_zero:
        written = testing.run_tests(content, model, test_sets, test_poses, fabric, results_folder)
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


def _open_test_sets(
    folders: Sequence[Path | str], points: Sequence[int], train_classes: tuple[str, ...]
) -> list[ShardDataset]:
    """The test split of each folder with each number of points."""
    test_sets = [
        ShardDataset(folder, "test", number)
        for folder in folders
        for number in dict.fromkeys(points)
    ]
    for test_set in test_sets:
        _require_shared_class(train_classes, test_set)
    return test_sets


def _require_shared_class(train_classes: tuple[str, ...], test_set: Clouds) -> None:
    if not set(train_classes) & set(test_set.class_names):
        raise InputError(
            f"the test data ({test_set.dataset_id}) share no class with the training data: "
            f"{', '.join(test_set.class_names)} against {', '.join(train_classes)}"
        )


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
