"""Which scans are for training: by a list, or by the name of the place."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from partialbench.errors import InputError

TRAIN_SHARE = 0.8


def split_by_hash(space: str) -> str:
    """ "train" for four of five space ids, by their digest, else "test"."""
    digest = hashlib.sha256(space.encode()).digest()
    return "train" if int.from_bytes(digest[:8], "big") < TRAIN_SHARE * 2**64 else "test"


def read_split_file(path: Path) -> dict[str, str]:
    """Scene or space id → split, from JSON {"train": [...], "test": [...]}.

    Raises:
        InputError: it is not that, or an id is in both.
    """
    try:
        lists = json.loads(Path(path).read_bytes())
        splits = {name: split for split in ("train", "test") for name in lists[split]}
        twice = sorted(set(lists["train"]) & set(lists["test"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f'split file {path}: expected JSON {{"train": [scene ids], "test": [scene ids]}} '
            f"({type(error).__name__}: {error})"
        ) from error
    if twice:
        raise InputError(f"split file {path}: {', '.join(twice[:5])} is in both train and test")
    return splits
