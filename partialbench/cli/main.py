"""The command line: verbs only. Each parses, calls one public function and prints its result.

stdout carries the result, stderr the log and the progress bar. Exit status: 0 done, 1 failed,
2 wrong usage, 75 out of time, 130 interrupted (what was finished is kept). A file a stage.
"""

from __future__ import annotations

import logging
import sys
from typing import Annotated, NoReturn

import typer
from rich.logging import RichHandler

from partialbench import __version__, extras, user_code
from partialbench.cli import benchmark, board, campaign, data, share, sources
from partialbench.console import prepare_streams, quiet_libraries, stderr
from partialbench.errors import PartialbenchError
from partialbench.search_path import current_folder_last

app = typer.Typer(
    name="partialbench",
    help="Pose-labelled single-view partial point clouds, and a benchmark of classifiers on them.",
    epilog="Start with: partialbench quickstart",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)
for stage in (data, sources, benchmark, campaign, board, share):
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
        # Without a terminal a wrong usage is one line, not a frame around three.
        sys.exit(app(standalone_mode=sys.stderr.isatty()))
    except PartialbenchError as error:
        logging.getLogger(__name__).info("", exc_info=error)
        _fail(str(error), error.exit_status)
    except ModuleNotFoundError as error:
        if (missing := extras.explained(error)) is None:
            raise
        _fail(str(missing), missing.exit_status)
    except Exception as error:
        # Typer's own, of wrong usage: of whichever of the modules that its versions have them in.
        if not hasattr(error, "format_message"):
            raise
        if type(error).__name__ == "NoArgsIsHelpError":
            error.show()  # type: ignore[attr-defined]
            sys.exit(2)
        context = getattr(error, "ctx", None)
        where = f"; see '{context.command_path} --help'" if context else ""
        _fail(f"{error.format_message().rstrip('.')}{where}", getattr(error, "exit_code", 2))


def _fail(message: str, status: int) -> NoReturn:
    # A message in a file is not folded to a terminal's width.
    stderr.print(f"[bold red]error:[/] {_escaped(message)}", soft_wrap=not stderr.is_terminal)
    sys.exit(status)


def _escaped(text: str) -> str:
    from rich.markup import escape

    return escape(text)
