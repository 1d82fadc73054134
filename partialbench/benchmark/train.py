"""Training one model under the protocol, from top to bottom.

Every random draw is keyed by where it happens: initial weights by (seed), the order by
(seed, epoch), augmentation and dropout by (seed, epoch, batch). So a run that was killed and
resumed ends with the weights of one that was not, and a checkpoint holds no generator's state.
A model must draw from torch's generators alone for that to hold.
"""

from __future__ import annotations

import csv
import io
import json
import logging
import math
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning.fabric import Fabric
from numpy.typing import NDArray
from rich.console import Console
from torch import Tensor, nn
from torch.nn.functional import cross_entropy

from partialbench.benchmark import (
    audit,
    checkpoint,
    duplicates,
    environment,
    evaluate,
    finetune,
    inputs,
    models,
)
from partialbench.benchmark import recipe as recipes
from partialbench.benchmark.batches import BatchStream, Clouds, Place
from partialbench.benchmark.prediction import Batch, Prediction
from partialbench.benchmark.protocol import Protocol
from partialbench.benchmark.results import describe_data
from partialbench.benchmark.schedule import Schedule
from partialbench.dataset.seeding import generator
from partialbench.dataset.shards import write_atomically
from partialbench.errors import ConfigurationMismatchError, PartialbenchError
from partialbench.progress import training_bar
from partialbench.registry import Recipe

log = logging.getLogger(__name__)

CHECK_EVERY = 10
"""Steps between looks at the loss: each look waits for the device."""


class DivergedError(PartialbenchError):
    """The training loss is no longer a finite number."""


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
        history: one row an epoch, as in log.csv.
        summary: epochs, steps, clouds seen, seconds (wall time of all its parts, interruptions not
            counted), median clouds per second, the last epoch's loss and validation accuracy and
            the curves of both, peak memory, the environment it ended in and, where parts before an
            interruption ran in others, ``earlier_environments``, and where it did not begin from
            random weights, its ``start``.
    """

    model: nn.Module
    history: list[dict[str, Any]]
    summary: dict[str, Any]


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


def train(
    task: Task,
    fabric: Fabric,
    folder: Path,
    resume: bool = False,
    checkpoint_every: int | None = None,
) -> Trained:
    """Trains, writing ``checkpoint.pt`` after every epoch and ``log.csv`` beside it.

    Args:
        fabric: launched; it chooses device, precision and processes. Only rank 0 writes.
        folder: of this run alone.
        resume: continue from the checkpoint in ``folder``, if there is one; without it an earlier
            checkpoint there is overwritten.
        checkpoint_every: also after every so many steps.

    Raises:
        DivergedError: NaN or infinite loss.
        ConfigurationMismatchError: the checkpoint to resume is of another training.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "checkpoint.pt"
    class_names = list(task.dataset.class_names)
    num_classes = len(class_names)

    # The model, its optimiser and schedule, and the batches: all from the seed and the recipe.
    torch.manual_seed(step_seed(task.seed, "init"))
    bare = models.create(task.model, num_classes, task.options)
    identity = task.identity()
    if task.start is not None:
        fresh = finetune.begin(
            bare, task.start, class_names, lambda k: models.create(task.model, k, task.options)
        )
        log.info("begun from %s%s", task.start.origin["name"],
                 f"; of other classes, so new: {', '.join(fresh)}" if fresh else "")  # fmt: skip
    wrapped = WithLoss(
        bare, recipes.label_smoothing(task.recipe, num_classes), num_classes, fabric.world_size
    )
    if fabric.world_size > 1 and fabric.device.type == "cuda":
        wrapped = nn.SyncBatchNorm.convert_sync_batchnorm(wrapped)
    network, optimizer = fabric.setup(wrapped, recipes.make_optimizer(wrapped, task.recipe))
    bare = wrapped.model
    stream = BatchStream(
        task.dataset, task.train_rows, task.protocol, task.recipe.batch_size, task.seed,
        fabric.global_rank, fabric.world_size, normals=inputs.needs_normals(bare),
    )  # fmt: skip
    epochs = task.protocol.num_epochs(task.recipe, len(task.train_rows))
    schedule = Schedule(task.recipe, epochs)
    total_steps = epochs * len(stream)
    log.info(task.protocol.describe_epochs(task.recipe, len(task.train_rows)))
    train_sources = duplicates.source_keys(task.dataset.source_digests)
    if task.start is not None:
        train_sources = sorted({*train_sources, *task.start.train_sources})

    # Where it stands: the next batch to take, and the running sums of the epoch under way.
    epoch, batch_index, loss_sum, seconds = 0, 0, 0.0, 0.0
    history: list[dict[str, Any]] = []
    here = environment.describe(fabric.device, fabric.world_size, environment.precision_of(fabric))
    environments = [here]
    if resume and path.is_file():
        saved = checkpoint.load(path)
        _require_same_training(saved, identity, path)
        bare.load_state_dict(saved["state"])
        epoch, batch_index, loss_sum = saved["epoch"], saved["batch"], saved["loss_sum"]
        history, seconds = saved["history"], saved["seconds"]
        # Checkpoints have not always said it.
        earlier = [e for e in saved.get("environments", []) if e != here]
        environments = [*earlier, here]
        if "summary" in saved:
            return Trained(bare.eval(), history, saved["summary"])
        optimizer.load_state_dict(saved["optimizer"])
        schedule.load_state_dict(saved["schedule"])

    def summary() -> dict[str, Any]:
        return {
            "epochs": epochs,
            "steps": total_steps,
            "clouds_seen": total_steps * stream.batch_size,
            "seconds": seconds + time.perf_counter() - started,
            "clouds_per_second": float(np.median([r["clouds_per_second"] for r in history])),
            "train_loss": history[-1]["train_loss"],
            "validation_accuracy": history[-1]["validation_accuracy"],
            "curve": {
                name: [None if r[name] is None else round(r[name], 5) for r in history]
                for name in ("train_loss", "validation_accuracy")
            },
            "peak_memory_bytes": audit.peak_memory_bytes(fabric.device),
            "environment": here,
            **({"earlier_environments": environments[:-1]} if len(environments) > 1 else {}),
            **({"start": task.start.origin} if task.start is not None else {}),
        }

    def save() -> None:
        if not fabric.is_global_zero:
            return
        state: dict[str, Any] = {
            "state": {name: tensor.detach().cpu() for name, tensor in bare.state_dict().items()},
            "epoch": epoch, "batch": batch_index, "loss_sum": loss_sum, "history": history,
            "seconds": seconds + time.perf_counter() - started, "train_sources": train_sources,
            "environments": environments,
        }  # fmt: skip
        if epoch < epochs:
            state |= {"optimizer": optimizer.state_dict(), "schedule": schedule.state_dict()}
        else:
            state["summary"] = done
        checkpoint.save(path, identity, state)

    done: dict[str, Any] | None = None
    started = time.perf_counter()
    unread: list[Tensor] = []
    with training_bar(Console(stderr=True), silent=not fabric.is_global_zero) as progress:
        bar = progress.add_task(task.model, total=total_steps, loss="")
        while epoch < epochs:
            epoch_started, first_batch = time.perf_counter(), batch_index
            network.train()
            for place, batch in stream.epoch(epoch, batch_index):
                step = place.epoch * len(stream) + place.batch
                rate = schedule.apply(optimizer, bare, step / total_steps)
                torch.manual_seed(step_seed(task.seed, "step", *place, fabric.global_rank))
                loss = network(_to(batch, fabric.device))
                optimizer.zero_grad(set_to_none=True)
                fabric.backward(loss)
                if task.recipe.clip_norm is not None:
                    fabric.clip_gradients(
                        network, optimizer, max_norm=task.recipe.clip_norm,
                        error_if_nonfinite=False,  # _look says more about it
                    )  # fmt: skip
                optimizer.step()
                unread.append(loss.detach())
                batch_index = place.batch + 1
                ends_epoch = batch_index == len(stream)
                wants_save = checkpoint_every is not None and (step + 1) % checkpoint_every == 0
                if batch_index % CHECK_EVERY == 0 or ends_epoch or wants_save:
                    loss_sum = _look(fabric, unread, loss_sum, task, place)
                    shown = f"loss {loss_sum / batch_index:.3f}"
                    progress.update(bar, completed=step + 1, loss=shown)
                if wants_save and not ends_epoch:
                    save()
            train_seconds = time.perf_counter() - epoch_started
            train_loss = loss_sum / len(stream)
            schedule.end_epoch(train_loss)
            measured = (len(stream) - first_batch) * stream.batch_size
            history.append(
                {
                    "epoch": epoch,
                    "clouds_seen": (epoch + 1) * len(stream) * stream.batch_size,
                    "lr": rate,
                    "train_loss": train_loss,
                    "validation_accuracy": evaluate.quick_accuracy(
                        bare, task.dataset, task.validation_rows, fabric.device
                    ),
                    "clouds_per_second": measured / train_seconds,
                }
            )
            log.info("epoch %d of %d: %s", epoch + 1, epochs, json.dumps(history[-1]))
            epoch, batch_index, loss_sum = epoch + 1, 0, 0.0
            if epoch == epochs:
                done = summary()
            save()
            if fabric.is_global_zero:
                write_atomically(folder / "log.csv", _as_csv(history))
    fabric.barrier()
    assert done is not None
    return Trained(bare.eval(), history, done)


