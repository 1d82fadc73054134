"""Parquet: a file a shard, every field of a row a column, bit for bit.

Points are fixed-size lists of fixed-size lists, (P,3) of float32: ``datasets``, pandas, Polars and
DuckDB read them as such. README.md is the card that the Hugging Face hub shows, with the splits.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from partialbench import extras
from partialbench.dataset import card, croissant
from partialbench.dataset.export.parts import Done, Origin, Part
from partialbench.dataset.manifest import ShardEntry
from partialbench.dataset.schema import FIELDS
from partialbench.dataset.shards import Columns

if TYPE_CHECKING:
    import pyarrow

ROWS_PER_GROUP = 1000


def parts(origin: Origin) -> list[Part]:
    """A part a shard: data/train-00000-of-00012.parquet."""
    extras.load("pyarrow.parquet")
    found = []
    for split in origin.manifest.splits():
        shards = origin.shards(split)
        for number, entry in enumerate(shards):
            name = f"data/{split}-{number:05d}-of-{len(shards):05d}.parquet"
            found.append(Part(name, entry.rows, partial(_write, origin, entry)))
    return found


def finish(origin: Origin, done: list[Done]) -> dict[str, bytes]:
    """The card, with front matter that names the splits' files, and croissant.json."""
    manifest = origin.manifest
    patterns = {split: f"data/{split}-*.parquet" for split in manifest.splits()}
    files = [croissant.File(one.name, croissant.PARQUET, one.bytes, one.sha256) for one in done]
    return {
        "README.md": card.card_text(origin.folder, manifest, patterns).encode(),
        croissant.NAME: croissant.text(manifest, files, patterns, table_fields(origin)).encode(),
    }


def table_fields(origin: Origin) -> list[tuple[str, np.dtype, tuple[int, ...], str]]:
    """(name, dtype, shape of an entry, meaning) of every column, from the first shard."""
    entry = next(entry for entry in origin.manifest.shards if entry.rows)
    columns, known = origin.columns(entry), {field.name: field for field in FIELDS}
    return [
        *((n, c.dtype, c.shape[1:], known[n].meaning) for n, c in columns.items()),
        ("class_name", np.dtype("S"), (), "of the label"),
    ]


def _write(origin: Origin, entry: ShardEntry, path: Path) -> None:
    parquet = extras.load("pyarrow.parquet")
    columns = origin.columns(entry)
    table = as_table(columns, origin.manifest.class_names)
    # Opened here: Arrow takes no path that is not UTF-8, as one is under the locale C.
    with open(path, "wb") as file:
        parquet.write_table(
            table,
            file,
            # Coordinates do not compress; images do, by a lot.
            compression="zstd" if "depth" in columns else "none",
            use_dictionary=["class_name", "symmetry"],
            write_statistics=False,
            row_group_size=ROWS_PER_GROUP,
        )


def as_table(columns: Columns, class_names: list[str]) -> pyarrow.Table:
    """A shard's columns as Arrow has them, and the labels' names."""
    arrow = extras.load("pyarrow")
    arrays = {name: _as_array(values) for name, values in columns.items()}
    names = arrow.array(class_names, arrow.string())
    arrays["class_name"] = names.take(arrow.array(columns["label"]))
    schema = arrow.schema(
        [arrow.field(name, array.type, nullable=False) for name, array in arrays.items()]
    )
    return arrow.table(list(arrays.values()), schema=schema)


def _as_array(values: NDArray) -> pyarrow.Array:
    arrow = extras.load("pyarrow")
    if values.dtype.kind == "S":
        return arrow.array(np.char.decode(values, "utf-8").tolist(), arrow.string())
    if values.dtype == np.uint8:  # a digest
        return arrow.array([row.tobytes() for row in values], arrow.binary())
    array = arrow.array(np.ascontiguousarray(values).reshape(-1))
    for size in reversed(values.shape[1:]):
        item = arrow.field("item", array.type, nullable=False)
        array = arrow.FixedSizeListArray.from_arrays(array, type=arrow.list_(item, size))
    return array
