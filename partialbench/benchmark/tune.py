"""``partialbench tune``: recipes of one model compared on the validation split, and nowhere else.

The test split is never opened here. Every trial is recorded, also those that lost, so that a reader
of the table can see that each model was given as many.
"""

from __future__ import annotations

import csv
import io
import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from partialbench.benchmark import models
from partialbench.benchmark import protocol as protocols
from partialbench.benchmark import recipe as recipes
from partialbench.benchmark.memory import keep_freed_memory
from partialbench.benchmark.run import describe_changes, make_fabric, make_task, run_folder
from partialbench.benchmark.train import train
from partialbench.dataset.loader import ShardDataset
from partialbench.dataset.shards import write_atomically
from partialbench.errors import InputError

log = logging.getLogger(__name__)

FILE = "tuning.csv"


@dataclass(frozen=True)
class Trial:
    """One training and what came of it on the validation split.

    Attributes:
        model, options: as the record of the row has them; ``options`` as "k=v …".
        recipe: what the trial changed about the model's recipe under the protocol, "" for nothing.
        data, protocol: digests. clouds_seen: repeats counted.
        validation_accuracy: share of validation clouds, after the last epoch.
    """

    model: str
    options: str
    recipe: str
    seed: int
    data: str
    protocol: str
    clouds_seen: int
    train_loss: float
    validation_accuracy: float

    @property
    def identity(self) -> tuple[object, ...]:
        """Two trials with the same one are one trial."""
        return (
            self.model, self.options, self.data, self.protocol, self.seed, self.recipe,
        )  # fmt: skip


def tune(
    model: str,
    data: Path | str,
    tries: Sequence[Mapping[str, Any]],
    preset: str = "mini",
    seed: int = 0,
    device: str = "auto",
    results_folder: Path | str = "results",
    *,
    precision: str = "32-true",
    options: Mapping[str, Any] | None = None,
    protocol: Mapping[str, Any] | None = None,
) -> list[Trial]:
    """Trains the model once with each recipe; adds the trials to ``tuning.csv`` of the folder.

    Interrupted, the same call continues; a finished trial is not repeated.

    Args:
        model, data, preset, device, precision, options, protocol: as ``run_eval`` takes them.
        tries: fields of the recipe to change, one mapping a trial; {} is the recipe as it is.
        seed: of every trial.

    Returns:
        the trials, best validation accuracy first.

    Raises:
        InputError: no trials, a protocol without a validation split, or anything about the
            arguments or files.
    """
    if not tries:
        raise InputError("nothing to try: give at least one recipe, e.g. --try lr=0.001")
    results_folder = Path(results_folder)
    fabric = make_fabric(device, precision)
    if fabric.device.type == "cpu":
        keep_freed_memory()
    followed = protocols.protocol(preset, **(protocol or {}))
    if followed.validation_fraction == 0:
        raise InputError("validation_fraction is 0: there is nothing to choose on")
    train_set = ShardDataset(data, "train", followed.num_points)
    own = recipes.of_protocol(models.card_of(model), followed)
    # All are checked before the first is trained.
    used = [recipes.override(own, changes) for changes in tries]
    chosen = dict(options or {})
    trials = []
    for changes, recipe in zip(tries, used, strict=True):
        task = make_task(
            model, train_set, followed, recipe, seed, chosen, describe_changes(changes, chosen)
        )
        folder, tried = results_folder / "runs" / run_folder(task), describe_changes(changes, {})
        log.info("trying %s in %s", tried or "the recipe as it is", folder)
        summary = train(task, fabric, folder, resume=True).summary
        trial = Trial(
            model, describe_changes({}, chosen), tried, seed, train_set.digest, followed.digest,
            summary["clouds_seen"], summary["train_loss"], summary["validation_accuracy"],
        )  # fmt: skip
        trials.append(trial)
        if fabric.is_global_zero:
            _add(results_folder / FILE, trial)
        fabric.barrier()
    return sorted(trials, key=lambda t: -t.validation_accuracy)


def read_trials(path: Path) -> list[Trial]:
    """The trials of a ``tuning.csv``; none where there is no such file.

    Raises:
        InputError: a file that is not one.
    """
    if not path.is_file():
        return []
    kinds = {f.name: {"int": int, "float": float}.get(str(f.type), str) for f in fields(Trial)}
    try:
        with open(path, newline="", encoding="utf-8") as file:
            return [
                Trial(**{name: kind(line[name]) for name, kind in kinds.items()})
                for line in csv.DictReader(file)
            ]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is not a file of trials: {error!r}") from error


def _add(path: Path, trial: Trial) -> None:
    """Writes the file anew with the trial in the place of an earlier one of the same identity."""
    kept = {old.identity: old for old in read_trials(path)} | {trial.identity: trial}
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, [f.name for f in fields(Trial)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(kept[identity]) for identity in sorted(kept, key=repr))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, text.getvalue().encode())
