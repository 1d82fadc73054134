"""What the checks of an evaluation cost: the trial before the first step, hashing, the guards.

    python -m benchmarks.checks --data DIR [--model pointnet] [--clouds 2k]

A short run, its CPU seconds split into training, checks and the rest. The checks cost the same
however long the training is, so their share is given for this run and for one of 240,000 clouds.
"""

from __future__ import annotations

import argparse
import functools
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

from benchmarks.harness import say
from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.run import run_eval
from partialbench.benchmark.testing import company, isolation
from partialbench.benchmark.training import checkpoint, dry_run, loop
from partialbench.dataset import loader

LONG = 240_000
CHECKS = (
    (dry_run, "try_out"), (loader, "_file_digest"), (company, "company_audit"),
    (isolation.State, "__init__"), (isolation.State, "restore"), (checkpoint, "weights_digest"),
)  # fmt: skip
TRAINING = (loop.Loop, "advance")


class Clock:
    """CPU seconds by name, a call inside another counted for the outer one alone."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._inside = False

    def watch(self, owner: Any, name: str) -> None:
        watched: Callable[..., Any] = getattr(owner, name)

        @functools.wraps(watched)
        def timed(*args: Any, **kwargs: Any) -> Any:
            if self._inside:
                return watched(*args, **kwargs)
            self._inside = True
            start = time.process_time()
            try:
                return watched(*args, **kwargs)
            finally:
                self._inside = False
                self.seconds[f"{owner.__name__.split('.')[-1]}.{name}"] += (
                    time.process_time() - start
                )

        setattr(owner, name, timed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", required=True)
    parser.add_argument("--model", default="pointnet")
    parser.add_argument("--clouds", default="2k")
    arguments = parser.parse_args()
    clock = Clock()
    for owner, name in (*CHECKS, TRAINING):
        clock.watch(owner, name)
    start = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        run_eval(arguments.model, arguments.data, clouds=[arguments.clouds], results_folder=folder)
    total = time.process_time() - start
    training = clock.seconds.pop("Loop.advance")
    checks = sum(clock.seconds.values())
    longer = total + training * (LONG / milestones.parse(arguments.clouds) - 1)
    for name, seconds in sorted(clock.seconds.items(), key=lambda item: -item[1]):
        say(f"{name:26} {seconds:8.2f} s of CPU time")
    say(f"training                   {training:8.2f} s")
    say(f"the whole run              {total:8.2f} s")
    say(f"checks: {checks / total:.2%} of it, {checks / longer:.3%} of a run of {LONG:,} clouds")


if __name__ == "__main__":
    main()
