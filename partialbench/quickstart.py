"""The whole job on the embedded default, small enough for a coffee break on two cores."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from partialbench.dataset.build import build
from partialbench.dataset.executors import process_pool
from partialbench.dataset.render import plan_render
from partialbench.dataset.show import show
from partialbench.progress import build_bar

COUNTS = (24, 8)  # training and test objects of each class
VIEWS = 4
POINTS = 1024
# Enough to rank two models, far from what either can reach: the point is that all of it runs.
CLOUDS_SEEN = 6_000


def quickstart(
    out: Path, models: Sequence[str], workers: int, console: Console
) -> tuple[str, Path]:
    """Render, draw, train, test and tabulate into ``out``; a second call continues the first.

    Args:
        models: trained one after the other on the same clouds, a row each.

    Returns:
        A few lines that say where everything is and what to do next, and the leaderboard's page.
    """
    start = time.perf_counter()
    data, results, board = out / "pm40-parametric", out / "results", out / "board"

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
    step(f"3/4 training and testing {', '.join(models)}")
    # Imported here: torch takes seconds to load, and the steps before it have something to show.
    from partialbench.benchmark.board import leaderboard
    from partialbench.benchmark.evaluation import evaluate

    results_of = {}
    for model in models:
        (results_of[model],) = evaluate(
            model, data, results=results, preset="board", clouds=[CLOUDS_SEEN]
        )
    step("4/4 writing the leaderboard")
    page, *_ = leaderboard(results, data=[data]).save(board)
    scores = ", ".join(f"{m} {r.scores['accuracy']:.1%}" for m, r in results_of.items())
    minutes = (time.perf_counter() - start) / 60
    text = "\n".join(
        [
            "",
            f"Done in {minutes:.1f} minutes. Of {manifest.rows('test')} single views of unseen "
            f"objects of {len(manifest.class_names)} classes, named rightly after seeing "
            f"{CLOUDS_SEEN:,} training clouds:",
            f"  {scores}",
            "",
            f"  the data       {data} (CARD.md says what is in it)",
            f"  what it shows  {out / 'gallery.png'}, {out / 'gallery.html'} to turn by hand",
            f"  the page       {page}, with the clouds on which the models disagree",
            "",
            "Next:",
            f"  partialbench eval --model {models[-1]} --clouds 25k --data {data} "
            f"--results {results}   # goes on from here",
            f"  partialbench eval --model my_model:make --data {data}   # yours: docs/own_model.md",
            "  partialbench render pm40 --source ModelNet40.zip --out data/pm40",
        ]
    )
    return text, page
