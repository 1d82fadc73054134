"""The verb that makes tables and the page from records, and the one that does the whole job."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from partialbench import registry
from partialbench.benchmark import preflight
from partialbench.console import continued_by, stderr
from partialbench.progress import counting_bar

commands = typer.Typer()


@commands.command(epilog="Example: `partialbench leaderboard --results results --out board`")
def leaderboard(
    results: Annotated[Path, typer.Option(help="folder of records")] = Path("results"),
    out: Annotated[Path, typer.Option(help="where tables go")] = Path("leaderboard_out"),
    check: Annotated[
        bool,
        typer.Option("--check", help="recompute every score from the stored predictions first"),
    ] = False,
    data: Annotated[
        list[Path] | None, typer.Option(help="data folders, for the clouds of the page's gallery")
    ] = None,
    figures: Annotated[
        bool, typer.Option("--figures", help="write figures too, as SVG and PNG")
    ] = False,
) -> None:
    """Make page and tables anew from the records."""
    preflight.check_output(out, "--out")
    page, *_ = registry.load(registry.LEADERBOARD)(
        results, out, check, tuple(data or ()), figures, counting_bar(stderr, "leaderboard")
    )
    print(page)


@commands.command()
def quickstart(
    out: Annotated[Path, typer.Option(help="where everything goes")] = Path("quickstart"),
    model: Annotated[
        list[str] | None,
        typer.Option(help="which model to train (repeat for more) [pointnet, papnet-steered]"),
    ] = None,
    workers: Annotated[int, typer.Option(help="processes; 0: one per core")] = 0,
) -> None:
    """The whole job, small: render built-in shapes, train, test, table, gallery. Minutes."""
    chosen = model or ["pointnet", "papnet-steered"]
    for name in chosen:  # before anything is rendered
        preflight.check_model(name)
    preflight.check_output(out, "--out")
    from partialbench.quickstart import quickstart as run

    with continued_by("the same command"):
        print(run(out, chosen, workers or os.cpu_count() or 1, stderr))
