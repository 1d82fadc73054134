"""What an export is made of: parts that are whole under their names, and their origin."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from numpy.typing import NDArray

from partialbench.dataset.manifest import Manifest, ShardEntry
from partialbench.dataset.schema import FIELDS
from partialbench.dataset.shards import Columns, file_sha256, open_shard, read_columns
from partialbench.dataset.sources import Source
from partialbench.errors import InputError


@dataclass(frozen=True)
class Origin:
    """The complete data folder that is exported.

    Attributes:
        source: what it was made from, where that is at hand and asked for.
    """

    folder: Path
    manifest: Manifest
    source: Source | None = None

    def shards(self, split: str) -> list[ShardEntry]:
        """The shards of a split that have rows, in order."""
        return [entry for entry in self.manifest.shards if entry.split == split and entry.rows]

    def columns(self, entry: ShardEntry) -> Columns:
        """Every field that a shard holds, in memory.

        Raises:
            InputError: its bytes are not those that the manifest lists.
        """
        path = self.folder / entry.file
        if not path.is_file() or file_sha256(path) != entry.sha256:
            raise InputError(
                f"{path} is not the file its manifest lists; 'partialbench verify {self.folder}' "
                f"tells what differs"
            )
        with open_shard(path) as file:
            return {field.name: file[field.name][()] for field in FIELDS if field.name in file}

    def column(self, entry: ShardEntry, name: str) -> NDArray:
        """One small field of a shard, whose bytes are checked where its rows are exported."""
        return read_columns(self.folder / entry.file, [name])[name]


@dataclass(frozen=True)
class Part:
    """One file, or one folder of files, of an export.

    Attributes:
        name: path within the export, with "/".
        rows: of the data folder that it holds.
        write: makes it at a path that does not exist yet.
    """

    name: str
    rows: int
    write: Callable[[Path], None]


@dataclass(frozen=True)
class Done:
    """A part that is finished: its size in bytes and digest, as ``digest_of`` has them."""

    name: str
    rows: int
    bytes: int
    sha256: str


def digest_of(path: Path) -> tuple[int, str]:
    """Bytes and SHA-256 (hex) of a file; of a folder over its files' names and digests, sorted."""
    if not path.is_dir():
        return path.stat().st_size, file_sha256(path)
    whole, size = hashlib.sha256(), 0
    for file in sorted(p for p in path.rglob("*") if p.is_file()):
        whole.update(f"{file.relative_to(path).as_posix()}\0{file_sha256(file)}\n".encode())
        size += file.stat().st_size
    return size, whole.hexdigest()
