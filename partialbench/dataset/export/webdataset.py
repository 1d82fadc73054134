"""WebDataset: a tar file a shard, a few small files a row.

A sample "train-00001-000042" has ``.points.npy``, ``.cls`` (the label), ``.json`` (all the rest)
and where they are there ``.normals.npy`` and ``.depth.npy``. ``webdataset`` decodes them::

    webdataset.WebDataset("train-{00000..00011}.tar").decode().to_tuple("points.npy", "cls")
"""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from partialbench.dataset import card, croissant
from partialbench.dataset.export.parts import Done, Origin, Part
from partialbench.dataset.manifest import ShardEntry
from partialbench.dataset.shards import Columns

ARRAYS = ("points", "normals", "depth")


def parts(origin: Origin) -> list[Part]:
    """A part a shard: train-00000.tar."""
    return [
        Part(f"{split}-{number:05d}.tar", entry.rows, partial(_write, origin, entry, number))
        for split in origin.manifest.splits()
        for number, entry in enumerate(origin.shards(split))
    ]


def finish(origin: Origin, done: list[Done]) -> dict[str, bytes]:
    """The card and croissant.json."""
    manifest = origin.manifest
    patterns = {split: f"{split}-*.tar" for split in manifest.splits()}
    files = [croissant.File(one.name, croissant.TAR, one.bytes, one.sha256) for one in done]
    return {
        "README.md": card.card_text(origin.folder, manifest, patterns).encode(),
        croissant.NAME: croissant.text(manifest, files).encode(),
    }


def _write(origin: Origin, entry: ShardEntry, number: int, path: Path) -> None:
    columns = origin.columns(entry)
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as tar:
        for name, content in _members(
            columns, f"{entry.split}-{number:05d}", origin.manifest.class_names
        ):
            member = tarfile.TarInfo(name)
            member.size, member.mode = len(content), 0o644
            tar.addfile(member, io.BytesIO(content))


def _members(columns: Columns, prefix: str, class_names: list[str]) -> Iterator[tuple[str, bytes]]:
    rest = {name: values for name, values in columns.items() if name not in ARRAYS}
    for row, label in enumerate(columns["label"]):
        key = f"{prefix}-{row:06d}"
        data = {name: _plain(values[row]) for name, values in rest.items()}
        data["class_name"] = class_names[label]
        yield f"{key}.cls", str(label).encode()
        yield f"{key}.json", json.dumps(data).encode()
        for name in ARRAYS:
            if name in columns:
                yield f"{key}.{name}.npy", _npy(columns[name][row])


def _plain(value: Any) -> Any:
    """As JSON: text for bytes, hexadecimal for a digest, numbers that read back to the bit."""
    if isinstance(value, bytes):
        return value.decode()
    if isinstance(value, np.ndarray) and value.dtype == np.uint8:
        return value.tobytes().hex()
    return value.tolist() if value.dtype != np.float32 else float(value)


def _npy(array: NDArray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()
