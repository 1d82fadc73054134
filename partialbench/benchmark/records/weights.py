"""The weights that come with a release, and the card beside each. Needs no torch.

    partialbench/weights/
        papnet-steered.safetensors     parameters in 16 bits, buffers as they are
        papnet-steered.json            its card: the training, what was tested, digests
        objects-0123456789ab.bin       the training objects' digests, of all that saw the same

Made by ``partialbench.benchmark.pack_weights`` from a checkpoint, read by ``training.packed``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from typing_extensions import TypedDict

from partialbench.benchmark.records.cards import json_digest, read_json
from partialbench.benchmark.records.schema import Count, DataEntry, Digest, Positive, Share
from partialbench.benchmark.variant import with_changes
from partialbench.errors import InputError

FOLDER = Path(__file__).resolve().parents[2] / "weights"
DEFAULT = "papnet-steered"
"""What ``predict`` asks where nobody says whom."""
FORMAT, VERSION = "partialbench-weights", 1
SUFFIX = ".safetensors"


class File(TypedDict):
    """A file beside the card."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9._-]+$")]
    bytes: Positive
    sha256: Digest


class Identity(TypedDict):
    """What of a checkpoint's identity a card tells; ``training.checkpoint`` has all of it."""

    __pydantic_config__ = ConfigDict(extra="allow")  # type: ignore[misc]
    model: str
    class_names: Annotated[list[str], Field(min_length=2)]
    num_points: Positive
    train_data: DataEntry
    seed: int


class Test(TypedDict):
    """What ``predict`` named rightly of a data folder's test split, all stored points given.

    ``answered`` clouds are of a class that the model knows, ``left_out`` are of none;
    ``accuracy`` is of the former, with its 95 % interval over objects, or None for one object.
    """

    data: DataEntry
    source: str
    answered: Positive
    left_out: Count
    objects: Positive
    classes: Positive
    votes: Positive
    accuracy: Share
    interval: tuple[Share, Share] | None


class Rounding(TypedDict):
    """What 16 bits change: share of equal answers, and the largest difference of a probability."""

    clouds: Positive
    same_answers: Share
    largest_difference: Share


class Card(TypedDict):
    """The file beside packed weights."""

    format: str
    format_version: int
    licence: str
    file: File
    tensors_sha256: Digest
    checkpoint_sha256: Digest
    train_objects: File
    identity: Identity
    clouds: Positive
    clouds_seen: Count
    summary: dict[str, Any]
    rounding: Rounding
    tests: Annotated[list[Test], Field(min_length=1)]
    card_sha256: Digest


_CARD = TypeAdapter(Card)


def names() -> list[str]:
    """The models whose weights are in this release, sorted."""
    return sorted(path.stem for path in FOLDER.glob(f"*{SUFFIX}"))


def file_of(name: str) -> Path:
    """The packed weights of a model.

    Raises:
        InputError: none come with this release.
    """
    if name not in names():
        raise InputError(f"no weights of {name} come with this release{but_these(name)}")
    return FOLDER / f"{name}{SUFFIX}"


def but_these(name: str) -> str:
    """ "; did you mean papnet-steered?": what else an error may offer."""
    from partialbench.registry import close_matches

    return close_matches(name, names()) if names() else ""


def read_card(file: Path) -> dict[str, Any]:
    """The card beside a file of packed weights, held against its own digest.

    Raises:
        InputError: it is missing, damaged, edited, or of another version.
    """
    path = file.with_suffix(".json")
    card = read_json(path)
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        raise InputError(f"{path} is no card of packed weights (format {FORMAT!r} is expected)")
    if card.get("format_version") != VERSION:
        raise InputError(
            f"{path} is of format {card.get('format_version')!r}, this version reads {VERSION}: "
            f"install the release that brought it"
        )
    try:
        # As JSON, strictly: a list is a tuple there, and a number in quotes is none.
        _CARD.validate_json(path.read_bytes(), strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(f"{path} is damaged: {where}: {first['msg']}; {AGAIN}") from error
    if card_digest(card) != card["card_sha256"]:
        raise InputError(f"{path} was changed after it was written: its digest differs; {AGAIN}")
    return card


AGAIN = "install partialbench again, or pack the weights anew"


def card_digest(card: dict[str, Any]) -> str:
    """SHA-256 (hex) of all that a card says but this digest."""
    return json_digest({name: value for name, value in card.items() if name != "card_sha256"})


def text(card: dict[str, Any]) -> bytes:
    """The card's file."""
    return (json.dumps(card, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()


def in_a_sentence(card: dict[str, Any]) -> str:
    """What a user should know before they trust an answer: trained on what, right how often."""
    identity = card["identity"]
    data = identity["train_data"]
    tested = "; ".join(
        f"{100 * one['accuracy']:.1f} % of {one['answered']:,} {one['source']}"
        for one in card["tests"]
    )
    under = "" if card["licence"] == "MIT" else f"; terms: {card['licence']}"
    return (
        f"{identity['model']}, trained on {card['clouds_seen']:,} clouds of {data['id']} "
        f"({len(identity['class_names'])} classes, {data['setting']} views, "
        f"{identity['num_points']} points); names rightly {tested}{under}"
    )


MARK, END = "<!-- weights -->", "<!-- end -->"
"""Between them a page has the table of what comes with the release."""


def block(cards: dict[str, dict[str, Any]]) -> str:
    """The table between its marks, as a page of the docs has it."""
    table = as_markdown(dict(sorted(cards.items()))) if cards else "None yet.\n"
    return f"{MARK}\n{table}{END}"


def as_markdown(cards: dict[str, dict[str, Any]]) -> str:
    """A table of what each was trained on, and of what it gives on every test, a line a test."""
    lines = [
        "| weights | trained on | clouds seen | tested on | views | rightly named | interval |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, card in cards.items():
        data = card["identity"]["train_data"]
        row = with_changes(name, card["identity"]["variant"])
        for test in card["tests"]:
            low_high = test["interval"]
            within = "–" if not low_high else "{:.1%} – {:.1%}".format(*low_high)
            lines.append(
                f"| {row} | {data['id']} `{data['digest'][:8]}` | {card['clouds_seen']:,} | "
                f"{test['source']} (`{test['data']['digest'][:8]}`) | {test['answered']:,} of "
                f"{test['classes']} classes | {test['accuracy']:.1%} | {within} |"
            )
    return "\n".join(lines) + "\n"