def _look(fabric: Fabric, unread: list[Tensor], loss_sum: float, task: Task, place: Place) -> float:
    """``loss_sum`` with the ``unread`` losses added and the list emptied; each must be finite."""
    losses = fabric.all_reduce(torch.stack(unread), reduce_op="mean")
    assert isinstance(losses, Tensor)
    unread.clear()
    # One after the other: so the sum does not depend on how often one looks.
    for loss in losses.tolist():
        loss_sum += loss
    if not math.isfinite(loss_sum):
        raise DivergedError(
            f"the training loss of {task.model} became {loss_sum} in epoch {place.epoch}, within "
            f"{CHECK_EVERY} steps of step {place.batch}; nothing was saved since the checkpoint "
            f"before. Lower lr (now {task.recipe.lr:g}), set clip_norm, or use full precision"
        )
    return loss_sum


def _to(batch: Batch, device: torch.device) -> Batch:
    moved = {
        name: tensor.to(device, non_blocking=True)
        for name, tensor in batch._asdict().items()
        if tensor is not None
    }
    return Batch(**moved)


def _require_same_training(saved: dict[str, Any], identity: dict[str, Any], path: Path) -> None:
    differing = [name for name in checkpoint.IDENTITY if saved[name] != identity[name]]
    if differing:
        details = "; ".join(f"{n}: {saved[n]!r} there, {identity[n]!r} now" for n in differing)
        raise ConfigurationMismatchError(
            f"{path} is of another training ({details}); choose another --results folder, or "
            f"start over: delete {path.parent}, or run eval without --resume"
        )


def _as_csv(history: list[dict[str, Any]]) -> bytes:
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(history[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(history)
    return text.getvalue().encode()
