"""How fast training batches are made, and what records and boards cost.

python benchmarks/harness.py [DATA]      DATA: a data folder; without it, clouds in memory
"""

from __future__ import annotations

import sys
import time

import numpy as np

from partialbench.benchmark.protocol.protocol import PRESETS
from partialbench.benchmark.testing.uncertainty import bootstrap_intervals, paired_p_values
from partialbench.benchmark.training.batches import BatchStream
from partialbench.dataset.categories import MODELNET40
from partialbench.dataset.loader import ShardDataset
from partialbench.geometry.rotations import haar_rotations
from partialbench.geometry.symmetry import CLASS_SYMMETRY, map_rotations


def rate(seconds: float, count: int) -> str:
    return f"{count / seconds:10,.0f} /s"


def say(line: str) -> None:
    sys.stdout.write(line + "\n")


def main(data: str | None) -> None:
    if data is None:
        from tests.benchmark.memory_clouds import MemoryClouds

        dataset = MemoryClouds(objects=50, num_points=1024, classes=MODELNET40)
    else:
        dataset = ShardDataset(data, "train", 1024)
    stream = BatchStream(dataset, np.arange(len(dataset)), PRESETS["paper"], 32, seed=0)
    batches = min(100, len(stream))
    for _ in range(2):  # the second from a warm cache
        start = time.perf_counter()
        for _ in stream.steps(0, batches):
            pass
        seconds = time.perf_counter() - start
    say(f"augmented training clouds of 1,024 points {rate(seconds, 32 * batches)}")

    rng = np.random.default_rng(0)
    rotations = haar_rotations(rng, 32)
    names = np.array([CLASS_SYMMETRY.get(MODELNET40[i], "none") for i in rng.integers(0, 40, 32)])
    start = time.perf_counter()
    for _ in range(200):
        map_rotations(rotations, names)
    say(f"Map of a mixed batch of 32 rotations      {rate(time.perf_counter() - start, 200)}")

    values = (rng.random((2468, 12)) < 0.8).astype(float)
    start = time.perf_counter()
    bootstrap_intervals(values, np.arange(2468))
    say(f"intervals of 12 rows, 2,468 objects       {time.perf_counter() - start:10.2f} s")
    start = time.perf_counter()
    paired_p_values(values, np.arange(2468))
    say(f"paired tests of 66 pairs                  {time.perf_counter() - start:10.2f} s")


if __name__ == "__main__":
    main(*(sys.argv[1:] or [None]))
