"""What one training cloud costs on one core: old code and new code, in turns, in one sitting.

    python -m benchmarks.training --base REF [REF ...] --data DIR [--out docs/training_speed.md]

Each REF (a tag or a commit) is unpacked into a temporary folder. For every model of the paper a
process of each tree trains under the ``board`` preset (batches of 32 clouds of 256 points, one
thread, AdamW, the augmentation and the loss included); they take their steps in turns, and each
figure is the median over the turns of the CPU time of a step, which a busy machine disturbs least.
``--also bf16-mixed`` adds the new code in that precision.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import re
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.training_worker import BATCH
from partialbench.benchmark.preflight import FULL_PRECISION
from partialbench.dataset.loader import ShardDataset

HERE = Path(__file__).resolve().parent.parent
NEW = "now"

MODELS: dict[str, dict[str, int]] = {
    "papnet-steered": {},
    "papnet-steered-nopose": {},
    "pointnet": {},
    "pointnet2-ssg": {},
    "pointnet2-msg": {},
    "dgcnn": {},
    "spherical-cnn": {},
    "rri-pointnet2": {},
    "itnet-pointnet2": {},
    "tnet-pointnet2": {},
    "simpleview": {"image": 64},
    "steerable-cnn": {"grid": 16},
    "papnet": {"grid": 16},
}
"""The paper's, with the options that the board trains them with."""


class Trainer:
    """A process that trains one model after the other with the code of one tree."""

    def __init__(self, tree: Path, precision: str) -> None:
        self.precision = precision
        worker = str(HERE / "benchmarks" / "training_worker.py")
        self.process = subprocess.Popen(
            [sys.executable, "-P", worker],
            env={**os.environ, "PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"},
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip

    def _send(self, order: Any) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(order) + "\n")
        self.process.stdin.flush()

    def begin(self, model: str, clouds: Path) -> None:
        """Trains this model from here on."""
        options = MODELS[model]
        self._send(
            {
                "model": model, "options": options, "clouds": str(clouds),
                "precision": self.precision,
            }
        )  # fmt: skip

    def step(self) -> float:
        """CPU milliseconds a cloud of one step."""
        self._send(1)
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit(f"a trainer left with status {self.process.wait()}")
        return json.loads(line) / BATCH * 1e3

    def close(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()


def measure(model: str, trainers: dict[str, Trainer], clouds: Path, turns: int) -> dict[str, float]:
    """Milliseconds a cloud by tree, the first step of each left out."""
    for trainer in trainers.values():
        trainer.begin(model, clouds)
    taken: dict[str, list[float]] = {name: [] for name in trainers}
    for turn in range(turns + 1):
        for name, trainer in trainers.items():
            milliseconds = trainer.step()
            if turn:
                taken[name].append(milliseconds)
    return {name: statistics.median(values) for name, values in taken.items()}


def unpack(ref: str, into: Path) -> Path:
    """The tree of a commit."""
    into.mkdir()
    archive = subprocess.run(
        ["git", "-C", str(HERE), "archive", ref], check=True, capture_output=True
    ).stdout
    subprocess.run(["tar", "x", "-C", str(into)], input=archive, check=True)
    return into


def write_clouds(data: str, path: Path, count: int = 256) -> None:
    """Some training rows spread over a data folder, for trees that may not read its format."""
    rows = ShardDataset(data, "train", 512)
    chosen = np.linspace(0, len(rows) - 1, count).astype(int)
    np.savez(
        path, points=rows.points(chosen), labels=rows.labels[chosen],
        rotations=rows.rotations[chosen], symmetries=rows.symmetries[chosen],
    )  # fmt: skip


def table(rows: dict[str, dict[str, float]], bases: Sequence[str], new: Sequence[str]) -> str:
    """Markdown: milliseconds a cloud, and how many times as fast the new columns are."""
    columns = [(base, column) for base in bases for column in new]
    heads = [*bases, *new, *(f"{a} / {b}" for a, b in columns)]
    lines = [f"| model | {' | '.join(heads)} |", f"| --- |{' ---: |' * len(heads)}"]
    for model, times in rows.items():
        cells = [f"{times[name]:.2f}" for name in (*bases, *new)]
        cells += [f"{times[a] / times[b]:.2f}" for a, b in columns]
        options = "".join(f", {k} {v}" for k, v in MODELS[model].items())
        lines.append(f"| {model}{options} | {' | '.join(cells)} |")
    means = [
        math.exp(statistics.fmean(math.log(times[a] / times[b]) for times in rows.values()))
        for a, b in columns
    ]
    blank = [""] * (len(bases) + len(new))
    lines.append(
        f"| **geometric mean** | {' | '.join([*blank, *(f'**{mean:.2f}**' for mean in means)])} |"
    )
    return "\n".join(lines) + "\n"


def processor() -> str:
    found = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.M)
    return found[1] if found else platform.processor()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--base", nargs="+", required=True, help="tags or commits")
    parser.add_argument("--data", required=True, help="a data folder of 512 points or more")
    parser.add_argument("--models", nargs="+", default=list(MODELS), choices=list(MODELS))
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--also", nargs="*", default=[], help="precisions of more new columns")
    parser.add_argument("--out", help="write the page here, too")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        clouds = folder / "clouds.npz"
        write_clouds(arguments.data, clouds)
        trainers = {
            base: Trainer(unpack(base, folder / str(i)), FULL_PRECISION)
            for i, base in enumerate(arguments.base)
        }
        new = {NEW: Trainer(HERE, FULL_PRECISION)}
        new |= {f"{NEW}, {precision}": Trainer(HERE, precision) for precision in arguments.also}
        rows = {}
        for model in arguments.models:
            rows[model] = measure(model, trainers | new, clouds, arguments.turns)
            sys.stdout.write(f"{model:<24}{rows[model]}\n")
            sys.stdout.flush()
        for trainer in (trainers | new).values():
            trainer.close()
    also = ["--also", *arguments.also] if arguments.also else []
    page = (
        f"# What a training cloud costs\n\nCPU milliseconds a cloud on one core ({processor()}, "
        f"torch {torch.__version__}): batches of {BATCH} clouds of 256 points, as the `board` "
        f"preset trains.\nOld code and new code took their steps in turns in one sitting; each "
        f"figure is a median of {arguments.turns}. Made by\n`python -m benchmarks.training "
        f"{' '.join(['--base', *arguments.base, *also, '--turns', str(arguments.turns)])} "
        f"--data DIR`.\n\n" + table(rows, arguments.base, list(new))
    )
    sys.stdout.write("\n" + page)
    if arguments.out:
        Path(arguments.out).write_text(page)


if __name__ == "__main__":
    main()
