"""Training one model under the protocol to a milestone: along the trunk, then along its branch.

Whatever is saved already is taken up: a finished branch is not repeated, an unfinished one goes on,
a new one begins from the last state of the trunk before it. A trunk that is lost is made again.
"""

from __future__ import annotations

import contextlib
import csv
import io
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from lightning.fabric import Fabric
from numpy.typing import NDArray
from rich.console import Console
from torch import nn

from partialbench.benchmark import models
from partialbench.benchmark.clouds import Clouds
from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.protocol import recipe as recipes
from partialbench.benchmark.protocol.protocol import Protocol
from partialbench.benchmark.records.results import describe_data
from partialbench.benchmark.training import checkpoint, finetune
from partialbench.benchmark.training.follow import TensorBoard
from partialbench.benchmark.training.keeper import Keeper
from partialbench.benchmark.training.loop import CHECK_EVERY, DivergedError, Loop
from partialbench.benchmark.training.trunk import RunFolder
from partialbench.dataset.shards import write_atomically
from partialbench.errors import ConfigurationMismatchError, TimeLimitError
from partialbench.progress import training_bar
from partialbench.registry import Recipe

__all__ = ["DivergedError", "Task", "TimeLimitError", "Trained", "train"]


@dataclass(frozen=True)
class Task:
    """What is trained on what.

    Attributes:
        model: registered name or "module:factory"; ``options`` go to its factory.
        train_rows, validation_rows: row numbers of ``dataset``.
        variant: see ``results.Result``.
        start: weights to begin from; random ones without it. The variant names them.
    """

    model: str
    dataset: Clouds
    train_rows: NDArray[np.int64]
    validation_rows: NDArray[np.int64]
    protocol: Protocol
    recipe: Recipe
    seed: int
    options: dict[str, Any] = field(default_factory=dict)
    variant: str = ""
    start: finetune.Start | None = None

    def identity(self) -> dict[str, Any]:
        """What makes it this training and no other: plain data, stored in every checkpoint."""
        return {
            "model": self.model,
            "model_code": models.code_digest(self.model),
            "variant": self.variant,
            "options": dict(self.options),
            "class_names": list(self.dataset.class_names),
            "num_points": self.protocol.num_points,
            "recipe": recipes.as_dict(self.recipe),
            "protocol": self.protocol.as_dict(),
            "protocol_digest": self.protocol.digest,
            "train_data": asdict(describe_data(self.dataset, self.train_rows)),
            "seed": self.seed,
        }


@dataclass
class Trained:
    """A finished training: the bare module in evaluation mode and how it got there.

    Attributes:
        history: the lines of log.csv: clouds seen, rate, mean training loss since the line before,
            validation accuracy (in the last line, None before), training clouds per second.
        summary: the milestone (``clouds``), epochs, steps, clouds seen, seconds (wall time of all
            its parts, the trunk's among them, interruptions not counted), median clouds per second,
            the last line's loss and validation accuracy and the curves of both, peak memory, the
            environment it ended in and, where parts before an interruption ran in others,
            ``earlier_environments``, and where it did not begin from random weights, its ``start``.
    """

    model: nn.Module
    history: list[dict[str, Any]]
    summary: dict[str, Any]


def train(
    task: Task,
    fabric: Fabric,
    folder: Path,
    clouds: int,
    checkpoint_every: int | None = None,
    should_stop: Callable[[], bool] | None = None,
    silent: bool = False,
    log_to: str = "csv",
) -> Trained:
    """Trains to a milestone, going on from what ``folder`` has.

    Args:
        fabric: launched; it chooses device, precision and processes. Only rank 0 writes.
        folder: of this training alone, see ``trunk``.
        clouds: the milestone.
        checkpoint_every: save after every so many steps too, besides every few minutes.
        should_stop: asked after every step.
        silent: without a progress bar.
        log_to: "tensorboard" for event files beside the log.csv, in ``branch-…/tensorboard``.

    Raises:
        DivergedError: NaN or infinite loss.
        TimeLimitError: ``should_stop`` said so; the state is saved.
        KeyboardInterrupt: Ctrl-C; the step was finished and the state is saved.
        ConfigurationMismatchError: what the folder has is of another training.
    """
    recipes.require_fits(task.recipe, task.protocol)
    fabric.barrier()  # another process may have been writing what all read now
    course = _Course(task, fabric, RunFolder(folder), clouds)
    summary = course.resume()
    if summary is not None:
        return Trained(course.loop.bare.eval(), course.loop.history, summary)
    loop, watched = course.loop, None
    if log_to == "tensorboard" and fabric.is_global_zero:
        watched = TensorBoard(course.path.parent / "tensorboard", loop.history)
    with (
        contextlib.closing(watched) if watched else contextlib.nullcontext(),
        training_bar(Console(stderr=True), silent=silent or not fabric.is_global_zero) as progress,
        Keeper(fabric, loop, checkpoint_every, should_stop) as keeper,
    ):
        bar = progress.add_task(f"{task.model} {milestones.name(clouds)}", total=course.plan.steps,
                                loss="", completed=loop.step)  # fmt: skip

        def after_step(until: int) -> None:
            if loop.step % CHECK_EVERY == 0 or loop.step == until:
                shown = f"loss {loop.mean_loss:.3f}" if loop.in_interval else ""
                progress.update(bar, completed=loop.step, **({"loss": shown} if shown else {}))
                if watched:
                    watched.update(loop.history)
            keeper.after_step(course.save)

        for stop in course.stops():
            loop.advance(stop, partial(after_step, stop))
            course.save()
        if not course.in_branch:
            course.begin_branch()
        loop.advance(course.plan.steps, partial(after_step, course.plan.steps))
        content = loop.finished()
        if watched:
            watched.update(loop.history)
    course.finish(content)
    return Trained(loop.bare.eval(), loop.history, content["summary"])


