"""Lists of names beside a tree that are its official splits: ``modelnet40_train.txt``, say."""

from __future__ import annotations

import json
import re
from collections import defaultdict
from dataclasses import dataclass, field, replace
from pathlib import PurePosixPath

from partialbench.dataset.cloud_formats.text import decode, looks_like_points
from partialbench.errors import InputError
from renderers.sources.files import HEAD, Files
from renderers.sources.layout import Entry, Layout, split_name

_LIST = re.compile(
    r"(?:(?P<set>.*?)[_\-.])?(?P<split>train|training|test|testing|val|valid|validation)"
    r"(?:[_\-.](?:file|files|list|lists|split|ids?|objects?|models?|names?))*\.(?:txt|lst|json)",
    re.IGNORECASE,
)
_SPLITS = re.compile(r"(?:.*[_\-.])?splits?\.json", re.IGNORECASE)
"""What a file of all splits is called."""
_TABLE = re.compile(r"\.(?:csv|tsv)$", re.IGNORECASE)


@dataclass
class _Lists:
    """The lists of one set ("modelnet40") in one folder, and what they name.

    Attributes:
        folder: whose objects they name.
        index: how such an object may be called → the objects that may be called so.
        categories: of all objects, in small letters.
    """

    folder: str
    index: dict[str, list[Entry]]
    categories: set[str]
    files: list[str] = field(default_factory=list)
    split_of: dict[str, tuple[str, str]] = field(default_factory=dict)  # location → split, list
    absent: list[tuple[str, str]] = field(default_factory=list)  # list, name


def is_list(name: str) -> bool:
    """Whether a file's name is that of a list of one split's objects."""
    return _LIST.fullmatch(PurePosixPath(name).name) is not None


def _is_table(name: str) -> bool:
    """Whether a table is called as a list of one split's objects, or of all, is called."""
    if not _TABLE.search(name):
        return False
    return is_list(_TABLE.sub(".txt", name)) or bool(_SPLITS.fullmatch(_TABLE.sub(".json", name)))


def apply_lists(files: Files, layout: Layout) -> None:
    """Give a layout's objects the splits that lists beside them say.

    Only objects that lie in no split's folder are looked for. Of several sets in one folder the one
    that names most of them is taken. An object that no list names is left out, as is a name that no
    file gives, a list that cannot be read, and where none is taken one that names no object and a
    table that is called as lists are.

    Raises:
        InputError: an object in two splits, or a name that fits several objects.
    """
    entries = [entry for entry in layout.entries if not entry.split]
    if not entries:
        return
    candidates: dict[tuple[str, str], _Lists] = {}
    tables = []
    for name in files.names():
        base = PurePosixPath(name).name
        if _is_table(base) and not looks_like_points(files.head(name, HEAD)):
            tables.append(name)
        match = _LIST.fullmatch(base)
        if not (match or _SPLITS.fullmatch(base)) or looks_like_points(files.head(name, HEAD)):
            continue
        split, of_set = (match["split"], match["set"] or "") if match else ("", "")
        try:
            found = _lists_in(name, split_name(split), files.read(name))
        except ValueError as error:
            layout.left_out.append((name, f"is called as a list is, but cannot be read ({error})"))
            continue
        key = str(PurePosixPath(name).parent), of_set.casefold()
        for split, names in found:
            if key not in candidates:
                candidates[key] = _lists_beside(name, entries)
            _match(candidates[key], name, split, names)
    best: dict[str, _Lists] = {}
    for lists in candidates.values():
        if len(lists.split_of) > len(best[lists.folder].split_of if lists.folder in best else ()):
            best[lists.folder] = lists
    if not best:
        # A split that somebody made is not replaced by ours without a word.
        reason = "is called as a list of a split is, but names no object that is here"
        layout.left_out += [(name, reason) for lists in candidates.values() for name in lists.files]
        reason = (
            "is called as a list of splits is, but no table is read; write a name a line in .txt"
        )
        layout.left_out += [(name, reason) for name in tables]
        return
    _use(list(best.values()), layout)


def _lists_beside(name: str, entries: list[Entry]) -> _Lists:
    """Of the set that a list's file belongs to, before any is read."""
    folder = _folder_of(name, entries)
    index: dict[str, list[Entry]] = defaultdict(list)
    for entry in entries:
        if entry.location.startswith(folder):
            path = entry.location
            bare = path[: len(path) - len(PurePosixPath(path).suffix)]
            own = entry.name
            for key in {path, bare, f"{entry.category}/{own}", own, str(PurePosixPath(bare).name)}:
                index[key].append(entry)
    return _Lists(folder, index, {entry.category.casefold() for entry in entries})


