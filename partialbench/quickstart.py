"""The whole job on the embedded default, small enough for a coffee break on two cores."""

from __future__ import annotations

import time
from pathlib import Path

from rich.console import Console

from partialbench import registry
from partialbench.dataset.build import build
from partialbench.dataset.executors import process_pool
from partialbench.dataset.render import plan_render
from partialbench.dataset.show import show
from partialbench.progress import build_bar

COUNTS = (24, 8)  # training and test objects of each class
VIEWS = 4
POINTS = 1024


def quickstart(out: Path, model: str, workers: int, console: Console) -> str:
    """Render, draw, train, test and tabulate into ``out``; a second call continues the first.

    Returns:
        A few lines that say where everything is and what to do next.
    """
    start = time.perf_counter()
    data, results, board = out / "pm40-parametric", out / "results", out / "leaderboard"

    def step(text: str) -> None:
        console.print(f"[bold]{text}[/]")

    step("1/4 rendering built-in shapes")
    plan = plan_render(
        "pm40", data, source_options={"counts": COUNTS}, occluder_options={"resolution": 128},
        views=VIEWS, points=POINTS,
    )  # fmt: skip
    with build_bar(console) as on_progress:
        manifest = build(plan, lambda: process_pool(workers), workers, on_progress)
    step("2/4 drawing a gallery")
    show(data, out / "gallery.png")
    show(data, out / "gallery.html", samples=12)
    step(f"3/4 training and testing {model}")
    # Imported here: torch takes seconds to load, and the steps before it have something to show.
    from partialbench.benchmark.run import run_eval

    (result, *_) = run_eval(
        model, data, preset="mini", results_folder=results, resume=True,
        num_points=256, clouds_seen=15_000,
    )  # fmt: skip
    step("4/4 writing the leaderboard")
    registry.load(registry.LEADERBOARD)(results, board)
    accuracy, classes = result.scores["accuracy"], len(manifest.class_names)
    minutes = (time.perf_counter() - start) / 60
    return "\n".join(
        [
            "",
            f"Done in {minutes:.1f} minutes: {model} names {accuracy:.1%} of "
            f"{manifest.rows('test')} single views of unseen objects (chance {1 / classes:.1%}).",
            "",
            f"  the data       {data} (CARD.md says what is in it)",
            f"  what it shows  {out / 'gallery.png'}, {out / 'gallery.html'} to turn by hand",
            f"  the table      {board / 'leaderboard.md'}",
            "",
            "Next:",
            f"  partialbench eval --model dgcnn --data {data} --results {results}",
            f"  partialbench eval --model my_model:make --data {data}   # yours: docs/own_model.md",
            "  partialbench render pm40 --source ModelNet40.zip --out data/pm40",
        ]
    )