class _Course:
    """A training's way along the trunk and then its branch, and its files; rank 0 writes them.

    Attributes:
        in_branch: whether it has left the trunk.
        path: the branch's checkpoint.
    """

    def __init__(self, task: Task, fabric: Fabric, files: RunFolder, clouds: int) -> None:
        self.files, self.clouds, self.fabric = files, clouds, fabric
        self.plan = milestones.plan(task.protocol, task.recipe, clouds, len(task.train_rows))
        self.identity = task.identity()
        self.loop = Loop(task, fabric, self.plan)
        self.path = files.branch(clouds)
        self.in_branch = self.path.is_file()

    def resume(self) -> dict[str, Any] | None:
        """Takes up the furthest state that is saved; a finished training's summary, or None."""
        branch_at = self.plan.branch_at * self.plan.batch
        state = self.path if self.in_branch else self.files.nearest(branch_at)
        if state is None:
            return None
        saved = checkpoint.load(state)
        _require_same_training(saved, self.identity, state, self.files.folder)
        self.loop.load(saved)
        summary: dict[str, Any] | None = saved.get("summary")
        return summary

    def stops(self) -> list[int]:
        """Steps ahead at which a state of the trunk is kept, the branch's beginning the last."""
        if self.in_branch:
            return []
        regular = milestones.regular(self.plan.branch_at, self.plan.batch)
        return sorted(step for step in {*regular, self.plan.branch_at} if step > self.loop.step)

    def begin_branch(self) -> None:
        self.loop.begin_branch()
        self.in_branch = True

    def save(self) -> None:
        """Saves where the training stands, of the trunk or of the branch."""
        content = self.loop.content()  # by all processes: what each has of it is gathered
        if not self.fabric.is_global_zero:
            return
        if self.in_branch:
            self._write_branch(content)
            self.files.note(self.loop.speed(), branch=(self.clouds, self.loop.clouds_seen))
        else:
            target = self.files.state(self.loop.clouds_seen)
            target.parent.mkdir(parents=True, exist_ok=True)
            checkpoint.save(target, self.identity, {**content, "kind": "trunk"})
            self.files.note(self.loop.speed())
            self.files.prune(self.loop.clouds_seen, [self.clouds], self.plan.batch)

    def finish(self, content: dict[str, Any]) -> None:
        if self.fabric.is_global_zero:
            self._write_branch(content)
            write_atomically(self.path.with_name("log.csv"), _as_csv(self.loop.history))
            self.files.note(self.loop.speed(), done=self.clouds)
        self.fabric.barrier()

    def _write_branch(self, content: dict[str, Any]) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        branch = {**content, "kind": "branch", "clouds": self.clouds}
        checkpoint.save(self.path, self.identity, branch)


def _require_same_training(
    saved: dict[str, Any], identity: dict[str, Any], path: Path, folder: Path
) -> None:
    saved, identity = (
        {**content, "recipe": recipes.of_training(content["recipe"])}
        for content in (saved, identity)
    )
    differing = [name for name in checkpoint.IDENTITY if saved[name] != identity[name]]
    if differing:
        details = "; ".join(f"{n}: {saved[n]!r} there, {identity[n]!r} now" for n in differing)
        raise ConfigurationMismatchError(
            f"{path} is of another training ({details}); choose another --results folder, or "
            f"start over: run eval with --restart, or delete {folder}"
        )


def _as_csv(history: list[dict[str, Any]]) -> bytes:
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(history[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(history)
    return text.getvalue().encode()
