"""What a campaign asks for, in a file beside the records: a board says of it what is not there yet.

One file a campaign, ``NAME.campaign.json``: every row at every milestone, and of each seed whether
it is done, missing, failed or waits for data. It is no record: nothing is ranked or checked by it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from typing_extensions import TypedDict

from partialbench.benchmark.records import cards
from partialbench.benchmark.variant import with_changes
from partialbench.dataset.shards import write_atomically
from partialbench.errors import InputError

SUFFIX = ".campaign.json"
FORMAT, FORMAT_VERSION = "partialbench-campaign", 1
State = Literal["done", "missing", "failed", "waiting"]


@dataclass(frozen=True, order=True)
class Declared:
    """One seed of one row at one milestone, on one test set.

    Attributes:
        train_data, test_data: as the campaign calls them. train_digest, test_digest: of the splits,
            "" of data that are not made yet.
        protocol: its title, "board stretch=1.25".
        title: of the model's card. variant: what is changed about it, "" for nothing.
        reason: why it failed or waits.
    """

    train_data: str
    test_data: str
    train_digest: str
    test_digest: str
    protocol: str
    protocol_digest: str
    clouds: int
    model: str
    variant: str
    title: str
    seed: int
    state: State
    reason: str = ""

    @property
    def row(self) -> str:
        """The table row it belongs to, as ``Result.row``."""
        return with_changes(self.model, self.variant)


class _Seed(TypedDict):
    seed: Annotated[int, Field(ge=0)]
    state: State
    reason: str


class _Row(TypedDict):
    train: str
    test: str
    protocol: str
    clouds: Annotated[int, Field(ge=1)]
    model: str
    variant: str
    title: str
    seeds: list[_Seed]


class _Splits(TypedDict):
    train: str
    test: str


class _File(TypedDict):
    __pydantic_config__ = ConfigDict(strict=True, extra="forbid")  # type: ignore[misc]

    format: Literal["partialbench-campaign"]
    format_version: Literal[1]
    data: dict[str, _Splits]
    protocols: dict[str, str]
    rows: list[_Row]


_FILE = TypeAdapter(_File)


def write(path: Path, declared: Iterable[Declared]) -> None:
    """Writes a campaign's rows; the same rows in any order are the same bytes."""
    rows: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    data: dict[str, dict[str, str]] = {}
    protocols: dict[str, str] = {}
    for each in sorted(declared):
        data.setdefault(each.train_data, {"train": "", "test": ""})["train"] = each.train_digest
        data.setdefault(each.test_data, {"train": "", "test": ""})["test"] = each.test_digest
        protocols[each.protocol_digest] = each.protocol
        key = (
            each.train_data, each.test_data, each.protocol_digest, each.clouds, each.model,
            each.variant, each.title,
        )  # fmt: skip
        rows.setdefault(key, []).append(
            {"seed": each.seed, "state": each.state, "reason": each.reason}
        )
    names = ("train", "test", "protocol", "clouds", "model", "variant", "title")
    lines = [
        json.dumps({**dict(zip(names, key, strict=True)), "seeds": seeds}, ensure_ascii=False)
        for key, seeds in rows.items()
    ]
    head = {"format": FORMAT, "format_version": FORMAT_VERSION, "data": dict(sorted(data.items())),
            "protocols": dict(sorted(protocols.items()))}  # fmt: skip
    entries = [f"{json.dumps(k)}: {json.dumps(v, ensure_ascii=False)}" for k, v in head.items()]
    body = '"rows": [\n' + ",\n".join(lines) + "\n]"
    write_atomically(path, ("{\n" + ",\n".join([*entries, body]) + "\n}\n").encode())


def read(path: Path) -> list[Declared]:
    """The rows of one file.

    Raises:
        InputError: it is not what ``write`` writes.
    """
    content = cards.read_json(path)
    try:
        _FILE.validate_python(content, strict=True)
        return [
            Declared(
                row["train"], row["test"], content["data"][row["train"]]["train"],
                content["data"][row["test"]]["test"], content["protocols"][row["protocol"]],
                row["protocol"], row["clouds"], row["model"], row["variant"], row["title"], **seed,
            )
            for row in content["rows"]
            for seed in row["seeds"]
        ]  # fmt: skip
    except (ValidationError, KeyError) as error:
        first = error.errors(include_url=False)[0] if isinstance(error, ValidationError) else None
        told = (
            f"{'.'.join(map(str, first['loc'])) or 'the whole'}: {first['msg'].lower()}"
            if first
            else f"it does not say what {error} is"
        )
        raise InputError(
            f"{path} is not what a campaign writes ({told}); delete it, or have it written anew by "
            f"'partialbench campaign status FILE --save'"
        ) from error


def read_folder(folder: Path) -> list[Declared]:
    """The rows of every campaign of a folder of records, those of several once each."""
    found: dict[tuple[Any, ...], Declared] = {}
    for path in sorted(folder.glob(f"*{SUFFIX}")):
        for each in read(path):
            key = (
                each.train_digest or each.train_data, each.test_digest or each.test_data,
                each.protocol_digest, each.clouds, each.row, each.seed,
            )  # fmt: skip
            if key not in found or found[key].state == "missing":
                found[key] = each
    return sorted(found.values())
