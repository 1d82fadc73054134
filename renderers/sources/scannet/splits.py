"""Which scans are for training: by lists, or by the name of the place."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from partialbench.errors import InputError

TRAIN_SHARE = 0.8
_LISTS = {"train": "train", "val": "test", "test": "test"}
"""What a list is called → the split its scenes are in. ScanNet's test scans have no annotations;
what is tested on are its validation scans."""


def space_of(scene_id: str) -> str:
    """The place a scan was taken in: rescans "scene0470_00" and "scene0470_01" share one."""
    return re.sub(r"_\d\d$", "", scene_id)


def split_by_hash(space: str) -> str:
    """ "train" for four of five space ids, by their digest, else "test"."""
    digest = hashlib.sha256(space.encode()).digest()
    return "train" if int.from_bytes(digest[:8], "big") < TRAIN_SHARE * 2**64 else "test"


def read_split_files(paths: Iterable[Path]) -> dict[str, str]:
    """Scene or space id → split, from JSON or from ScanNet's own text lists.

    Args:
        paths: JSON files {"train": [ids], "val" or "test": [ids]}; text files of one id a line,
            named after their list: ``scannetv2_train.txt``, ``scannetv2_val.txt``; folders of such
            text files.

    Raises:
        InputError: one is none of these, or a space is in both splits.
    """
    members: dict[str, dict[str, Path]] = {"train": {}, "test": {}}
    for path in paths:
        for split, ids, where in _lists_of(Path(path)):
            members[split] |= dict.fromkeys(ids, where)
    spaces = {split: {space_of(i): i for i in sorted(ids)} for split, ids in members.items()}
    if twice := sorted(spaces["train"].keys() & spaces["test"].keys()):
        first = [f"{spaces['train'][s]} and {spaces['test'][s]}" for s in twice[:3]]
        more = f" and {len(twice) - 3} more" if len(twice) > 3 else ""
        raise InputError(
            f"split file {', '.join(str(p) for p in paths)}: {'; '.join(first)}{more}: the scans "
            f"of one space would be in both train and test; put them into one"
        )
    return {name: split for split, ids in members.items() for name in ids}


def _lists_of(path: Path) -> list[tuple[str, list[str], Path]]:
    """(split, ids, file) of every list at a path."""
    if path.is_dir():
        files = sorted(p for p in path.glob("*.txt") if _named_after(p))
        if not files:
            raise InputError(f"split folder {path} holds no list like scannetv2_train.txt")
        return [found for file in files for found in _lists_of(file)]
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"split file {path} cannot be read: {error}") from error
    if text.lstrip()[:1] in ("{", "[", '"'):
        return [(split, ids, path) for split, ids in _json_lists(path, text)]
    split = _named_after(path)
    if not split:
        raise InputError(
            f"split file {path}: a text list must say in its name whether it is of train, val or "
            f'test, as scannetv2_train.txt does; or give JSON {{"train": [ids], "test": [ids]}}'
        )
    ids = text.split("\n")
    return [(split, _checked([line.strip() for line in ids if line.strip()], split, path), path)]


def _named_after(path: Path) -> str:
    """The split that a text list's name tells, or ""."""
    words = set(re.split(r"[^a-z]+", path.stem.lower()))
    found = {_LISTS[word] for word in words & _LISTS.keys()}
    return found.pop() if len(found) == 1 else ""


def _json_lists(path: Path, text: str) -> list[tuple[str, list[str]]]:
    expected = f'split file {path}: expected JSON {{"train": [scene ids], "test": [scene ids]}}'

    def no_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len(dict(pairs)) < len(pairs):
            raise ValueError("a list is there twice")
        return dict(pairs)

    try:
        lists = json.loads(text, object_pairs_hook=no_duplicates)
    except ValueError as error:
        raise InputError(f"{expected} ({error})") from error
    if not isinstance(lists, dict) or not lists.keys() & _LISTS.keys():
        raise InputError(f"{expected}, got {text.strip()[:60]}")
    if unknown := sorted(lists.keys() - _LISTS.keys()):
        raise InputError(f"{expected}; what is {unknown[0]!r}?")
    return [(_LISTS[name], _checked(ids, name, path)) for name, ids in lists.items()]


def _checked(ids: Any, name: str, path: Path) -> list[str]:
    if not isinstance(ids, list):
        raise InputError(
            f"split file {path}: {name!r} is {json.dumps(ids)[:60]}, expected a list of scene ids"
        )
    for scene_id in ids:
        # A path or a file's name would fit no scene, and its scan be in neither split.
        if not isinstance(scene_id, str) or not re.fullmatch(r"[\w\-]+", scene_id):
            raise InputError(
                f"split file {path}: {name!r} holds {json.dumps(scene_id)[:60]}, expected scene "
                f"ids like scene0470_00, or spaces like scene0470"
            )
    return ids
