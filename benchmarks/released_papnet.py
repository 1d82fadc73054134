"""PAPNet against the way its release runs it: evaluation with k = 20, and a training step.

    python -m benchmarks.released_papnet [--batch 4] [--threads 2] [--turns 2]

Both are timed in turns on the same clouds in one process (the fastest of its turns each), float32
and 64³; a last line runs ours in bfloat16 autocast and says how far its answers move.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import Any

import torch

from baselines.points import normalise
from benchmarks.models import compare, forward
from benchmarks.reference_volumes import released_papnet
from papnet.model import PAPNet
from partialbench.benchmark.prediction import Batch
from partialbench.geometry.bins import rotation_bins

NUM_CLASSES = 40


def posed_step(model: Any, batch: Batch) -> Callable[[], None]:
    """A training step of a model with its own loss, a pose in it."""
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-5)

    def run() -> None:
        optimizer.zero_grad()
        model.train().training_loss(batch).backward()
        optimizer.step()

    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--turns", type=int, default=2)
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    device = torch.device(arguments.device)
    torch.manual_seed(0)
    ours, theirs = PAPNet(NUM_CLASSES).to(device), released_papnet(NUM_CLASSES).to(device)
    theirs.load_state_dict(ours.state_dict())
    B = arguments.batch
    points = normalise(torch.randn(B, 1024, 3) * torch.tensor([1.0, 0.7, 0.4])).to(device)
    R = torch.as_tensor(rotation_bins()[:B].copy()).float().to(device)
    batch = Batch(points, torch.arange(B, device=device) % NUM_CLASSES, R, R)

    write = sys.stdout.write
    write(f"{B} clouds, {arguments.threads} threads, {device}, torch {torch.__version__}; ms\n")
    write(f"{'pass':<22}{'ours':>9}{'released':>10}{'ratio':>8}\n")
    for name, make in (
        ("evaluation, k = 20", lambda model: forward(model, points)),
        ("training step", lambda model: posed_step(model, batch)),
    ):
        a, b = compare(make(ours), make(theirs), arguments.turns, device)
        write(f"{name:<22}{a * 1e3:>9.0f}{b * 1e3:>10.0f}{b / a:>8.2f}\n")
        sys.stdout.flush()

    def low() -> None:
        with torch.autocast(device.type, torch.bfloat16):
            forward(ours, points)()

    a, b = compare(low, forward(theirs, points), arguments.turns, device)
    with torch.no_grad():
        full = ours.eval()(points)
        with torch.autocast(device.type, torch.bfloat16):
            half = ours(points)
    moved = float((half.class_logits.float() - full.class_logits).abs().max())
    spread = float(full.class_logits.std())
    write(f"{'evaluation, bfloat16':<22}{a * 1e3:>9.0f}{b * 1e3:>10.0f}{b / a:>8.2f}")
    write(f"   logits move by at most {moved:.1e} (their spread: {spread:.1e})\n")


if __name__ == "__main__":
    main()
