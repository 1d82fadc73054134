"""Trains one model under the ``board`` preset, as many steps as ``benchmarks.training`` says.

    python -P benchmarks/training_worker.py     with PYTHONPATH the tree to be measured

A line of stdin is JSON: an object says which model is trained from now on (model, options, clouds
(an .npz), precision), a number how many steps are taken, and the answer is the CPU seconds that
they took. The same file serves trees of the past, so it finds what it needs by the names it has
had.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import sys
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

BATCH, POINTS, NUM_CLASSES = 32, 256, 40


def found(name: str, *modules: str) -> Any:
    """What is called ``name`` in the first of the modules that this tree has."""
    for module in modules:
        with contextlib.suppress(ModuleNotFoundError):
            if hasattr(importlib.import_module(module), name):
                return getattr(importlib.import_module(module), name)
    raise SystemExit(f"this tree has no {name} in {', '.join(modules)}")


class Clouds:
    """What the stream of batches asks of a data set, from arrays."""

    dataset_id, digest, setting, num_points = "measured", "", "partial", POINTS
    has_poses, has_normals = True, False

    def __init__(self, path: str) -> None:
        with np.load(path) as arrays:
            self.stored, self.labels = arrays["points"], arrays["labels"]
            self.rotations, self.symmetries = arrays["rotations"], arrays["symmetries"]

    def __len__(self) -> int:
        return len(self.labels)

    def points(self, indices: Any, rng: Any = None, distinct: bool = False) -> Any:
        order = rng.random((len(indices), self.stored.shape[1])).argpartition(POINTS)[:, :POINTS]
        return np.take_along_axis(self.stored[indices], order[..., None], axis=1)


def steps(order: dict[str, Any]) -> Iterator[None]:
    """Training steps without end: batch, loss, gradients, AdamW."""
    from partialbench import registry

    rooms = "partialbench.benchmark.training", "partialbench.benchmark"
    protocols = "partialbench.benchmark.protocol.protocol", "partialbench.benchmark.protocol"
    rules = "partialbench.benchmark.protocol.recipe", "partialbench.benchmark.recipe"
    optimizers = "partialbench.benchmark.training.optimizers", "partialbench.benchmark.recipe"
    presets = found("PRESETS", *protocols)
    preset = presets["board"] if "board" in presets else presets["equal"]
    recipe = found("override", *rules)(
        registry.card(order["model"]).recipe,
        {"optimizer": "adamw", "lr": 1e-3, "weight_decay": 0.01, "batch_size": BATCH},
    )
    clouds = Clouds(order["clouds"])
    torch.manual_seed(0)
    model = registry.create(order["model"], NUM_CLASSES, **order["options"])
    loss_of = found("WithLoss", f"{rooms[0]}.loop", f"{rooms[1]}.train")(model, 0.1, NUM_CLASSES)
    optimizer = found("make_optimizer", *optimizers)(loss_of, recipe)
    stream = found("BatchStream", *(f"{room}.batches" for room in rooms))(
        clouds, np.arange(len(clouds)), preset, BATCH, 0
    )
    place = found("Place", *(f"{room}.batches" for room in rooms))
    half = order["precision"] == "bf16-mixed"
    loss_of.train()
    for step in range(1 << 30):
        where = place(*divmod(step, len(stream)))
        batch = stream.make(where, stream.order(where.epoch))
        with torch.autocast("cpu", torch.bfloat16, enabled=half):
            loss = loss_of(batch)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        yield


def main() -> None:
    torch.set_num_threads(1)
    keep = found(
        "keep_freed_memory",
        "partialbench.benchmark.training.memory", "partialbench.benchmark.memory",
    )  # fmt: skip
    keep()
    training: Iterator[None] = iter(())
    for line in sys.stdin:
        order = json.loads(line)
        if isinstance(order, dict):
            training = steps(order)
            continue
        start = time.process_time()
        for _ in range(order):
            next(training)
        sys.stdout.write(json.dumps(time.process_time() - start) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
