"""A path as a user gives it, in Python, on the command line or in a configuration file."""

from __future__ import annotations

import reprlib
from pathlib import Path
from typing import Any

from partialbench.errors import InputError


def path(value: Any, name: str) -> Path:
    """A path; ``name`` says in errors what it is of.

    A leading ``~`` is the home folder: no shell has looked at ``--out=~/data``, at a configuration
    file or at an argument in Python, and a folder called "~" is what nobody wants.

    Raises:
        InputError: what is no path, and an empty text, which ``pathlib`` takes for the current
            folder: mostly it is a variable of the shell that is not set.
    """
    try:
        given = Path(value)
    except TypeError:
        raise InputError(
            f"{name} must be a path, a str or a pathlib.Path, got {reprlib.repr(value)} "
            f"({type(value).__name__})"
        ) from None
    if isinstance(value, str) and not value.strip():
        raise InputError(f"{name} is empty, got {value!r}; write '.' for the current folder")
    try:
        return given.expanduser()
    except RuntimeError as error:
        raise InputError(
            f"{name} {str(value)!r} begins with a home folder that is not known here ({error}); "
            f"write it out, or ./~ for a folder of that name"
        ) from error
