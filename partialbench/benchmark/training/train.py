"""Training one model under the protocol to a milestone: along the trunk, then along its branch.

Whatever is saved already is taken up: a finished branch is not repeated, an unfinished one goes on,
a new one begins from the last state of the trunk before it. A trunk that is lost is made again.
"""

from __future__ import annotations

import contextlib
import csv
import io
import logging
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch
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
from partialbench.benchmark.training.loop import CHECK_EVERY, DivergedError, Loop
from partialbench.benchmark.training.trunk import RunFolder
from partialbench.dataset.shards import write_atomically
from partialbench.errors import ConfigurationMismatchError, TimeLimitError
from partialbench.progress import training_bar
from partialbench.registry import Recipe

__all__ = ["DivergedError", "Task", "TimeLimitError", "Trained", "train"]

log = logging.getLogger(__name__)

CHECKPOINT_SECONDS = 180.0
"""How much wall time a training that is killed may lose."""


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
    files = RunFolder(folder)
    plan = milestones.plan(task.protocol, task.recipe, clouds, len(task.train_rows))
    identity = task.identity()
    fabric.barrier()  # another process may have been writing what all read now
    loop = Loop(task, fabric, plan)
    path = files.branch(clouds)
    in_branch = path.is_file()
    state = path if in_branch else files.nearest(plan.branch_at * plan.batch)
    if state is not None:
        saved = checkpoint.load(state)
        _require_same_training(saved, identity, state, folder)
        loop.load(saved)
        if "summary" in saved:
            return Trained(loop.bare.eval(), loop.history, saved["summary"])

    def save_trunk() -> None:
        content = loop.content()
        if fabric.is_global_zero:
            target = files.state(loop.clouds_seen)
            target.parent.mkdir(parents=True, exist_ok=True)
            checkpoint.save(target, identity, {**content, "kind": "trunk"})
            files.note(loop.speed())
            files.prune(loop.clouds_seen, [clouds], plan.batch)

    def save_branch() -> None:
        content = loop.content()
        if fabric.is_global_zero:
            path.parent.mkdir(parents=True, exist_ok=True)
            checkpoint.save(path, identity, {**content, "kind": "branch", "clouds": clouds})
            files.note(loop.speed(), branch=(clouds, loop.clouds_seen))

    watched = None
    if log_to == "tensorboard" and fabric.is_global_zero:
        watched = TensorBoard(path.parent / "tensorboard", loop.history)
    with (
        contextlib.closing(watched) if watched else contextlib.nullcontext(),
        training_bar(Console(stderr=True), silent=silent or not fabric.is_global_zero) as progress,
        _Keeper(fabric, loop, checkpoint_every, should_stop) as keeper,
    ):
        bar = progress.add_task(f"{task.model} {milestones.name(clouds)}", total=plan.steps,
                                loss="", completed=loop.step)  # fmt: skip

        def advance(until: int, save: Callable[[], None]) -> None:
            def after_step() -> None:
                if loop.step % CHECK_EVERY == 0 or loop.step == until:
                    shown = f"loss {loop.mean_loss:.3f}" if loop.in_interval else ""
                    progress.update(bar, completed=loop.step, **({"loss": shown} if shown else {}))
                    if watched:
                        watched.update(loop.history)
                keeper.after_step(save)

            loop.advance(until, after_step)

        if not in_branch:
            stops = {*milestones.regular(plan.branch_at, plan.batch), plan.branch_at}
            for stop in sorted(step for step in stops if step > loop.step):
                advance(stop, save_trunk)
                save_trunk()
            loop.begin_branch()
        advance(plan.steps, save_branch)
        content = loop.finished()
        if watched:
            watched.update(loop.history)
    if fabric.is_global_zero:
        path.parent.mkdir(parents=True, exist_ok=True)
        checkpoint.save(path, identity, {**content, "kind": "branch", "clouds": clouds})
        write_atomically(path.with_name("log.csv"), _as_csv(loop.history))
        files.note(loop.speed(), done=clouds)
    fabric.barrier()
    return Trained(loop.bare.eval(), loop.history, content["summary"])


class _Keeper:
    """Decides after each step whether to save, and whether to stop; several processes agree.

    While it is entered, Ctrl-C waits for the step under way; a second one does not.
    """

    GO_ON, SAVE, TIME_IS_OVER, INTERRUPTED = range(4)

    def __init__(
        self,
        fabric: Fabric,
        loop: Loop,
        checkpoint_every: int | None,
        should_stop: Callable[[], bool] | None,
    ) -> None:
        self.fabric, self.loop = fabric, loop
        self.checkpoint_every, self.should_stop = checkpoint_every, should_stop
        self.saved_at, self.interrupted = time.monotonic(), False
        self.before: Any = None

    def __enter__(self) -> _Keeper:
        if threading.current_thread() is threading.main_thread():
            self.before = signal.getsignal(signal.SIGINT)
            if callable(self.before):
                signal.signal(signal.SIGINT, self._note)
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if callable(self.before):
            signal.signal(signal.SIGINT, self.before)
        if self.interrupted and kind is None:
            raise KeyboardInterrupt

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.interrupted = True
        signal.signal(signal.SIGINT, self.before)

    def _wish(self) -> int:
        time_is_over = self.should_stop is not None and self.should_stop()
        if self.interrupted:
            return self.INTERRUPTED
        if time_is_over:
            return self.TIME_IS_OVER
        if time.monotonic() - self.saved_at > CHECKPOINT_SECONDS:
            return self.SAVE
        return self.GO_ON

    def after_step(self, save: Callable[[], None]) -> None:
        """Calls ``save`` where it is time, and raises where it is over."""
        step, wish = self.loop.step, self.GO_ON
        if self.fabric.world_size == 1:
            wish = self._wish()
        elif step % CHECK_EVERY == 0:
            mine = torch.tensor(self._wish(), device=self.fabric.device)
            wishes = self.fabric.all_gather(mine)
            assert isinstance(wishes, torch.Tensor)
            wish = int(wishes.max())
        if self.checkpoint_every is not None and step % self.checkpoint_every == 0:
            wish = max(wish, self.SAVE)
        if wish == self.GO_ON:
            return
        save()
        self.saved_at = time.monotonic()
        if wish == self.INTERRUPTED:
            raise KeyboardInterrupt
        if wish == self.TIME_IS_OVER:
            raise TimeLimitError(
                f"out of time: {self.loop.task.model} is saved at {self.loop.clouds_seen:,} of "
                f"{self.loop.plan.clouds_seen:,} clouds; the same call goes on from there"
            )


def _require_same_training(
    saved: dict[str, Any], identity: dict[str, Any], path: Path, folder: Path
) -> None:
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
