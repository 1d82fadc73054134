"""Speed of exports: clouds of 1,024 points, from shards in the file cache to Parquet and tar.

    python benchmarks/export.py [--rows 20000] [--threads 2] [--json FILE]

Beside it, in turns in the same run, the least that any copy must do: read the shards, take the
digests of what was read and of as many bytes written. Wall time moves with whatever else the
machine does; a rate per CPU second says what one core carries.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from partialbench.dataset.build import BuildPlan, build
from partialbench.dataset.executors import InlineExecutor
from partialbench.dataset.export import export
from partialbench.dataset.rows import Job
from renderers.shapes.source import ParametricShapes
from renderers.whole import WholeOccluder

POINTS = 1024


def copy(folder: Path, out: Path) -> None:
    """Every shard read, digested, written and digested again."""
    out.mkdir()
    for path in sorted(folder.glob("*.h5")):
        content = path.read_bytes()
        hashlib.sha256(content).digest()
        (out / path.name).write_bytes(content)
        hashlib.sha256((out / path.name).read_bytes()).digest()


def timed(rows: int, work: Callable[[], object]) -> dict[str, float]:
    """Rows a second of wall time, and of CPU time over all threads."""
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return {"rows_per_second": rows / wall, "rows_per_cpu_second": rows / cpu}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=int, default=20_000)
    parser.add_argument("--threads", type=int, default=min(4, os.cpu_count() or 1))
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    views = max(1, arguments.rows // 40)
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made) / "data"
        job = Job(ParametricShapes((1, 1)), WholeOccluder(POINTS), "bench", "rotated",
                  {"train": views, "test": 1}, POINTS, 0)  # fmt: skip
        manifest = build(BuildPlan(job, folder, ("train",)), InlineExecutor)
        rows = manifest.rows("train")
        export(folder, "parquet", Path(made) / "first")  # imports, and the file cache
        found: dict[str, dict[str, float]] = {}
        for turn in range(3):
            for name, work in {
                "copied and digested, 1 thread": lambda out: copy(folder, out),
                "parquet, 1 thread": lambda out: export(folder, "parquet", out, threads=1),
                f"parquet, {arguments.threads} threads": lambda out: export(
                    folder, "parquet", out, threads=arguments.threads
                ),
            }.items():
                out = Path(made) / f"{name}-{turn}"
                rates = timed(rows, lambda work=work, out=out: work(out))  # type: ignore[misc]
                best = found.setdefault(name, rates)
                found[name] = {key: max(best[key], rate) for key, rate in rates.items()}
    for name, rates in found.items():
        print(f"{name:32} {rates['rows_per_second']:10,.0f} clouds/s "
              f"{rates['rows_per_cpu_second']:10,.0f} a CPU second")  # fmt: skip
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
