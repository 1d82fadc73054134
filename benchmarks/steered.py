"""papnet-steered against PAPNet run the release's way, and against PointNet.

    python -m benchmarks.steered [--batch 2] [--points 1024] [--threads 2] [--turns 3]

Evaluation decides over 360 poses in ours and over the 20 best of 60 in the release's; a training
step is the model's own loss. The two run in turns on the same clouds in one process; each figure is
the fastest of its turns. The lines below compare ours, its twin and PointNet at 256 points.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

import torch
from torch import nn

from baselines.points import normalise
from benchmarks.models import compare, forward, training_step
from benchmarks.reference_volumes import released_papnet
from benchmarks.released_papnet import NUM_CLASSES, posed_step
from partialbench import registry
from partialbench.benchmark.prediction import Batch
from partialbench.geometry.bins import rotation_bins


def clouds(count: int, points: int) -> Batch:
    generator = torch.Generator().manual_seed(0)
    cloud = torch.randn(count, points, 3, generator=generator)
    R = torch.as_tensor(rotation_bins()[:count].copy()).float()
    return Batch(
        normalise(cloud * torch.tensor([1.0, 0.7, 0.4])), torch.arange(count) % NUM_CLASSES, R, R
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--batch", type=int, default=2)
    parser.add_argument("--points", type=int, default=1024)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    device = torch.device(arguments.device)
    torch.manual_seed(0)
    write = sys.stdout.write

    def made(name: str) -> nn.Module:
        return registry.create(name, NUM_CLASSES).to(device)

    def row(name: str, ours: Callable[[], None], theirs: Callable[[], None], count: int) -> None:
        a, b = (t / count * 1e3 for t in compare(ours, theirs, arguments.turns, device))
        write(f"{name:<44}{a:>9.2f}{b:>10.2f}{b / a:>8.2f}\n")
        sys.stdout.flush()

    write(f"{arguments.threads} threads, {device}, torch {torch.__version__}; ms a cloud\n")
    write(f"{'ours against':<44}{'ours':>9}{'other':>10}{'ratio':>8}\n")
    steered, twin, pointnet = (
        made(name) for name in ("papnet-steered", "papnet-steered-nopose", "pointnet")
    )
    released = released_papnet(NUM_CLASSES).to(device)
    batch = Batch(*(t.to(device) for t in clouds(arguments.batch, arguments.points)))
    size = f"{arguments.batch} clouds of {arguments.points}"
    row(
        f"released papnet, evaluation, {size}",
        forward(steered, batch.points), forward(released, batch.points), arguments.batch,
    )  # fmt: skip
    row(
        f"released papnet, step, {size}",
        posed_step(steered, batch), posed_step(released, batch), arguments.batch,
    )  # fmt: skip
    batch = Batch(*(t.to(device) for t in clouds(32, 256)))
    row(
        "PointNet, step, 32 clouds of 256",
        posed_step(steered, batch), training_step(pointnet, batch.points), 32,
    )  # fmt: skip
    row(
        "pose-free twin, step, 32 clouds of 256",
        posed_step(steered, batch), training_step(twin, batch.points), 32,
    )  # fmt: skip
    row(
        "PointNet, evaluation, 32 clouds of 256",
        forward(steered, batch.points), forward(pointnet, batch.points), 32,
    )  # fmt: skip


if __name__ == "__main__":
    main()
