"""What the command line's verbs share: where they print, and how."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import sys
import warnings
from collections.abc import Iterator
from typing import Annotated, Any

import typer
from rich.console import Console

# A table that goes into a file is not folded to a terminal's width, and ":name:" is a name.
stdout = Console(highlight=False, soft_wrap=True, emoji=False)
stderr = Console(stderr=True, highlight=False, emoji=False)

Json = Annotated[bool, typer.Option("--json", help="print the result as JSON")]


OWN = ("partialbench", "renderers", "baselines", "papnet", "leaderboard")


def prepare_streams() -> None:
    """Make the standard streams safe to print to; to be called before a file is opened.

    A stream that is closed (``2>&-``, some daemons) leads to nowhere: else the next file to be
    opened gets its number, and what a library prints goes into it. A sign that an encoding lacks
    (ASCII) is printed as its code.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            # The lowest free number is this one; workers are to have it too.
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
        if getattr(sys, name) is None:
            mode = "r" if number == 0 else "w"
            setattr(sys, name, open(number, mode, closefd=False, errors="backslashreplace"))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def quiet_libraries(verbose: bool = False) -> None:
    """Keep what libraries warn of from the terminal of a user who can do nothing about it.

    What it means for an object is said in words of ours, where the object is read.
    """
    if verbose or sys.warnoptions:
        return
    warnings.simplefilter("ignore")
    for handler in logging.getLogger().handlers:
        handler.addFilter(lambda record: not _is_a_librarys(record.name.partition(".")[0]))


def _is_a_librarys(module: str) -> bool:
    """Whether a logger is that of an installed package: ours and a user's own model's are not."""
    where = getattr(sys.modules.get(module), "__file__", None) or ""
    return module not in OWN and "site-packages" in where


@contextlib.contextmanager
def continued_by(what: str) -> Iterator[None]:
    """Turns Ctrl-C into one line that says what continues the run, and exit status 130."""
    try:
        yield
    except KeyboardInterrupt:
        stderr.print(f"interrupted; what was finished is kept, {what} continues it")
        raise typer.Exit(130) from None


@contextlib.contextmanager
def ended_as_by_ctrl_c() -> Iterator[None]:
    """SIGTERM, which ends jobs of Slurm and containers, is taken as Ctrl-C: work is put down."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def given(**options: Any) -> dict[str, Any]:
    """The options a user gave: those that are not None."""
    return {name: value for name, value in options.items() if value is not None}


def print_result(data: dict[str, Any], as_json: bool, text: str) -> None:
    """The result on stdout: as JSON for a program, as text for a person."""
    print(json.dumps(data, indent=1) if as_json else text)
