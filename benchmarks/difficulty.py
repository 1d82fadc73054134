"""Are the parametric shapes as hard as the real ones? Partial-view accuracy on both, same budget.

    python benchmarks/difficulty.py --real modelnet40_aligned_1024.h5 --out DIR
        [--models pointnet dgcnn] [--clouds-seen 60000] [--num-points 256]

Renders ``pm40-parametric`` (Mitsuba depth) and ``pm40-clouds`` (hidden point removal) with equal
training counts where the real classes allow it, trains every model on each under one protocol, and
prints test accuracies side by side. Interrupted, it continues.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from partialbench.benchmark.run import run_eval
from partialbench.dataset.build import build
from partialbench.dataset.render import plan_render

OBJECTS, TEST_OBJECTS, VIEWS = 80, 20, 4


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--real", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--models", nargs="+", default=["pointnet", "dgcnn"])
    parser.add_argument("--clouds-seen", type=int, default=60_000)
    parser.add_argument("--num-points", type=int, default=256)
    parser.add_argument("--only", choices=("parametric", "clouds"), help="one of the two data sets")
    arguments = parser.parse_args()
    plans: dict[str, dict[str, Any]] = {
        "parametric": {"source_options": {"counts": (OBJECTS, TEST_OBJECTS)}},
        "clouds": {"source": str(arguments.real), "objects_per_class": OBJECTS},
    }
    scores: dict[str, dict[str, float]] = {}
    for name, options in plans.items():
        if arguments.only not in (None, name):
            continue
        folder = arguments.out / name
        build(plan_render("pm40", folder, views=VIEWS, points=1024, **options), workers=2)
        for model in arguments.models:
            (result,) = run_eval(
                model, folder, preset="board", results_folder=arguments.out / "results",
                num_points=arguments.num_points, clouds=[arguments.clouds_seen],
            )  # fmt: skip
            scores.setdefault(model, {})[name] = result.scores["accuracy"]
            print(f"{model} on {name}: {result.scores['accuracy']:.1%}", flush=True)
    for model, both in scores.items():
        if len(both) == 2:
            print(f"{model}: {both['parametric'] - both['clouds']:+.1%} easier on parametric")


if __name__ == "__main__":
    main()
