"""Speed of every model against its straightforward published formulation.

    python benchmarks/models.py [--models dgcnn pointnet2-ssg] [--batch 16] [--points 1024]

For each registered model that a ``reference_*.py`` of this folder has a formulation of (a table
``REFERENCES``: name → factory(num_classes)), a forward pass in evaluation and a training step
(forward, loss, backward, Adam) are timed in turns, ours and theirs, on the same random clouds in
one process. Each figure is the fastest of its turns. A ratio above 1 means ours is faster.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from baselines.points import normalise
from partialbench import registry

NUM_CLASSES = 40


def references() -> dict[str, Callable[[int], nn.Module]]:
    """Every formulation in this folder's ``reference_*.py`` files, by model name."""
    table: dict[str, Callable[[int], nn.Module]] = {}
    here = Path(__file__).resolve().parent
    # Run as a script, this folder leads the path and its file names would hide packages.
    sys.path[:] = [str(here.parent), *(p for p in sys.path if Path(p).resolve() != here)]
    for path in sorted(here.glob("reference_*.py")):
        spec = importlib.util.spec_from_file_location(path.stem, path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[path.stem] = module
        spec.loader.exec_module(module)
        table |= module.REFERENCES
    return table


def logits_and_penalty(output: Any) -> tuple[Tensor, Tensor | float]:
    if isinstance(output, Tensor):
        return output, 0.0
    return output.class_logits, 0.0 if output.penalty is None else output.penalty


def forward(model: nn.Module, points: Tensor) -> Callable[[], None]:
    @torch.no_grad()
    def run() -> None:
        model.eval()(points)

    return run


def training_step(model: nn.Module, points: Tensor) -> Callable[[], None]:
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-5)
    label = torch.arange(len(points), device=points.device) % NUM_CLASSES

    def run() -> None:
        logits, penalty = logits_and_penalty(model.train()(points))
        optimizer.zero_grad()
        (nn.functional.cross_entropy(logits, label) + penalty).backward()
        optimizer.step()

    return run


def seconds(run: Callable[[], None], device: torch.device) -> float:
    start = time.perf_counter()
    run()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - start


def compare(
    ours: Callable[[], None], theirs: Callable[[], None], turns: int, device: torch.device
) -> tuple[float, float]:
    """The fastest of ``turns`` alternating turns of each, after one to warm up."""
    times: tuple[list[float], list[float]] = ([], [])
    for turn in range(turns + 1):
        for record, run in zip(times, (ours, theirs), strict=True):
            elapsed = seconds(run, device)
            if turn:
                record.append(elapsed)
    return min(times[0]), min(times[1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--models", nargs="*", help="names; all that have a reference by default")
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--points", type=int, default=1024)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", action="store_true", help="one JSON object a line")
    arguments = parser.parse_args()

    torch.set_num_threads(arguments.threads)
    device = torch.device(arguments.device)
    table = references()
    unknown = sorted(set(arguments.models or ()) - set(table))
    if unknown:
        parser.error(f"no reference for {', '.join(unknown)}; there are {', '.join(table)}")
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(arguments.batch, arguments.points, 3, generator=generator)
    points = normalise(points * torch.tensor([1.0, 0.7, 0.4])).to(device)

    write = sys.stdout.write
    if not arguments.json:
        write(f"{arguments.batch} clouds of {arguments.points} points, ")
        write(f"{arguments.threads} threads, {device}, torch {torch.__version__}; ms\n")
        write(f"{'model':<18}{'pass':<10}{'ours':>9}{'published':>11}{'ratio':>8}\n")
    for name in arguments.models or [n for n in registry.cards() if n in table]:
        torch.manual_seed(0)
        ours = registry.create(name, NUM_CLASSES).to(device)
        theirs = table[name](NUM_CLASSES).to(device)
        for kind, make in (("forward", forward), ("step", training_step)):
            a, b = compare(make(ours, points), make(theirs, points), arguments.turns, device)
            row = {"model": name, "pass": kind, "ours_ms": a * 1e3, "published_ms": b * 1e3}
            if arguments.json:
                write(json.dumps(row | {"ratio": b / a}) + "\n")
            else:
                write(f"{name:<18}{kind:<10}{a * 1e3:>9.1f}{b * 1e3:>11.1f}{b / a:>8.2f}\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
