"""``partialbench eval``: train under the protocol (or take a checkpoint), test, write records."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from lightning.fabric import Fabric

from partialbench.benchmark import (
    checkpoint,
    finetune,
    given_pose,
    inputs,
    models,
    results,
    testing,
)
from partialbench.benchmark import protocol as protocols
from partialbench.benchmark import recipe as recipes
from partialbench.benchmark.batches import Clouds
from partialbench.benchmark.environment import FULL_PRECISION, precision_of
from partialbench.benchmark.memory import keep_freed_memory
from partialbench.benchmark.protocol import Protocol
from partialbench.benchmark.results import Result
from partialbench.benchmark.split import balanced_subset, split_by_object
from partialbench.benchmark.train import Task, train
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
        folders = [folder for folder in (data, test_data) if folder is not None]
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
    train_set = ShardDataset(data, "train", followed.num_points)
    folders = [folder for folder in (data, test_data) if folder is not None]
    test_sets = _open_test_sets(folders, [followed.num_points, *test_points], train_set.class_names)
    if inputs.NORMALS in card.inputs:
        for part in (train_set, *test_sets):
            inputs.require(part, model)
    if poses:  # before a training that could not be tested so
        fresh = models.create(model, len(train_set.class_names), options)
        testing.try_given_pose(model, fresh, test_sets[0], poses[0], len(train_set.class_names))

    written = []
    start = None if start_from is None else finetune.load(start_from, model)
    origin = None if start is None else start.origin
    variant = describe_changes(changed, options or {}, origin, precision_of(fabric))
    for seed in range(first_seed, first_seed + seeds):
        task = make_task(
            model, train_set, followed, used, seed, dict(options or {}), variant, start
        )
        if "epochs" in (recipe or {}):
            followed.require_epochs(used, len(task.train_rows))
        folder = results_folder / "runs" / run_folder(task)
        log.info("training %s, seed %d, in %s", task.model, seed, folder)
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
        protocol.validation_fraction, protocol.split_seed,
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
    return results.file_name(
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
    model = checkpoint.build_model(content)
    changed = checkpoint.changed_code(content)
    if changed:
        raise InputError(
            f"{path}: {changed}: one record would tell of two models. Test with the file as it "
            f"was, or train again"
        )
    test_sets = _open_test_sets(
        folders, [content["num_points"], *test_points], tuple(content["class_names"])
    )
    if inputs.needs_normals(model):
        for part in test_sets:
            inputs.require(part, model_name)
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
    merged = {**content["options"], **options}
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


def make_fabric(device: str, precision: str) -> Fabric:
    """A launched Fabric on ``device``; with torchrun's variables set, one process of many."""
    kind, _, index = device.partition(":")
    if kind not in ("auto", "cpu", "cuda") or (index and not index.isdigit()):
        raise InputError(f"device must be auto, cpu, cuda or cuda:0 …, got {device!r}")
    if kind == "auto":  # not Fabric's choice: on a Mac that is one without 64-bit numbers
        kind = "cuda" if torch.cuda.is_available() else "cpu"
    if kind == "cuda" and not torch.cuda.is_available():
        raise InputError("device cuda was asked for, but torch sees no CUDA device")
    processes, nodes = 1, 1
    if "LOCAL_WORLD_SIZE" in os.environ:  # torchrun sets it
        processes = int(os.environ["LOCAL_WORLD_SIZE"])
        nodes = int(os.environ["WORLD_SIZE"]) // processes
    try:
        fabric = Fabric(
            accelerator=kind,
            devices=[int(index)] if index else processes,
            num_nodes=nodes,
            strategy="ddp" if processes * nodes > 1 else "auto",
            precision=precision,  # type: ignore[arg-type]
        )
    except ValueError as error:
        raise InputError(f"device {device!r}, precision {precision!r}: {error}") from error
    fabric.launch()
    # cuDNN would round what it convolves to 10 bits, in tests too, and call it 32.
    torch.backends.cudnn.allow_tf32 = False
    return fabric


def _require_shared_class(train_classes: tuple[str, ...], test_set: Clouds) -> None:
    if not set(train_classes) & set(test_set.class_names):
        raise InputError(
            f"the test data ({test_set.dataset_id}) share no class with the training data: "
            f"{', '.join(test_set.class_names)} against {', '.join(train_classes)}"
        )


def describe_changes(
    recipe: Mapping[str, Any],
    options: Mapping[str, Any],
    origin: Mapping[str, Any] | None = None,
    precision: str = FULL_PRECISION,
) -> str:
    """What was changed about a model, its recipe, start or precision, as a row has it in brackets.

    A model's answers depend on the precision it was trained in, so it is told where it is not full.
    """
    changed = [*recipe.items(), *options.items()]
    if origin is not None:
        changed.append(("start", origin["name"]))
    if precision != FULL_PRECISION:
        changed.append(("precision", precision))
    return " ".join(f"{k}={v}" for k, v in sorted(changed, key=str))
