"""All that an evaluation does, on next to nothing, before its first step.

A model may train well and break in the test: on one cloud alone, on one that is turned, on a state
that cannot be read back. That is found here, in seconds, and not after the last epoch. It is the
evaluation's own code that runs, one batch of it, in a temporary folder; the real training is not
touched, its draws neither. Costs a training step and a handful of test clouds.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning.fabric import Fabric
from numpy.typing import NDArray
from torch import nn
from torch.nn.parameter import UninitializedBuffer, UninitializedParameter

from partialbench.benchmark.clouds import Clouds
from partialbench.benchmark.protocol.split import balanced_subset
from partialbench.benchmark.testing import evaluate
from partialbench.benchmark.testing import run as testing
from partialbench.benchmark.training import checkpoint, made_again, seeds
from partialbench.benchmark.training.train import Task, train
from partialbench.benchmark.training.trunk import RunFolder
from partialbench.dataset.seeding import generator
from partialbench.errors import InputError, PartialbenchError
from partialbench.geometry.rotations import haar_rotations
from partialbench.user_code import where

log = logging.getLogger(__name__)

TEST_CLOUDS = 2
TURNS = 4


def try_out(
    task: Task,
    fabric: Fabric,
    tests: Sequence[testing.Test] = (),
) -> None:
    """Trains one batch, answers for clouds alone and turned, and writes and reads the records.

    Args:
        task: the training to come.
        tests: as the evaluation will make them, each damage in one strength; none for a training
            that is not tested.

    Raises:
        InputError: what will not work, and where. Errors that are sentences already pass as they
            are.
    """
    with _saying(task.model, "making the model"), seeds.kept():
        classes = len(task.dataset.class_names)
        _require_trainable(made_again.require_fresh(task.model, classes, task.options))
    rows = balanced_subset(
        task.train_rows, task.dataset.labels, min(task.recipe.batch_size, len(task.train_rows))
    )
    protocol = dataclasses.replace(task.protocol, max_test_clouds=TEST_CLOUDS)
    goal = len(rows)  # clouds of one step
    small = dataclasses.replace(
        task, train_rows=rows, validation_rows=task.validation_rows[:0], protocol=protocol
    )
    with tempfile.TemporaryDirectory(prefix="partialbench-dry-run-") as made, seeds.kept():
        folder = Path(made)
        with _saying(task.model, "training on one batch"):
            model = train(small, fabric, folder, goal, silent=True).model
        _answer(task, model, fabric.device)
        with _saying(task.model, "reading back its weights"):
            _require_readable(RunFolder(folder).branch(goal), model, task, fabric)
        if fabric.is_global_zero and tests:
            with _saying(task.model, "testing, and writing and reading its record,"):
                content = checkpoint.load(RunFolder(folder).branch(goal))
                testing.run_tests(content, model, [*map(_shorter, tests)], fabric, folder)
    fabric.barrier()


def _shorter(test: testing.Test) -> testing.Test:
    """With each damage in one strength, the last that is named."""
    strongest = {name.partition(":")[0]: name for name in test.damages}
    return dataclasses.replace(test, damages=[*strongest.values()])


@contextlib.contextmanager
def _saying(model: str, what: str) -> Iterator[None]:
    """Makes a sentence of whatever a user's model raises."""
    try:
        yield
    except evaluate.NotFiniteError as error:
        raise InputError(
            f"{model}: tried out before the training, {what} gives {error.what}: no record can "
            f"hold that"
        ) from error
    except PartialbenchError:
        raise
    except Exception as error:
        text = str(error).strip().partition("\n")[0]
        log.info("", exc_info=error)
        raise InputError(
            f"{model}: tried out before the training, {what} fails: {type(error).__name__}: {text} "
            f"({where(error)}; --verbose shows the whole trace)"
        ) from error


def _require_trainable(model: nn.Module) -> None:
    tensors = dict([*model.named_parameters(), *model.named_buffers()])
    lazy = [
        name
        for name, tensor in tensors.items()
        if isinstance(tensor, UninitializedParameter | UninitializedBuffer)
    ]
    if lazy:
        raise InputError(
            f"the model's {', '.join(lazy[:3])} have no shape before a first forward pass: its "
            f"weights could not be initialised, counted nor read back. Have the factory run one, "
            f"or give the layers their sizes"
        )
    if not any(parameter.requires_grad for parameter in model.parameters()):
        raise InputError(
            "the model has no trainable parameters: there is nothing to train, and a row is of a "
            "trained model. Give it a layer that learns (a linear one on its features, say)"
        )


def _require_readable(path: Path, trained: nn.Module, task: Task, fabric: Fabric) -> None:
    """The model that its checkpoint makes has all that was saved, and answers as the trained."""
    if not fabric.is_global_zero:
        return
    try:
        made_again.require_made_again(checkpoint.load(path), trained, task, fabric.device)
    except InputError as error:
        raise InputError(
            f"{task.model}: tried out before the training, its saved weights do not make it again: "
            f"{error}. Parameters and buffers must exist, with their shapes, once the factory "
            f"returns"
        ) from error


def _answer(task: Task, model: nn.Module, device: torch.device) -> None:
    """One cloud alone, several together, and each turned: every answer must be finite."""
    clouds, rows = task.dataset, task.train_rows[:TEST_CLOUDS]
    turned = _Turned(clouds, generator(0, "dry run"))
    for what, given, chosen, together in (
        ("answering for one cloud alone", clouds, rows[:1], 1),
        (f"answering for {len(rows)} clouds", clouds, rows, len(rows)),
        ("answering for clouds turned about the camera", turned, rows.repeat(TURNS), 1),
    ):
        with _saying(task.model, what):
            list(
                evaluate.run_model(model, given, chosen, len(clouds.class_names), device, together)
            )


class _Turned:
    """A test set whose clouds are turned at random about the camera, as the audit turns them."""

    def __init__(self, clouds: Clouds, rng: np.random.Generator) -> None:
        self.clouds, self.rng = clouds, rng

    def __getattr__(self, name: str) -> Any:
        return getattr(self.clouds, name)

    def __len__(self) -> int:
        return len(self.clouds)

    def points(
        self,
        indices: NDArray | list[int],
        rng: np.random.Generator | None = None,
        distinct: bool = False,
    ) -> NDArray[np.float32]:
        return self._turned(self.clouds.points(indices, rng, distinct))[0]

    def points_and_normals(
        self,
        indices: NDArray | list[int],
        rng: np.random.Generator | None = None,
        distinct: bool = False,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        points, normals = self._turned(*self.clouds.points_and_normals(indices, rng, distinct))
        return points, normals

    def _turned(self, *vectors: NDArray[np.float32]) -> list[NDArray[np.float32]]:
        turn = haar_rotations(self.rng, len(vectors[0])).astype(np.float32)
        return [each @ turn.swapaxes(1, 2) for each in vectors]
