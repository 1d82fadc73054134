"""Result records: one JSON file a run, its predictions beside it. Tables are made from these.

What several records share is stored once in their folder: the truth of a test set (``testsets``)
and the model's card (``cards``), each under the digest by which a record names it.
"""

from __future__ import annotations

import functools
import hashlib
import json
import logging
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from partialbench.benchmark.clouds import Clouds
from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.protocol import protocol as protocols
from partialbench.benchmark.records import cards, schema, testsets
from partialbench.benchmark.records import predictions as prediction_files
from partialbench.benchmark.records.predictions import Predictions
from partialbench.benchmark.variant import file_name, with_changes
from partialbench.dataset.shards import write_atomically
from partialbench.errors import InputError

log = logging.getLogger(__name__)

FORMAT = "partialbench-result"
FORMAT_VERSION = 6
SUFFIX = ".result.json"
PREDICTIONS_SUFFIX = ".predictions.npz"
INDEPENDENT = 1e-3
"""How far a company audit's logits may move, as a share of their size, for an answer to be a
cloud's own: rounding moves them by less, another batch-mate by more."""
LATER = {"damage", "grid", "date"}
"""Fields that records written before there was such a thing have not, and mean their default."""
LONGEST_ROW = 80
"""Characters of a row's name in a file name; the digest at its end tells the rest apart."""


@dataclass(frozen=True)
class DataRecord:
    """One split of one data folder as a record names it.

    Attributes:
        id: "pm40-parametric" and the like. setting: of ``dataset.settings``.
        digest: of the split's content.
        clouds, objects: how many of it were used.
        points: of a cloud.
        sensor: "kinect-v1:2" and the like, "" for exact depth.
    """

    id: str
    setting: str
    digest: str
    clouds: int
    objects: int
    class_names: list[str]
    points: int
    sensor: str = ""


def describe_data(dataset: Clouds, rows: NDArray[np.int64]) -> DataRecord:
    """How a record names these rows of a split; occluders are part of the setting's name."""
    before = f", occluders {dataset.occluders:g}" if dataset.occluders else ""
    return DataRecord(
        id=dataset.dataset_id,
        setting=dataset.setting + before,
        digest=dataset.digest,
        clouds=len(rows),
        objects=len(np.unique(dataset.object_ids[rows])),
        class_names=list(dataset.class_names),
        points=dataset.num_points,
        sensor=dataset.sensor,
    )


