"""The steps of a training, whether of a trunk or of a branch, and what is saved between them.

Every random draw is keyed by where it happens: initial weights by (seed), the order by
(seed, epoch), augmentation and dropout by (seed, epoch, batch). So a run that was killed and
resumed ends with the weights of one that was not, and a checkpoint holds no generator's state.
A model must draw from torch's generators alone for that to hold.
"""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from lightning.fabric import Fabric
from torch import Tensor, nn
from torch.nn.functional import cross_entropy

from partialbench.benchmark import environment, inputs, models
from partialbench.benchmark.prediction import Batch, Prediction
from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.protocol import recipe as recipes
from partialbench.benchmark.protocol.milestones import Plan
from partialbench.benchmark.protocol.schedule import Schedule
from partialbench.benchmark.testing import audit, duplicates, evaluate
from partialbench.benchmark.training import finetune
from partialbench.benchmark.training.average import (
    FRESH_BATCHES,
    WeightMean,
    refresh_statistics,
)
from partialbench.benchmark.training.batches import BatchStream, Place
from partialbench.benchmark.training.optimizers import as_made, make_optimizer
from partialbench.benchmark.training.seeds import seed_all
from partialbench.dataset.seeding import generator
from partialbench.errors import PartialbenchError

if TYPE_CHECKING:
    from partialbench.benchmark.training.train import Task

log = logging.getLogger(__name__)

CHECK_EVERY = 10
"""Steps between looks at the loss: each look waits for the device."""


class DivergedError(PartialbenchError):
    """The training loss is no longer a finite number."""


def step_seed(seed: int, *key: str | int) -> int:
    """A seed for torch's generators."""
    return int(generator(seed, *key).integers(2**63))


class WithLoss(nn.Module):
    """A model and its training loss as one forward pass, which is what data parallelism wraps.

    The loss is the model's own ``training_loss(batch)`` where it has one; else cross entropy with
    the recipe's label smoothing plus the prediction's penalty. Both losses are means over the
    batch; the penalty is a sum over it, and so counts ``processes`` times here: data parallelism
    averages the gradients of the processes' shares, which would divide the sum.
    """

    def __init__(
        self, model: nn.Module, label_smoothing: float, num_classes: int, processes: int = 1
    ) -> None:
        super().__init__()
        self.model, self.label_smoothing, self.num_classes = model, label_smoothing, num_classes
        self.processes = processes

    def forward(self, batch: Batch) -> Tensor:
        """A scalar."""
        own_loss = getattr(self.model, "training_loss", None)
        if callable(own_loss):
            return own_loss(batch)
        given = {} if batch.normals is None else {inputs.NORMALS: batch.normals}
        prediction: Prediction = models.as_prediction(
            self.model(batch.points, **given), len(batch.label), self.num_classes
        )
        loss = cross_entropy(
            prediction.class_logits, batch.label, label_smoothing=self.label_smoothing
        )
        if prediction.penalty is None:
            return loss
        return loss + self.processes * prediction.penalty


