"""What keeping freed memory is worth in a training step on the CPU.

    python -m benchmarks.memory [--models papnet-steered dgcnn] [--batch 32] [--points 256]

Each model's step is timed in a process of its own without and with
``partialbench.benchmark.training.memory``, in turns; figures are the fastest of the turns.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
from multiprocessing.pool import Pool

import torch

from benchmarks.models import seconds, training_step
from benchmarks.released_papnet import posed_step
from benchmarks.steered import clouds
from partialbench import registry
from partialbench.benchmark.training.memory import keep_freed_memory


def step_seconds(name: str, batch: int, points: int, keep: bool) -> float:
    torch.set_num_threads(1)
    if keep and not keep_freed_memory():
        sys.exit("this C library's allocator cannot be told to keep memory")
    torch.manual_seed(0)
    model, data = registry.create(name, 40), clouds(batch, points)
    has_loss = hasattr(model, "training_loss")
    step = posed_step(model, data) if has_loss else training_step(model, data.points)
    step()
    return min(seconds(step, torch.device("cpu")) for _ in range(3))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--models", nargs="+", default=["papnet-steered", "dgcnn", "pointnet2-ssg"])
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--points", type=int, default=256)
    parser.add_argument("--turns", type=int, default=2)
    arguments = parser.parse_args()
    spawn = multiprocessing.get_context("spawn")
    write = sys.stdout.write
    write(f"ms a training cloud, one thread, torch {torch.__version__}\n")
    write(f"{'':<24}{'kept':>9}{'returned':>10}{'ratio':>8}\n")
    for name in arguments.models:
        best = {True: float("inf"), False: float("inf")}
        for _ in range(arguments.turns):
            for keep in best:
                with Pool(1, context=spawn) as pool:
                    task = (name, arguments.batch, arguments.points, keep)
                    best[keep] = min(best[keep], pool.apply(step_seconds, task))
        kept, returned = (best[keep] / arguments.batch * 1e3 for keep in (True, False))
        write(f"{name:<24}{kept:>9.2f}{returned:>10.2f}{returned / kept:>8.2f}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
