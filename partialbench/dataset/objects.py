"""``objects.jsonl``: the objects of a data folder, one line each, beside the shards.

A shard holds rows and nothing else, so that any HDF5 reader opens it. What is known once an object
stands here: its whole name, and the digest of what it was made from. The manifest records the
digest of each shard's lines; a shard whose lines are gone is made anew with them.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from partialbench.dataset.names import printable
from partialbench.dataset.schema import OBJECT_ID_BYTES
from partialbench.dataset.shards import write_atomically
from partialbench.errors import InputError

NAME = "objects.jsonl"
_HASH_DIGITS = 16
_NUMBER = re.compile(r"\d+(?:[.,]\d+)*(?:e[+-]?\d+)?")


@dataclass(frozen=True)
class ObjectLine:
    """One object that gave rows.

    Attributes:
        split, shard: where its rows are; ``shard`` is a file name.
        object_id: as in the rows.
        name: the source's whole name for it, of any length.
        source_sha256: digest of the bytes it was made from.
        notices: what else its file holds and what became of it, a sentence each.
    """

    split: str
    shard: str
    object_id: str
    name: str
    source_sha256: str
    notices: Sequence[str] = ()


def stored_id(name: str) -> bytes:
    """What a row holds of a source's name for an object: UTF-8, at most ``OBJECT_ID_BYTES``.

    A name that does not fit, or is no valid text (bytes of a file name that are not UTF-8), ends in
    "~" and digits of its SHA-256 instead, so that two names never become one.
    """
    exact = name.encode("utf-8", "surrogateescape")
    fits = len(exact) <= OBJECT_ID_BYTES and not any("\ud800" <= c <= "\udfff" for c in name)
    # HDF5's fixed strings end at a NUL.
    if fits and "\0" not in name:
        return exact
    mark = "~" + hashlib.sha256(exact).hexdigest()[:_HASH_DIGITS]
    readable = exact.decode("utf-8", "replace").replace("\0", "\ufffd").encode()
    kept = readable[: OBJECT_ID_BYTES - len(mark)].decode("utf-8", "ignore")
    return (kept + mark).encode()


def as_text(lines: Iterable[ObjectLine]) -> str:
    """JSON lines, ASCII."""
    return "".join(json.dumps(asdict(line), sort_keys=True) + "\n" for line in lines)


def text_digest(text: str) -> str:
    """SHA-256 (hex) of some lines of the table, as the manifest records it."""
    return hashlib.sha256(text.encode()).hexdigest()


def load(folder: Path) -> dict[str, str]:
    """Shard file → its lines as text, in the table's order; empty where there is no table.

    Raises:
        InputError: a line is no JSON object with a shard.
    """
    path = folder / NAME
    if not path.is_file():
        return {}
    found: dict[str, str] = {}
    try:
        for line in path.read_text("ascii").splitlines(keepends=True):
            shard = json.loads(line)["shard"]
            if not isinstance(shard, str):
                raise TypeError(f"shard is {shard!r}")
            found[shard] = found.get(shard, "") + line
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(f"{path} is damaged ({type(error).__name__}: {error})") from error
    return found


def parse(text: str, where: Path) -> list[ObjectLine]:
    """The objects in some lines of the table; ``InputError`` where a line is no such object."""
    try:
        lines = [ObjectLine(**json.loads(line)) for line in text.splitlines()]
    except (ValueError, TypeError) as error:
        raise InputError(f"{where} is damaged ({type(error).__name__}: {error})") from error
    for line in lines:
        *texts, notices = asdict(line).values()
        if not (isinstance(notices, list | tuple) and _are_text([*texts, *notices])):
            raise InputError(f"{where} is damaged: {line} holds something that is no text")
    return lines


def _are_text(values: Iterable[object]) -> bool:
    return all(isinstance(value, str) for value in values)


def notice_lines(folder: Path) -> list[str]:
    """What the sources said of a folder's objects, alike sentences together, the commonest first.

    As "12 objects (the first: mug/a): 3 lines are no surface and were left out". Sentences are
    alike where they differ in their numbers only; the first object's stands for all.
    """
    kinds: dict[str, tuple[str, str]] = {}
    times: Counter[str] = Counter()
    for text in load(folder).values():
        for line in parse(text, folder / NAME):
            for notice in line.notices:
                kind = _NUMBER.sub("n", notice)
                kinds.setdefault(kind, (line.object_id, notice))
                times[kind] += 1
    return [
        f"{count:,} object{'s' if count > 1 else ''} (the first: {printable(kinds[kind][0])}): "
        f"{kinds[kind][1]}"
        for kind, count in times.most_common()
    ]


def save(folder: Path, texts: Iterable[str]) -> None:
    """Write the table atomically."""
    write_atomically(folder / NAME, "".join(texts).encode("ascii"))
