"""The errors a user meets: each says what was wrong, the value, what was expected, what to do."""

import contextlib
from collections.abc import Iterator


class PartialbenchError(Exception):
    """Base of every error this project raises for a reason a user can act on.

    Attributes:
        exit_status: of a command that ends with it.
    """

    exit_status = 1


class InputError(PartialbenchError, ValueError):
    """An input file, folder or argument is not what it should be."""


class ConfigurationMismatchError(PartialbenchError):
    """An output folder was made with another configuration than the one asked for."""


class TimeLimitError(PartialbenchError):
    """The time was over before the work was. What was done is kept, the same call goes on."""

    exit_status = 75  # EX_TEMPFAIL of sysexits.h


@contextlib.contextmanager
def parsing(name: str, kind: str) -> Iterator[None]:
    """Turns whatever goes wrong while a file of a kind ("PLY") is parsed into an ``InputError``."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
    except Exception as error:  # each format's parser fails in its own ways
        raise InputError(
            f"{name}: cannot be read as {kind} ({type(error).__name__}: {error})"
        ) from error
