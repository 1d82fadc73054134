"""Model cards as they were in a test: stored once, in ``cards/`` of a results folder."""

from __future__ import annotations

import functools
import hashlib
import json
from pathlib import Path
from typing import Any

from partialbench.benchmark.records import schema
from partialbench.dataset.shards import write_atomically
from partialbench.errors import InputError

FOLDER = "cards"
DIGITS = 12
"""Hexadecimal digits of the digest in a file's name."""


def json_digest(value: Any) -> str:
    """SHA-256 (hex) of JSON data, whatever the order of its entries and its layout."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def read_json(path: Path) -> Any:
    """A file's JSON data; ``InputError`` where it is absent or is none."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} is not a readable JSON file: {error}") from error


def write(folder: Path, card: dict[str, Any]) -> str:
    """Stores a card in a results folder, unless it is there; returns its digest."""
    digest = json_digest(card)
    try:
        load(folder, digest)
    except InputError:  # absent or damaged
        path = _path(folder, digest)
        path.parent.mkdir(parents=True, exist_ok=True)
        text = json.dumps(card, indent=1, ensure_ascii=False, allow_nan=False)
        write_atomically(path, f"{text}\n".encode())
    return digest


def load(folder: Path, sha256: str) -> dict[str, Any]:
    """The card of this digest.

    Raises:
        InputError: the folder has it not, or something else under its name.
    """
    path = _path(folder, sha256)
    try:
        status = path.stat()
    except OSError:
        raise InputError(
            f"{path} is missing: a model card, which records name; copy the folder {FOLDER}/ along "
            f"with them"
        ) from None
    return _load(path, sha256, status.st_mtime_ns, status.st_size)


def _path(folder: Path, sha256: str) -> Path:
    return folder / FOLDER / f"{sha256[:DIGITS]}.json"


@functools.lru_cache(maxsize=256)
def _load(path: Path, sha256: str, _mtime: int, _size: int) -> dict[str, Any]:
    card = read_json(path)
    if json_digest(card) != sha256:
        raise InputError(
            f"{path} is not the card its records name: its digest is {json_digest(card)}, expected "
            f"{sha256}; it was changed after it was written"
        )
    fault = schema.card_fault(card)
    if fault:
        raise InputError(f"{path} is not a model card: {fault}")
    return card
