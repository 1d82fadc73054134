"""Speed of the loader: random clouds of 1,024 points from a warm cache, in one process.

    python benchmarks/loader.py [--rows 4000] [--json FILE]

Reading the same rows one by one through h5py is measured beside it, in turns in the same run.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np

from partialbench.dataset.build import BuildPlan, build
from partialbench.dataset.executors import InlineExecutor
from partialbench.dataset.loader import ShardDataset
from partialbench.dataset.rows import Job
from renderers.shapes.source import ParametricShapes
from renderers.whole import WholeOccluder

BATCH, POINTS = 32, 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=int, default=4000)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        views = max(1, arguments.rows // 40)
        job = Job(ParametricShapes((1, 1)), WholeOccluder(2048), "bench", "rotated",
                  {"train": views, "test": 1}, 2048, 0)  # fmt: skip
        build(BuildPlan(job, Path(folder), ("train",)), InlineExecutor)
        data = ShardDataset(folder, "train", POINTS)
        files = [h5py.File(p) for p in sorted(Path(folder).glob("*.h5"))]
        first = np.cumsum([0, *(len(f["label"]) for f in files)])
        rng = np.random.default_rng(0)
        data.points(np.arange(len(data)))  # warms the cache
        seconds = {"ours": 0.0, "ours, random subsets": 0.0, "h5py row by row": 0.0}
        batches = 60
        for _ in range(batches):
            rows = rng.integers(0, len(data), BATCH)
            start = time.perf_counter()
            data.points(rows)
            seconds["ours"] += time.perf_counter() - start
            start = time.perf_counter()
            data.points(rows, rng)
            seconds["ours, random subsets"] += time.perf_counter() - start
            start = time.perf_counter()
            for row in rows:
                shard = int(np.searchsorted(first, row, side="right")) - 1
                files[shard]["points"][row - first[shard], :POINTS]
            seconds["h5py row by row"] += time.perf_counter() - start
        rates = {name: batches * BATCH / s for name, s in seconds.items()}
    for name, rate in rates.items():
        print(f"{name:24} {rate:10,.0f} clouds/s")
    if arguments.json:
        arguments.json.write_text(json.dumps(rates, indent=1))


if __name__ == "__main__":
    main()
