"""The command line: verbs only. Each parses, calls one public function and prints its result.

stdout carries the result, stderr the log and the progress bar. Exit status: 0 done, 1 failed,
2 wrong usage, 75 out of time, 130 interrupted (what was finished is kept). A file a stage.
"""

from __future__ import annotations

import logging
import sys
from typing import Annotated

import typer
from rich.logging import RichHandler

from partialbench import __version__, user_code
from partialbench.cli import benchmark, board, campaign, data
from partialbench.console import prepare_streams, quiet_libraries, stderr
from partialbench.errors import PartialbenchError
from partialbench.search_path import current_folder_last

app = typer.Typer(
    name="partialbench",
    help="Pose-labelled single-view partial point clouds, and a benchmark of classifiers on them.",
    epilog="Start with: partialbench quickstart",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)
for stage in (data, benchmark, campaign, board):
    app.add_typer(stage.commands)


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="print the version")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="log more")] = False,
) -> None:
    if version:
        print(__version__)
        raise typer.Exit
    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING,
        format="%(message)s",
        handlers=[RichHandler(console=stderr, show_path=False)],
        force=True,
    )
    quiet_libraries(verbose)


def main() -> None:
    """Entry point: turns expected errors into one line on stderr and an exit status."""
    prepare_streams()
    # A user's own model lives in the folder they stand in, and stands in for nothing of ours.
    current_folder_last()
    user_code.ours_first()
    try:
        app()
    except PartialbenchError as error:
        logging.getLogger(__name__).info("", exc_info=error)
        stderr.print(f"[bold red]error:[/] {_escaped(str(error))}")
        sys.exit(error.exit_status)


def _escaped(text: str) -> str:
    from rich.markup import escape

    return escape(text)