@dataclass(frozen=True)
class Result:
    """One model, trained with one seed, on one test set.

    Attributes:
        model: registered name or "module:factory".
        variant: what the user changed about the model, its recipe or precision ("lr=0.01"), "" for
            nothing.
        model_code: SHA-256 of the file a user's own model is in, "" for a registered one.
        options: what its factory was given.
        card: snapshot of the model card. recipe: as used. deviations: from the published recipe.
        protocol, protocol_digest: what the run shares with the others of its column.
        train_data, test_data: see ``DataRecord``.
        given_pose: what the model was told of each test cloud's pose, see ``given_pose.parse``; ""
            for nothing, as ever but for such a test.
        damage: what was done to the test clouds, see ``damage.parse``; "" for nothing.
        grid: the cell of a grid that it was tested on, see ``dataset.grid``; "" for none.
        date: "2026-11-28", the day in UTC on which it was tested; "" in records from before there
            was such a field.
        clouds: the milestone it was trained to; ``training["clouds_seen"]`` is the exact number.
        training: see ``train.Trained.summary``.
        weights_sha256: of the tensors that were tested.
        cost: see ``audit.cost``. rotation_audit: see there. company_audit: see ``company``.
        environment: of the test: hardware, package versions, git commit (None outside a checkout);
            that of the training is in ``training``.
        test_set_sha256: names the truth it was tested against, see ``testsets``.
        predictions_file, predictions_sha256: beside the record.
        scores: what ``metrics.scores`` makes of the stored predictions.
    """

    model: str
    variant: str
    options: dict[str, Any]
    card: dict[str, Any]
    recipe: dict[str, Any]
    deviations: list[str]
    protocol: dict[str, Any]
    protocol_digest: str
    train_data: DataRecord
    test_data: DataRecord
    seed: int
    clouds: int
    given_pose: str
    model_code: str
    weights_sha256: str
    training: dict[str, Any]
    cost: dict[str, Any]
    rotation_audit: dict[str, Any]
    company_audit: dict[str, Any]
    environment: dict[str, Any]
    test_set_sha256: str
    predictions_file: str
    predictions_sha256: str
    scores: dict[str, Any]
    damage: str = ""
    grid: str = ""
    date: str = ""

    @property
    def row(self) -> str:
        """The table row it belongs to."""
        return with_changes(self.model, self.variant)

    @property
    def conditions(self) -> dict[str, str]:
        """In what the test was made to differ from the training; mostly in nothing.

        "grid": the cell, whose sensor is no condition besides. "points": of a cloud. "sensor": what
        distorted the clouds, on the data set trained on. "pose": what was told of theirs. "damage":
        what was done to them. "scored": "transductively", where the answer for a cloud hangs on the
        clouds scored beside it.
        """
        train, test = self.train_data, self.test_data
        found = {}
        if self.grid:
            found["grid"] = self.grid
        if test.points != self.protocol["num_points"]:
            found["points"] = str(test.points)
        if not self.grid and test.id == train.id and test.sensor != train.sensor:
            found["sensor"] = test.sensor or "ideal"
        if self.given_pose:
            found["pose"] = self.given_pose
        if self.damage:
            found["damage"] = self.damage
        if self.company_audit["drift"] > INDEPENDENT:
            found["scored"] = "transductively"
        return found

    @property
    def column(self) -> tuple[str, ...]:
        """What must agree for two results to be compared: data, protocol, milestone."""
        train, test = self.train_data, self.test_data
        return (
            train.id, train.setting, train.digest, test.id, test.setting, test.digest,
            self.protocol_digest, milestones.name(self.clouds),
            *(f"{k}={v}" for k, v in self.conditions.items()),
        )  # fmt: skip

    @property
    def identity(self) -> tuple[object, ...]:
        """Two results with the same one record the same run."""
        return (self.row, *self.column, self.seed)

    @property
    def run_name(self) -> str:
        """File name stem: the same run writes the same file."""
        short = hashlib.sha256(json.dumps(self.identity).encode()).hexdigest()[:8]
        parts = [self.model, self.variant, self.train_data.id]
        if self.test_data.id != self.train_data.id:
            parts.append(f"on-{self.test_data.id}")
        parts += [f"{name}-{value}" for name, value in self.conditions.items()]
        parts += [self.protocol["preset"], milestones.name(self.clouds)]
        parts += [f"seed{self.seed}", short]
        return file_name(*parts)


def write(folder: Path, result: Result, predictions: Predictions) -> Path:
    """Writes truth, card, predictions, then the record, each whole or not at all.

    ``result``'s three fields that name files are filled in here. Returns the record's path.
    """
    folder.mkdir(parents=True, exist_ok=True)
    data = prediction_files.to_bytes(predictions)
    record = asdict(result)
    record["card"] = cards.write(folder, result.card)
    if result.test_data.class_names == result.train_data.class_names:
        record["test_data"]["class_names"] = None
    record["test_set_sha256"] = testsets.write(folder, predictions)
    record["predictions_file"] = f"{result.run_name}{PREDICTIONS_SUFFIX}"
    record["predictions_sha256"] = hashlib.sha256(data).hexdigest()
    write_atomically(folder / record["predictions_file"], data)
    path = folder / f"{result.run_name}{SUFFIX}"
    _say_replaced(path, result.weights_sha256)
    write_atomically(path, _as_text({"format": FORMAT, "format_version": FORMAT_VERSION, **record}))
    return path


def _say_replaced(path: Path, weights: str) -> None:
    """A run's record may be made again; that of other weights is not to go without a word."""
    try:
        before = cards.read_json(path)["weights_sha256"] if path.is_file() else weights
    except (InputError, KeyError, TypeError):
        return  # no record that anyone could miss
    if before != weights:
        log.warning(
            "%s was the record of other weights (SHA-256 %s, now %s) and is replaced; another "
            "results folder would have kept both",
            path, str(before)[:12], weights[:12],
        )  # fmt: skip


def _as_text(record: dict[str, Any]) -> bytes:
    """The record and its digest as JSON, one entry a line."""
    lines = [
        f"{json.dumps(name)}: {json.dumps(value, ensure_ascii=False, allow_nan=False)}"
        for name, value in {**record, "record_sha256": record_digest(record)}.items()
    ]
    return ("{\n" + ",\n".join(lines) + "\n}\n").encode()


