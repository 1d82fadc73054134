"""Every speed figure of the docs, in one run: ``make bench``.

    python benchmarks/run.py [--only render loader hpr models papnet …] [--out bench]

Each benchmark compares with a peer inside its own run; quote its ratios, not its absolute figures.
Nothing else should be using the machine. Writes bench/NAME.txt as well as printing.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
BENCHMARKS: dict[str, list[str]] = {
    "render": ["benchmarks/render.py"],
    "loader": ["benchmarks/loader.py"],
    "export": ["benchmarks/export.py"],
    "hpr": ["benchmarks/hpr.py", "speed"],
    "models": ["benchmarks/models.py"],
    "papnet": ["-m", "benchmarks.released_papnet"],
    "steered": ["-m", "benchmarks.steered"],
    "harness": ["benchmarks/harness.py"],
    "memory": ["-m", "benchmarks.memory"],
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=BENCHMARKS, default=list(BENCHMARKS))
    parser.add_argument("--out", type=Path, default=Path("bench"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    failed = []
    for name in arguments.only:
        print(f"== {name}", flush=True)
        command = [sys.executable, *BENCHMARKS[name]]
        with open(arguments.out / f"{name}.txt", "w") as log:
            run = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=HERE.parent)
            assert run.stdout is not None
            for line in run.stdout:
                print(line, end="", flush=True)
                log.write(line)
        if run.wait():
            failed.append(name)
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
