"""Result records: one JSON file a run, its predictions beside it. Tables are made from these."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from partialbench.benchmark.clouds import Clouds
from partialbench.benchmark.records import older
from partialbench.benchmark.records import predictions as prediction_files
from partialbench.benchmark.records.predictions import Predictions
from partialbench.benchmark.variant import file_name
from partialbench.dataset.shards import write_atomically
from partialbench.errors import InputError

FORMAT = "partialbench-result"
FORMAT_VERSION = 5
READABLE = (2, 3, 4, FORMAT_VERSION)
"""What an earlier format lacked or said otherwise: ``older``."""
SUFFIX = ".result.json"


@dataclass(frozen=True)
class DataRecord:
    """One split of one data folder as a record names it.

    Attributes:
        id: "pm40-parametric" and the like. setting: "partial", "rotated" or "aligned".
        digest: of the split's content.
        clouds, objects: how many of it were used.
        points: of a cloud; None where a record does not say: the protocol's.
        sensor: "kinect-v1:2" and the like, "" for exact depth.
    """

    id: str
    setting: str
    digest: str
    clouds: int
    objects: int
    class_names: list[str]
    points: int | None = None
    sensor: str = ""


def describe_data(dataset: Clouds, rows: NDArray[np.int64]) -> DataRecord:
    """How a record names these rows of a split."""
    return DataRecord(
        id=dataset.dataset_id,
        setting=dataset.setting,
        digest=dataset.digest,
        clouds=len(rows),
        objects=len(np.unique(dataset.object_ids[rows])),
        class_names=list(dataset.class_names),
        points=dataset.num_points,
        sensor=dataset.sensor,
    )


def with_changes(name: str, changes: str) -> str:
    """A name and, in brackets, what was changed about it: "papnet [grid=16]"."""
    return f"{name} [{changes}]" if changes else name


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
        training: see ``train.Trained.summary``.
        cost: see ``audit.cost``. rotation_audit: see there; {} where a record of an earlier format
            does not say on which test set.
        environment: of the test: hardware, package versions, git commit (None outside a checkout);
            that of the training is in ``training``.
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
    given_pose: str
    model_code: str
    training: dict[str, Any]
    cost: dict[str, Any]
    rotation_audit: dict[str, Any]
    environment: dict[str, Any]
    predictions_file: str
    predictions_sha256: str
    scores: dict[str, Any]

    @property
    def row(self) -> str:
        """The table row it belongs to."""
        return with_changes(self.model, self.variant)

    @property
    def conditions(self) -> dict[str, str]:
        """In what the test was made to differ from the training; mostly in nothing.

        "points": of a cloud. "sensor": what distorted the clouds, on the data set trained on.
        "pose": what was told of theirs.
        """
        train, test = self.train_data, self.test_data
        found = {}
        if test.points not in (None, self.protocol["num_points"]):
            found["points"] = str(test.points)
        if test.id == train.id and test.sensor != train.sensor:
            found["sensor"] = test.sensor or "ideal"
        if self.given_pose:
            found["pose"] = self.given_pose
        return found

    @property
    def column(self) -> tuple[str, ...]:
        """What must agree for two results to be compared: data and protocol, by digest."""
        train, test = self.train_data, self.test_data
        return (
            train.id, train.setting, train.digest, test.id, test.setting, test.digest,
            self.protocol_digest, *(f"{k}={v}" for k, v in self.conditions.items()),
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
        parts += [self.protocol["preset"], f"seed{self.seed}", short]
        return file_name(*parts)


def write(folder: Path, result: Result, predictions: Predictions) -> Path:
    """Writes the predictions, then the record, each whole or not at all; returns the record's path.

    ``result``'s two prediction fields are filled in here.
    """
    folder.mkdir(parents=True, exist_ok=True)
    data = prediction_files.to_bytes(predictions)
    record = asdict(result)
    record["predictions_file"] = f"{result.run_name}.predictions.npz"
    record["predictions_sha256"] = hashlib.sha256(data).hexdigest()
    write_atomically(folder / record["predictions_file"], data)
    text = {"format": FORMAT, "format_version": FORMAT_VERSION, **record}
    text["record_sha256"] = record_digest(text)
    path = folder / f"{result.run_name}{SUFFIX}"
    write_atomically(
        path, (json.dumps(text, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()
    )
    return path


def record_digest(record: dict[str, Any]) -> str:
    """SHA-256 of the record without its own digest: a record edited by hand no longer fits."""
    rest = {k: v for k, v in record.items() if k != "record_sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def read(path: Path) -> Result:
    """One record.

    Raises:
        InputError: not a record, of a later version, incomplete, or edited since it was written.
    """
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"{path} is not a readable JSON record: {error}") from error
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise InputError(f"{path} is not a result record of partialbench eval")
    if record.get("format_version") not in READABLE:
        raise InputError(
            f"{path} is a record of format {record.get('format_version')}, this version reads "
            f"{', '.join(map(str, READABLE))}"
        )
    names = {f.name for f in fields(Result)}
    expected = names - older.lacking(record["format_version"]).keys()
    present = set(record) - {"format", "format_version", "record_sha256"}
    if present != expected:
        raise InputError(
            f"{path}: missing fields {sorted(expected - present)}, unknown "
            f"{sorted(present - expected)}"
        )
    if record.get("record_sha256") != record_digest(record):
        raise InputError(
            f"{path} was changed after it was written: its digest does not fit. Run the "
            f"evaluation again"
        )
    try:
        if record["format_version"] < FORMAT_VERSION:
            record = older.upgraded(record)
        values = {name: record[name] for name in names}
        values["train_data"] = DataRecord(**record["train_data"])
        values["test_data"] = DataRecord(**record["test_data"])
    except (InputError, KeyError, TypeError) as error:
        raise InputError(f"{path}: an entry is not what it should be: {error!r}") from error
    return Result(**values)


def read_predictions(folder: Path, result: Result) -> Predictions:
    """The stored predictions of a record in ``folder``.

    Raises:
        InputError: missing, or not the file the record was written with.
    """
    path = folder / result.predictions_file
    if not path.is_file():
        raise InputError(f"{path} is missing; the record of {result.row} names it")
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    if found != result.predictions_sha256:
        raise InputError(
            f"{path} is not the file its record was written with: SHA-256 {found}, expected "
            f"{result.predictions_sha256}"
        )
    return prediction_files.load(path)


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