def record_digest(record: dict[str, Any]) -> str:
    """SHA-256 of the record without its own digest: a record edited by hand no longer fits."""
    return cards.json_digest({k: v for k, v in record.items() if k != "record_sha256"})


def read(path: Path) -> Result:
    """One record.

    Raises:
        InputError: not a record, of another format, incomplete, edited since it was written, or
            with entries that are not what they should be.
    """
    record = cards.read_json(path)
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise InputError(f"{path} is not a result record of partialbench eval")
    if record.get("format_version") != FORMAT_VERSION:
        raise InputError(
            f"{path} is a record of format {record.get('format_version')!r}, this version reads "
            f"{FORMAT_VERSION}; test the run's checkpoint again (eval --checkpoint), or read the "
            f"record with the release that wrote it"
        )
    names = {f.name for f in fields(Result)}
    present = set(record) - {"format", "format_version", "record_sha256"}
    if present | LATER != names:
        raise InputError(
            f"{path}: missing fields {sorted(names - present - LATER)}, unknown "
            f"{sorted(present - names)}"
        )
    if record.get("record_sha256") != record_digest(record):
        raise InputError(
            f"{path} was changed after it was written: its digest does not fit. Run the "
            f"evaluation again"
        )
    fault = schema.record_fault(record)
    if fault:
        raise InputError(f"{path}: an entry is not what it should be: {fault}")
    values = {name: record[name] for name in names & present}
    values["card"] = cards.load(path.parent, record["card"])
    train = record["train_data"]
    classes = record["test_data"]["class_names"] or train["class_names"]
    try:
        protocols.from_dict(record["protocol"])
        values["train_data"] = DataRecord(**train)
        values["test_data"] = DataRecord(**{**record["test_data"], "class_names": classes})
    except (InputError, TypeError) as error:
        raise InputError(f"{path}: an entry is not what it should be: {error}") from error
    if values["train_data"].class_names is None:
        raise InputError(f"{path}: an entry is not what it should be: train_data has no classes")
    return Result(**values)


def read_predictions(folder: Path, result: Result) -> Predictions:
    """The stored predictions of a record in ``folder``, beside the truth it was tested against.

    Raises:
        InputError: missing, not the file the record was written with, or not of its test set.
    """
    path = folder / result.predictions_file
    if not path.is_file():
        raise InputError(f"{path} is missing; the record of {result.row} names it")
    status = path.stat()
    truth = testsets.load(folder, result.test_set_sha256)
    if truth.class_names.tolist() != result.test_data.class_names:
        raise InputError(
            f"{folder / result.run_name}{SUFFIX} names other classes of the test data than their "
            f"truth, {testsets.path_of(folder, result.test_set_sha256)}"
        )
    return _load_predictions(
        path, result.predictions_sha256, truth, tuple(result.train_data.class_names),
        status.st_mtime_ns, status.st_size,
    )  # fmt: skip


@functools.lru_cache(maxsize=512)
def _load_predictions(
    path: Path, sha256: str, truth: testsets.GroundTruth, classes: tuple[str, ...],
    _mtime: int, _size: int,
) -> Predictions:  # fmt: skip
    """A board asks for the same file for every table that is made of it."""
    data = path.read_bytes()
    found = hashlib.sha256(data).hexdigest()
    if found != sha256:
        raise InputError(
            f"{path} is not the file its record was written with: SHA-256 {found}, expected "
            f"{sha256}"
        )
    predictions = prediction_files.from_bytes(data, path, truth, classes)
    for field in fields(predictions):  # one copy is handed to all
        getattr(predictions, field.name).flags.writeable = False
    return predictions


def read_folder(folder: Path) -> list[Result]:
    """Every record of a folder (not of its subfolders), sorted by file name.

    Raises:
        InputError: no folder, a bad record, or two records of one run.
    """
    if not folder.is_dir():
        raise InputError(f"no results folder at {folder}")
    found: dict[tuple[object, ...], Path] = {}
    results = []
    for path in sorted(folder.glob(f"*{SUFFIX}")):
        result = read(path)
        if result.identity in found:
            raise InputError(duplicate_message(path, found[result.identity], result))
        found[result.identity] = path
        results.append(result)
    return results


def duplicate_message(path: Path, other: Path, result: Result) -> str:
    """What to say of two records of one run."""
    return f"{path} and {other} record the same run ({result.row}, seed {result.seed}); delete one"