class Loop:
    """A model, its optimiser and its batches, at some step of a plan.

    Attributes:
        bare: the module without what data parallelism wraps around it.
        step: how many are taken.
        history: the log's lines, see ``train.Trained``.
    """

    def __init__(self, task: Task, fabric: Fabric, plan: Plan) -> None:
        self.task, self.fabric, self.plan = task, fabric, plan
        class_names = list(task.dataset.class_names)
        seed_all(step_seed(task.seed, "init"))
        bare = models.create(task.model, len(class_names), task.options)
        inputs.require_poses(task.dataset, bare, task.model)
        if task.start is not None:
            fresh = finetune.begin(
                bare, task.start, class_names, lambda k: models.create(task.model, k, task.options)
            )
            new = f"; of other classes, so new: {', '.join(fresh)}" if fresh else ""
            log.info("begun from %s%s", task.start.origin["name"], new)
        wrapped = WithLoss(
            bare, recipes.label_smoothing(task.recipe, len(class_names)), len(class_names),
            fabric.world_size,
        )  # fmt: skip
        if fabric.world_size > 1 and fabric.device.type == "cuda":
            wrapped = nn.SyncBatchNorm.convert_sync_batchnorm(wrapped)
        self.network, self.optimizer = fabric.setup(wrapped, make_optimizer(wrapped, task.recipe))
        self.bare: nn.Module = wrapped.model
        self.stream = BatchStream(
            task.dataset, task.train_rows, task.protocol, task.recipe.batch_size, task.seed,
            fabric.global_rank, fabric.world_size, normals=inputs.needs_normals(self.bare),
        )  # fmt: skip
        self.schedule = Schedule(task.recipe, plan)
        log.info(milestones.describe(plan, task.recipe, len(task.train_rows)))
        sources = duplicates.source_keys(task.dataset.source_digests)
        self.train_sources = sorted({*sources, *(task.start.train_sources if task.start else ())})
        # Where it stands, and the losses since the log's last line: read ones summed, others not.
        self.step, self.loss_sum, self.in_interval = 0, 0.0, 0
        self.unread: list[Tensor] = []
        self.history: list[dict[str, Any]] = []
        self.average = WeightMean() if task.recipe.average else None
        self.seconds, self.started = 0.0, time.perf_counter()
        self.timed, self.timed_since = 0, time.perf_counter()
        self.here = environment.describe(
            fabric.device, fabric.world_size, environment.precision_of(fabric)
        )
        self.environments = [self.here]

    @property
    def clouds_seen(self) -> int:
        return self.step * self.plan.batch

    def load(self, saved: dict[str, Any]) -> None:
        """Goes on from what ``content`` gave, of this training's trunk or of this branch."""
        self.bare.load_state_dict(saved["state"])
        self.step, self.loss_sum = saved["step"], saved["loss_sum"]
        self.in_interval, self.history = saved["in_interval"], list(saved["history"])
        self.seconds, self.started = saved["seconds"], time.perf_counter()
        self.environments = [*(e for e in saved["environments"] if e != self.here), self.here]
        if "optimizer" in saved:
            self.optimizer.load_state_dict(as_made(saved["optimizer"], self.optimizer))
            self.schedule.load_state_dict(saved["schedule"])
        if self.average is not None and "average" in saved:
            self.average.load(saved, self.bare)

    def content(self) -> dict[str, Any]:
        """All that going on from here needs. Every process must call it."""
        self.look()
        return {
            **self._weights(), "optimizer": self.optimizer.state_dict(),
            "schedule": self.schedule.state_dict(),
            **(self.average.state() if self.average is not None and self.average.count else {}),
        }  # fmt: skip

    def finished(self) -> dict[str, Any]:
        """Of a branch that is done: its weights, and the summary of how it got there. Every
        process must call it."""
        if self.average is not None:
            self.average.put_into(self.bare)
            refresh_statistics(self.bare, self._passes())
        self.history[-1]["validation_accuracy"] = evaluate.quick_accuracy(
            self.bare, self.task.dataset, self.task.validation_rows, self.fabric.device
        )
        return {**self._weights(), "summary": self._summary()}

    def _passes(self) -> Iterator[None]:
        """Forward passes in training mode over the batches that would have come next."""
        self.network.train()
        for step, place, batch in self.stream.steps(self.step, self.step + FRESH_BATCHES):
            seed_all(step_seed(self.task.seed, "average", step, *place, self.fabric.global_rank))
            self.network(_to(batch, self.fabric.device))
            yield

    def _weights(self) -> dict[str, Any]:
        return {
            "state": {
                name: tensor.detach().cpu() for name, tensor in self.bare.state_dict().items()
            },
            "step": self.step, "clouds_seen": self.clouds_seen, "loss_sum": self.loss_sum,
            "in_interval": self.in_interval, "history": self.history,
            "seconds": self.seconds + time.perf_counter() - self.started,
            "train_sources": self.train_sources, "environments": self.environments,
        }  # fmt: skip

    def _summary(self) -> dict[str, Any]:
        plan, history = self.plan, self.history
        return {
            "clouds": plan.clouds,
            "epochs": plan.epochs or round(plan.steps / plan.epoch_steps, 4),
            "steps": plan.steps,
            "clouds_seen": plan.clouds_seen,
            "seconds": self.seconds + time.perf_counter() - self.started,
            "clouds_per_second": self.speed(),
            "train_loss": history[-1]["train_loss"],
            "validation_accuracy": history[-1]["validation_accuracy"],
            "curve": {
                "clouds_seen": [row["clouds_seen"] for row in history],
                **{
                    name: [None if row[name] is None else round(row[name], 5) for row in history]
                    for name in ("train_loss", "validation_accuracy")
                },
            },
            "peak_memory_bytes": audit.peak_memory_bytes(self.fabric.device),
            "environment": self.here,
            **(
                {"earlier_environments": self.environments[:-1]}
                if len(self.environments) > 1 else {}
            ),
            **({"start": self.task.start.origin} if self.task.start is not None else {}),
        }  # fmt: skip

    def speed(self) -> float | None:
        """Median clouds a second of the log's lines, None before the first."""
        speeds = [row["clouds_per_second"] for row in self.history]
        measured = [speed for speed in speeds if speed is not None]
        return float(np.median(measured)) if measured else None

    def begin_branch(self) -> None:
        """Ends the line of the log that the trunk would have gone on with."""
        if self.in_interval:
            self._end_interval()

    def advance(self, until: int, after_step: Callable[[], None]) -> None:
        """Takes steps until so many are taken.

        Args:
            after_step: called after each; what it raises ends the training.
        """
        self.network.train()
        self.timed, self.timed_since = 0, time.perf_counter()
        for step, place, batch in self.stream.steps(self.step, until):
            self.schedule.apply(self.optimizer, self.bare, step)
            seed_all(step_seed(self.task.seed, "step", *place, self.fabric.global_rank))
            self._take(batch)
            if self.average is not None and step >= self.plan.branch_at:
                self.average.add(self.bare)
            self.step, self.in_interval, self.timed = step + 1, self.in_interval + 1, self.timed + 1
            ends = self.plan.ends_interval(self.step, in_branch=step >= self.plan.branch_at)
            if ends or self.step % CHECK_EVERY == 0 or self.step == until:
                self.look(place)
            if ends:
                self._end_interval()
            after_step()

    def _take(self, batch: Batch) -> None:
        on_device = _to(batch, self.fabric.device)
        loss = self.network(on_device)
        self.optimizer.zero_grad(set_to_none=True)
        self.fabric.backward(loss)
        if self.task.recipe.clip_norm is not None:
            self.fabric.clip_gradients(
                self.network, self.optimizer, max_norm=self.task.recipe.clip_norm,
                error_if_nonfinite=False,  # ``look`` says more about it
            )  # fmt: skip
        self.optimizer.step()
        self.unread.append(loss.detach())

    def look(self, place: Place | None = None) -> None:
        """Reads the losses of the steps since the last look; each must be finite."""
        if not self.unread:
            return
        losses = self.fabric.all_reduce(torch.stack(self.unread), reduce_op="mean")
        assert isinstance(losses, Tensor)
        self.unread.clear()
        # One after the other: so the sum does not depend on how often one looks.
        for loss in losses.tolist():
            self.loss_sum += loss
        if not math.isfinite(self.loss_sum):
            raise DivergedError(
                f"the training loss of {self.task.model} became {self.loss_sum} within "
                f"{CHECK_EVERY} steps before {self.clouds_seen:,} clouds; nothing was saved since "
                f"the state before. Lower lr (now {self.task.recipe.lr:g}), set clip_norm, or use "
                f"full precision"
            )

    @property
    def mean_loss(self) -> float:
        """Since the log's last line."""
        return self.loss_sum / max(1, self.in_interval)

    def _end_interval(self) -> None:
        """Writes a line of the log."""
        self.look()
        self.schedule.end_epoch(self.mean_loss)
        timed = time.perf_counter() - self.timed_since
        # A branch that begins from a saved state has taken no step yet.
        speed = self.timed * self.plan.batch / timed if self.timed else None
        self.history.append(
            {
                "clouds_seen": self.clouds_seen, "lr": self.optimizer.param_groups[0]["lr"],
                "train_loss": self.mean_loss, "validation_accuracy": None,
                "clouds_per_second": speed,
            }
        )  # fmt: skip
        log.info("%s", json.dumps(self.history[-1]))
        self.loss_sum, self.in_interval = 0.0, 0
        self.timed, self.timed_since = 0, time.perf_counter()


def _to(batch: Batch, device: torch.device) -> Batch:
    moved = {
        name: tensor.to(device, non_blocking=True)
        for name, tensor in batch._asdict().items()
        if tensor is not None
    }
    return Batch(**moved)
