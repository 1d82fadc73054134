"""What the command line's verbs share: where they print, and how."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from typing import Annotated, Any

import typer
from rich.console import Console

# A table that goes into a file is not folded to a terminal's width.
stdout = Console(highlight=False, soft_wrap=True)
stderr = Console(stderr=True, highlight=False)

Json = Annotated[bool, typer.Option("--json", help="print the result as JSON")]


@contextlib.contextmanager
def continued_by(what: str) -> Iterator[None]:
    """Turns Ctrl-C into one line that says what continues the run, and exit status 130."""
    try:
        yield
    except KeyboardInterrupt:
        stderr.print(f"interrupted; what was finished is kept, {what} continues it")
        raise typer.Exit(130) from None


def given(**options: Any) -> dict[str, Any]:
    """The options a user gave: those that are not None."""
    return {name: value for name, value in options.items() if value is not None}


def print_result(data: dict[str, Any], as_json: bool, text: str) -> None:
    """The result on stdout: as JSON for a program, as text for a person."""
    print(json.dumps(data, indent=1) if as_json else text)
