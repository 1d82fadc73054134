"""``tuning.csv``: the trials of ``partialbench tune``, one line each, the lost ones too."""

from __future__ import annotations

import csv
import fcntl
import io
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from partialbench.benchmark.variant import with_changes
from partialbench.dataset.shards import write_atomically
from partialbench.errors import InputError

FILE = "tuning.csv"


@dataclass(frozen=True)
class Trial:
    """One training and what came of it on the validation split.

    Attributes:
        model, options: as the record of the row has them; ``options`` as "k=v …", a start among
            them.
        recipe: what the trial changed about the model's recipe under the protocol, "" for nothing.
        data, protocol: digests. clouds_seen: repeats counted; of a trial that diverged, those it
            was to see.
        validation_accuracy: share of validation clouds, after the last epoch; None, as the loss,
            for a trial whose training diverged.
    """

    model: str
    options: str
    recipe: str
    seed: int
    data: str
    protocol: str
    clouds_seen: int
    train_loss: float | None
    validation_accuracy: float | None

    @property
    def row(self) -> str:
        """The table row it was tried for, whatever its recipe."""
        return with_changes(self.model, self.options)

    @property
    def diverged(self) -> bool:
        return self.validation_accuracy is None

    @property
    def identity(self) -> tuple[object, ...]:
        """Two trials with the same one are one trial."""
        return (
            self.model, self.options, self.data, self.protocol, self.clouds_seen, self.seed,
            self.recipe,
        )  # fmt: skip


def read_trials(path: Path) -> list[Trial]:
    """The trials of a ``tuning.csv``; none where there is no such file.

    Raises:
        InputError: a file that is not one, or with a trial that cannot be.
    """
    if not path.is_file():
        return []
    readers: dict[str, Callable[[str], Any]] = {"int": int, "float | None": _number}
    kinds = {f.name: readers.get(str(f.type), str) for f in fields(Trial)}
    try:
        with open(path, newline="", encoding="utf-8") as file:
            found = [
                Trial(**{name: kind(line[name]) for name, kind in kinds.items()})
                for line in csv.DictReader(file)
            ]
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        raise InputError(f"{path} is not a file of trials: {error!r}") from error
    known = set()
    for number, trial in enumerate(found, 2):
        fault = "it comes twice" if trial.identity in known else _fault(trial)
        if fault:
            raise InputError(f"{path}, line {number}: no trial of {trial.row} ended so: {fault}")
        known.add(trial.identity)
    return found


def _fault(trial: Trial) -> str:
    """What a trial says that cannot be, "" for nothing."""
    loss, accuracy = trial.train_loss, trial.validation_accuracy
    if (loss is None) != (accuracy is None):
        return "of loss and accuracy one is missing"
    if loss is not None and not math.isfinite(loss):
        return f"its loss is {loss}"
    if accuracy is not None and not 0 <= accuracy <= 1:
        return f"its validation accuracy is {accuracy}, expected 0 to 1"
    if trial.clouds_seen < 1:
        return f"it has seen {trial.clouds_seen} clouds"
    return ""


def _number(cell: str) -> float | None:
    """An empty cell is a number there is not."""
    return float(cell) if cell else None


def add_trial(path: Path, trial: Trial) -> None:
    """Writes the file anew with the trial in the place of an earlier one of the same identity.

    Several processes may add to one file at once: each waits for the one before.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path.with_name(f".{path.name}.lock"), "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        kept = {old.identity: old for old in read_trials(path)} | {trial.identity: trial}
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, [f.name for f in fields(Trial)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(kept[identity]) for identity in sorted(kept, key=repr))
        write_atomically(path, text.getvalue().encode())
