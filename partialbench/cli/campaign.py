"""The verbs that run a whole board from one file."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from partialbench.cli.verbs import Verbs
from partialbench.console import Json, continued_by, ended_as_by_ctrl_c, print_result, stderr
from partialbench.errors import PartialbenchError

commands = Verbs("Tables")
campaign = Verbs(help="Every run of a board from one file: what is done, what is missing.")
commands.add_typer(campaign, name="campaign", rich_help_panel="Tables")

File = Annotated[Path, typer.Argument(help="a campaign file (.toml)")]


@campaign.command(
    name="status", epilog="Example: `partialbench campaign status leaderboard/campaign.toml`"
)
def show_status(
    file: File,
    save: Annotated[
        bool, typer.Option("--save", help="write it beside the records, for the board to say")
    ] = False,
    as_json: Json = False,
) -> None:
    """What is done, running, failed and missing, and hours to go by the recorded speeds."""
    from partialbench.benchmark.campaign.declare import declare
    from partialbench.benchmark.campaign.file import load
    from partialbench.benchmark.campaign.status import status

    found = (declare if save else status)(load(file))
    print_result(found.as_dict(), as_json, found.as_text())


@campaign.command(
    name="run",
    epilog="Examples: `partialbench campaign run leaderboard/campaign.toml --time-limit 170m` · "
    "`partialbench campaign run board.toml --only 'papnet*@pm40-clouds' --device cuda`",
)
def run_missing(
    file: File,
    workers: Annotated[
        int | None,
        typer.Option(
            "--workers",
            "--jobs",
            min=1,
            help="trainings side by side (--jobs is its older name)",
            show_default="one a core; on CUDA one",
        ),
    ] = None,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda, cuda:1")] = "auto",
    only: Annotated[
        list[str] | None,
        typer.Option(
            help="models by pattern, 'papnet*', or with data set, 'papnet*@pm40-clouds' "
            "(repeatable; what fits an earlier one comes first)",
            show_default="all",
        ),
    ] = None,
    up_to: Annotated[
        str | None,
        typer.Option(
            help="the last milestone to train to: 25k, 100k", show_default="the file's last"
        ),
    ] = None,
    trials: Annotated[bool, typer.Option(help="also the trials that the file asks for")] = True,
    time_limit: Annotated[
        str | None,
        typer.Option(help="save and leave after 45s, 170m or 3h; exit status 75 if jobs are left"),
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="send trainings to the Dask cluster at this address")
    ] = None,
    retry_failed: Annotated[
        bool, typer.Option(help="try again what is recorded as failed, of what is asked for")
    ] = False,
    as_json: Json = False,
) -> None:
    """Render and train what is missing, the milestone that is behind first, and make the board.

    Stopped in any way, the same command goes on. Exit status 1 if a job failed.
    """
    from partialbench.benchmark.campaign.choice import choose
    from partialbench.benchmark.campaign.failures import FAILURES
    from partialbench.benchmark.campaign.file import load
    from partialbench.benchmark.campaign.run import run

    board = load(file)
    with continued_by("the same command"), ended_as_by_ctrl_c():
        found = run(
            board, jobs=workers, device=device, only=only or (), up_to=up_to,
            trials=trials,
            time_limit_s=None if time_limit is None else seconds(time_limit),
            scheduler=scheduler, retry_failed=retry_failed,
            say=lambda text: stderr.print(text, markup=False),
        )  # fmt: skip
    print_result(found.as_dict(), as_json, found.as_text())
    asked = choose(only or (), up_to, trials)
    if failed := [job.title for job in found.failed if asked.has(job)]:
        raise PartialbenchError(
            f"of what was asked for {len(failed)} failed, {failed[0]} first; "
            f"{board.results / FAILURES} says why, --retry-failed tries again"
        )


def seconds(text: str) -> float:
    """ "45s", "170m", "3h" or a plain number of seconds."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([smh]?)", text)
    if match is None or float(match[1]) <= 0:
        raise typer.BadParameter(f"--time-limit takes 45s, 170m or 3h, got {text!r}")
    return float(match[1]) * {"": 1, "s": 1, "m": 60, "h": 3600}[match[2]]
