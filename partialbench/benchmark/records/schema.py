"""What the entries of a record's file must be, so that nothing that reads one stumbles later.

Checked strictly (a number in quotes is none, NaN is none); entries beyond these are kept.
"""

from __future__ import annotations

from typing import Annotated, Any, NotRequired

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from typing_extensions import TypedDict

Share = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=0)]
Positive = Annotated[int, Field(ge=1)]
Amount = Annotated[float, Field(ge=0)]
Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Code = Annotated[str, Field(pattern=r"^([0-9a-f]{64})?$")]
Day = Annotated[str, Field(pattern=r"^(\d{4}-\d{2}-\d{2})?$")]
OptionalShare = Share | None


class DataEntry(TypedDict):
    """See ``results.DataRecord``."""

    id: str
    setting: str
    digest: Digest
    clouds: Positive
    objects: Positive
    class_names: Annotated[list[str], Field(min_length=1)] | None
    points: Positive
    sensor: Annotated[str, Field(pattern=r"^([^:]+(:\d+(\.\d+)?)?)?$")]


class Environment(TypedDict):
    """See ``environment.describe``."""

    device: str
    cpu: str
    packages: dict[str, str]
    git_commit: str | None


class StartData(TypedDict):
    """What an earlier training saw."""

    id: str
    points: Positive


class Start(TypedDict):
    """See ``finetune.Start.origin``."""

    name: str
    clouds_seen: Count
    train_data: StartData
    start: Start | None


class Curve(TypedDict):
    """After each epoch or interval."""

    train_loss: list[float]
    validation_accuracy: list[OptionalShare]


class Training(TypedDict):
    """See ``train.Trained.summary``."""

    epochs: Amount
    steps: Positive
    clouds_seen: Positive
    seconds: Amount
    clouds_per_second: Amount
    train_loss: float
    validation_accuracy: OptionalShare
    curve: Curve
    peak_memory_bytes: Count
    environment: Environment
    earlier_environments: NotRequired[list[Environment]]
    start: NotRequired[Start | None]


class Cost(TypedDict):
    """See ``audit.cost``."""

    parameters: Count
    multiply_adds: Count
    latency_ms: Amount
    batch_ms: Amount
    batch_size: Positive
    peak_memory_bytes: Count


class RotationAudit(TypedDict):
    """See ``audit.rotation_audit``."""

    drift: Amount
    changed: Share
    clouds: Positive
    turns: Positive


class CompanyAudit(TypedDict):
    """See ``company.company_audit``."""

    drift: Amount
    clouds: Positive
    random: bool
    changed_buffers: list[str]


class RecipeEntry(TypedDict):
    """See ``registry.Recipe``."""

    lr: Amount
    batch_size: Positive
    epochs: Positive | None


class Card(TypedDict):
    """See ``registry.ModelCard``."""

    name: str
    title: str
    paper: str
    reference: str
    reference_licence: str
    representation: str
    invariances: list[str]
    recipe: RecipeEntry
    paper_scores: dict[str, float]
    choices: list[str]
    deviations: list[str]


class Visibility(TypedDict):
    """One bin of ``metrics.by_visibility``."""

    # The edges are written so.
    clouds: Count
    accuracy: OptionalShare


class Pose(TypedDict):
    """See ``metrics.pose_scores``."""

    top_k: Annotated[list[Share], Field(min_length=1)]
    mean_deg: Amount
    median_deg: Amount
    within_15: Share
    within_30: Share


class Scores(TypedDict):
    """See ``metrics.scores``."""

    clouds: Positive
    objects: Positive
    accuracy: Share
    class_accuracy: Share
    restricted_accuracy: Share
    restricted_class_accuracy: Share
    duplicates: Count
    accuracy_without_duplicates: OptionalShare
    class_accuracy_without_duplicates: OptionalShare
    per_class: dict[str, OptionalShare]
    calibration_error: Share
    visibility: list[Visibility]
    pose: Pose | None
    ensemble: list[Share] | None


class RecordFile(TypedDict):
    """A record as its file has it: ``results.Result``, with the card by its digest."""

    # Holds for the entries within too.
    __pydantic_config__ = ConfigDict(strict=True, allow_inf_nan=False)  # type: ignore[misc]

    format: str
    format_version: int
    model: Annotated[str, Field(min_length=1)]
    variant: str
    options: dict[str, Any]
    card: Digest
    recipe: RecipeEntry
    deviations: list[str]
    protocol: dict[str, Any]
    protocol_digest: Digest
    train_data: DataEntry
    test_data: DataEntry
    seed: Count
    clouds: Positive
    given_pose: str
    damage: NotRequired[str]
    grid: NotRequired[str]
    date: NotRequired[Day]
    model_code: Code
    weights_sha256: Digest
    training: Training
    cost: Cost
    rotation_audit: RotationAudit
    company_audit: CompanyAudit
    environment: Environment
    test_set_sha256: Digest
    predictions_file: Annotated[str, Field(pattern=r"^[^/\\]+\.predictions\.npz$")]
    predictions_sha256: Digest
    scores: Scores
    record_sha256: Digest


_RECORD = TypeAdapter(RecordFile)
_CARD = TypeAdapter(Card)


def record_fault(record: Any) -> str:
    """The first three things in a record that are not what they should be, "" for nothing."""
    return _fault(_RECORD, record)


def card_fault(card: Any) -> str:
    """The same of a model card."""
    return _fault(_CARD, card)


def _fault(adapter: TypeAdapter, value: Any) -> str:
    try:
        adapter.validate_python(value, strict=True)
    except ValidationError as error:
        found = [
            f"{'.'.join(map(str, each['loc'])) or 'the whole'}: {each['msg'].lower()}"
            + ("" if each["type"] == "missing" else f", got {_short(each['input'])}")
            for each in error.errors(include_url=False)
        ]
        more = f" and {len(found) - 3} more" if len(found) > 3 else ""
        return "; ".join(found[:3]) + more
    return ""


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}…"