def _folder_of(name: str, entries: list[Entry]) -> str:
    """The folder whose objects a list names: its own, or the nearest above it that holds any.

    ShapeNet's lists lie in a folder of their own beside the classes, ``train_test_split``.
    """
    folder = f"{PurePosixPath(name).parent}/".removeprefix("./")
    while folder and not any(entry.location.startswith(folder) for entry in entries):
        folder = folder.rstrip("/").rpartition("/")[0]
        folder += "/" if folder else ""
    return folder


def _match(lists: _Lists, name: str, split: str, lines: list[str]) -> None:
    if name not in lists.files:
        lists.files.append(name)
    for line in lines:
        found, before = _find(line, lists.index, lists.categories)
        places = {(e.category, e.name) for e in found}
        if len(places) > 1 and not any(part not in (".", "..") for part in before):
            said = ", ".join(sorted(f"{c}/{n}" for c, n in places)[:3])
            raise InputError(f"{name}: {line!r} may be {said}; write the class before it")
        if len(places) != 1:  # also where it is of a class that is not here
            lists.absent.append((name, line))
            continue
        for entry in found:
            earlier, where = lists.split_of.get(entry.location, (split, name))
            if earlier != split:
                raise InputError(
                    f"{name}: {line!r} is in the split {split!r}, but {where} has it in {earlier!r}"
                )
            lists.split_of[entry.location] = split, name


def _lists_in(name: str, split: str, content: bytes) -> list[tuple[str, list[str]]]:
    """The splits in a file and their names: one a line, or JSON.

    JSON is [names] or {class: [names]}, or {split: one of these}. ``split`` is what the file's name
    says, "" for nothing.

    Raises:
        ValueError: the file is broken.
    """
    if name.lower().endswith(".json"):
        data = json.loads(content)
        if isinstance(data, dict) and data and all(map(split_name, data)):
            return [(split_name(key), _names(value)) for key, value in data.items()]
        return [(split, _names(data))] if split else []
    lines = [line.strip() for line in decode(content).splitlines() if not line.startswith("#")]
    return [(split, [bare for line in lines if (bare := line.strip("\"'"))])]


def _names(data: object) -> list[str]:
    if isinstance(data, dict):
        return [f"{key}/{name}" for key, names in data.items() for name in _names(names)]
    return [item for item in data if isinstance(item, str)] if isinstance(data, list) else []


def _find(
    line: str, index: dict[str, list[Entry]], categories: set[str]
) -> tuple[list[Entry], list[str]]:
    """The entries of the longest end of a path that is known, with or without its suffix; and the
    folders before that end. If these name a class, whatever its capitals, they are of that one."""
    for text in (line, re.split(r"[\s,;]", line, maxsplit=1)[0]):
        parts = text.replace("\\", "/").strip("/").split("/")
        for at in range(len(parts)):
            key = "/".join(parts[at:])
            said = [part.casefold() for part in parts[:at] if part.casefold() in categories]
            for form in (key, re.sub(r"\.[^./]+$", "", key)):
                found = index.get(form, [])
                if said:
                    found = [entry for entry in found if entry.category.casefold() == said[-1]]
                if found:
                    return found, parts[:at]
    return [], []


def _use(chosen: list[_Lists], layout: Layout) -> None:
    splits = {place: said for lists in chosen for place, said in lists.split_of.items()}
    used = sorted(
        {where for _, where in splits.values()} | {name for c in chosen for name, _ in c.absent}
    )
    has_test = any(split == "test" for split, _ in splits.values())
    entries = []
    for entry in layout.entries:
        covered = any(entry.location.startswith(lists.folder) for lists in chosen)
        if entry.split or not covered:
            entries.append(entry)
        elif entry.location in splits:
            split = splits[entry.location][0]
            split = split if split != "val" else ("train" if has_test else "test")
            entries.append(replace(entry, split=split))
        else:
            layout.left_out.append((entry.location, f"is in none of {', '.join(used)}"))
    layout.entries = entries
    for lists in chosen:
        for name, line in lists.absent:
            layout.left_out.append((name, f"names {line!r}, which no file gives"))
    layout.notes.append(f"splits from {', '.join(used)}")
    if any(split == "val" for split, _ in splits.values()):
        layout.notes.append(
            "validation objects " + ("join the training objects" if has_test else "are the test")
        )
