"""The verb that makes tables and the page from records, and the one that does the whole job."""

from __future__ import annotations

import os
import sys
import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from partialbench.benchmark import preflight
from partialbench.cli.verbs import Verbs
from partialbench.console import continued_by, stderr
from partialbench.progress import counting_bar

commands = Verbs("Tables")


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
    look_in: Annotated[
        list[Path] | None,
        typer.Option(help="folders to look through for data: cameras for all, built-in clouds too"),
    ] = None,
    figures: Annotated[
        bool, typer.Option("--figures", help="write figures too, as SVG and PNG")
    ] = False,
) -> None:
    """Make page and tables anew from the records."""
    preflight.check_output(out, "--out")
    from partialbench.benchmark.board import leaderboard as make

    bar = counting_bar(stderr, "leaderboard")
    board = make(
        results, check=check, data=tuple(data or ()), figures=figures, on_progress=bar,
        look_in=tuple(look_in or ()),
    )  # fmt: skip
    page, *_ = board.save(out)
    print(page)


@commands.command()
def quickstart(
    out: Annotated[Path, typer.Option(help="where everything goes")] = Path("quickstart"),
    model: Annotated[
        list[str] | None,
        typer.Option(help="which model to train (repeat for more) [pointnet, papnet-steered]"),
    ] = None,
    workers: Annotated[int, typer.Option(help="processes; 0: one per core")] = 0,
    open_page: Annotated[
        bool, typer.Option("--open/--no-open", help="open the page at the end, on a display")
    ] = True,
) -> None:
    """The whole job, small: render built-in shapes, train, test, gallery, page. Minutes."""
    chosen = model or ["pointnet", "papnet-steered"]
    for name in chosen:  # before anything is rendered
        preflight.check_model(name)
    preflight.check_output(out, "--out")
    from partialbench.quickstart import quickstart as run

    with continued_by("the same command"):
        text, page = run(out, chosen, workers or os.cpu_count() or 1, stderr)
    print(text)
    if open_page and has_display():
        webbrowser.open(page.resolve().as_uri())


def has_display() -> bool:
    """Whether a window can be seen by whoever runs this: not on a server, in CI or in a pipe."""
    if not sys.stdout.isatty() or os.environ.get("CI"):
        return False
    if sys.platform in ("win32", "darwin"):
        return "SSH_CONNECTION" not in os.environ
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
