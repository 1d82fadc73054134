"""A training's log while it grows, for who watches: TensorBoard, beside the plain log.csv."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from partialbench import extras
from partialbench.errors import InputError
from partialbench.registry import close_matches

LOGS = ("csv", "tensorboard")


def check_log(name: str) -> None:
    """Raises ``InputError`` for no such log, ``MissingExtraError`` where its library is missing."""
    if name not in LOGS:
        raise InputError(f"no log {name!r}{close_matches(name, LOGS)}")
    if name == "tensorboard":
        extras.load("tensorboard")


class TensorBoard:
    """Writes each line of a log once: ``tensorboard --logdir results/runs`` shows it.

    The step is the number of clouds seen, so that trainings of different batches compare.

    Args:
        folder: for the event files.
        earlier: lines that an earlier process wrote, if the folder has its files.
    """

    def __init__(self, folder: Path, earlier: Sequence[Mapping[str, Any]] = ()) -> None:
        from torch.utils.tensorboard import SummaryWriter

        known = earlier if any(folder.glob("events.*")) else ()
        self._written = len(known)
        self._open = (
            {name for name, value in known[-1].items() if value is None} if known else set()
        )
        self._writer = SummaryWriter(str(folder))

    def update(self, history: Sequence[Mapping[str, Any]]) -> None:
        """Writes the lines that are new, and what the last one lacked when it was written."""
        if self._open and self._written:
            self._add(history[self._written - 1], self._open)
        for line in history[self._written :]:
            self._add(line, set(line) - {"clouds_seen"})
        self._written = len(history)

    def _add(self, line: Mapping[str, Any], names: set[str]) -> None:
        known = sorted(name for name in names if line[name] is not None)
        for name in known:
            self._writer.add_scalar(name, line[name], line["clouds_seen"])
        if known:
            self._writer.flush()
        self._open = names - set(known)

    def close(self) -> None:
        """Ends the file."""
        self._writer.close()
