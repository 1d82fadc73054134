"""How much of a model's accuracy its pose costs: the class under the true pose, a noisy one, none.

    python -m benchmarks.given_pose --checkpoint results/runs/…/checkpoint.pt --data DIR [--json]

For a model that takes a rotation (``papnet``, ``papnet-steered``): test accuracy with its own pose,
with the labelled one (the paper's upper bound), with that one after the paper's noise on every
Euler angle (U(−δ, δ)), and with a random one. Intervals are 95 %, by bootstrap over objects.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from papnet.pose import noise
from partialbench.benchmark import checkpoint
from partialbench.benchmark.batches import map_rotations
from partialbench.benchmark.memory import keep_freed_memory
from partialbench.benchmark.uncertainty import bootstrap_intervals
from partialbench.dataset.loader import ShardDataset
from partialbench.dataset.seeding import generator
from partialbench.geometry.rotations import haar_rotations

BATCH = 32
DELTAS_DEG = (15.0, 30.0, 45.0)
Given = Callable[[Tensor], Tensor | None]


def givens(seed: int) -> dict[str, Given]:
    """What is given for the true poses (B,3,3), by name."""
    rng = generator(seed, "random pose")
    table: dict[str, Given] = {"its own pose": lambda R: None, "true pose": lambda R: R}
    for delta in DELTAS_DEG:
        table[f"true pose ± {delta:.0f}°"] = lambda R, delta=delta: noise(R, delta)
    table["random pose"] = lambda R: torch.from_numpy(haar_rotations(rng, len(R))).float()
    return table


def measure(path: Path, data: Path) -> dict[str, tuple[float, float, float]]:
    """{what is given: (accuracy, lower, upper bound)}."""
    content = checkpoint.load(path)
    model = checkpoint.build_model(content)
    test = ShardDataset(data, "test", content["num_points"])
    if test.class_names != tuple(content["class_names"]):
        sys.exit(f"{data} has other classes than the model")
    torch.manual_seed(0)
    table = givens(seed=0)
    right: dict[str, list[Tensor]] = {name: [] for name in table}
    with torch.inference_mode():
        for start in range(0, len(test), BATCH):
            rows = np.arange(start, min(start + BATCH, len(test)))
            points, label = torch.from_numpy(test.points(rows)), torch.from_numpy(test.labels[rows])
            mapped = map_rotations(test.rotations[rows], test.symmetries[rows])
            R = torch.from_numpy(mapped).float()
            for name, given in table.items():
                pose = given(R)
                out = model(points) if pose is None else model(points, rotation=pose)
                right[name].append(out.class_logits.argmax(1) == label)
    values = np.stack([torch.cat(found).numpy() for found in right.values()], axis=1)
    bounds = bootstrap_intervals(values, test.object_ids)
    return {
        name: (float(mean), float(low), float(high))
        for name, mean, (low, high) in zip(table, values.mean(0), bounds, strict=True)
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--checkpoint", type=Path, required=True)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    keep_freed_memory()
    found = measure(arguments.checkpoint, arguments.data)
    if arguments.json:
        sys.stdout.write(json.dumps(found) + "\n")
        return
    for name, (mean, low, high) in found.items():
        sys.stdout.write(f"{name:<20}{mean:>7.1%}   ({low:.1%} – {high:.1%})\n")


if __name__ == "__main__":
    main()
