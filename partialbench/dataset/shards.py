"""One shard: rows in memory ↔ an HDF5 file whose bytes depend on the rows alone.

Data sets are contiguous and uncompressed, so that a reader can map them into memory; depth images,
when kept, are chunked by row and compressed, by the workers that made them: no process holds a
shard's images as they are. A file is assembled in memory, written to a temporary name, flushed to
disk and renamed: under its final name it is always whole.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import secrets
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.schema import DIGESTED, FIELDS, FORMAT, FORMAT_VERSION, READABLE
from partialbench.errors import InputError, PartialbenchError

Columns = dict[str, NDArray]
"""Field name → (M, …) array with the schema's dtype."""

TEMPORARY_SUFFIX = ".part"
_DEFLATE_LEVEL = 1


@dataclass
class PackedImages:
    """Depth images as a shard stores them: each a chunk, its bytes shuffled and deflated.

    Attributes:
        shape: (H,W) of every image.
        chunks: one per row.
    """

    shape: tuple[int, int]
    chunks: list[bytes]


def pack_image(image: NDArray) -> bytes:
    """An (H,W) image as HDF5's filters "shuffle" and "deflate" would have it."""
    data = np.ascontiguousarray(image, "<f4").view(np.uint8).reshape(-1, 4)
    return zlib.compress(data.T.tobytes(), _DEFLATE_LEVEL)


def concatenate(parts: list[Columns]) -> Columns:
    """Rows of several parts one after the other; every part has the same fields."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def row_digests(columns: Mapping[str, NDArray]) -> NDArray[np.uint8]:
    """(M,32) uint8: SHA-256 of each row's bytes over the digested fields, in schema order."""
    rows = len(columns["label"])
    flat = [
        np.ascontiguousarray(columns[name]).reshape(rows, -1).view(np.uint8).reshape(rows, -1)
        if rows
        else np.zeros((0, 1), np.uint8)
        for name in DIGESTED
    ]
    digests = np.zeros((rows, 32), np.uint8)
    for i in range(rows):
        row = hashlib.sha256()
        for field in flat:
            row.update(field[i].tobytes())
        digests[i] = np.frombuffer(row.digest(), np.uint8)
    return digests


def content_digest(digests: Iterable[NDArray[np.uint8]]) -> str:
    """One hex digest for rows in order, the same however they are cut into shards."""
    whole = hashlib.sha256()
    for part in digests:
        whole.update(np.ascontiguousarray(part).tobytes())
    return whole.hexdigest()


def shard_bytes(
    columns: Columns, attributes: Mapping[str, str | int], depth: PackedImages | None = None
) -> bytes:
    """The bytes of the HDF5 file with these rows; equal rows give equal bytes.

    Args:
        columns: every field but ``depth``.
        depth: its images, let go one by one as they are written.
    """
    image = h5py.File("shard", "w", driver="core", backing_store=False, libver=("v108", "v108"))
    with image:
        image.attrs["format"] = FORMAT
        image.attrs["format_version"] = FORMAT_VERSION
        for name, value in sorted(attributes.items()):
            image.attrs[name] = value
        for field in FIELDS:
            if field.name in columns:
                data = np.ascontiguousarray(columns[field.name], dtype=field.dtype)
                dataset = image.create_dataset(field.name, data=data, track_times=False)
            elif field.name == "depth" and depth is not None:
                dataset = _write_images(image, field.name, depth)
            elif field.optional:
                continue
            else:
                raise ValueError(f"a shard needs the field {field.name!r}")
            dataset.attrs["meaning"] = field.meaning
            dataset.attrs["frame"] = field.frame
            dataset.attrs["unit"] = field.unit
        image.flush()
        return image.id.get_file_image()


def _write_images(file: h5py.File, name: str, images: PackedImages) -> h5py.Dataset:
    chunks = images.chunks
    dataset = file.create_dataset(
        name, (len(chunks), *images.shape), "<f4", chunks=(1, *images.shape), shuffle=True,
        compression="gzip", compression_opts=_DEFLATE_LEVEL, track_times=False,
    )  # fmt: skip
    for i, chunk in enumerate(chunks):
        dataset.id.write_direct_chunk((i, 0, 0), chunk)
        chunks[i] = b""
    return dataset


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file so that it is whole or absent under its name, whatever happens meanwhile.

    Raises:
        PartialbenchError: the system refused (disk full, quota, read-only); the temporary file is
            removed and whatever was at ``path`` is untouched.
    """
    # Two processes may write one file at once: each has a name of its own till it is whole.
    temporary = path.with_name(f".{path.name[:200]}.{secrets.token_hex(6)}{TEMPORARY_SUFFIX}")
    try:
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        with contextlib.suppress(OSError):  # where the folder itself is what is wrong
            temporary.unlink(missing_ok=True)
        raise PartialbenchError(
            f"could not write {path.name} ({len(data) / 2**20:.1f} MiB) in {path.parent}: "
            f"{error.strerror or error}. What was finished before is kept; free some space or fix "
            f"the permission and run the same command again to continue"
        ) from error


def make_folder(folder: Path) -> None:
    """The folder that an --out asked for; ``InputError`` where it cannot be made."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"--out: cannot make the folder {folder}: {error.strerror}; choose another"
        ) from error


def file_sha256(path: Path) -> str:
    """SHA-256 (hex) of a file's bytes."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def open_hdf5(path: Path) -> h5py.File:
    """The file opened for reading, locked if its file system has locks; ``OSError`` as h5py's.

    Not without a lock at once: HDF5 refuses to open a file in two ways in one process, and a
    user's own code may have it open.
    """
    try:
        return h5py.File(path, "r")
    except OSError as error:
        if "unable to lock file" not in str(error):
            raise
        return h5py.File(path, "r", locking=False)


def open_shard(path: Path) -> h5py.File:
    """The file opened for reading; ``InputError`` when it is not a shard of a known version."""
    try:
        file = open_hdf5(path)
    except OSError as error:
        raise InputError(f"{path} is not a readable HDF5 file: {error}") from error
    name, version = file.attrs.get("format"), file.attrs.get("format_version")
    if name != FORMAT or version not in READABLE:
        file.close()
        raise InputError(
            f"{path} has format {name!r} version {version!r}, expected {FORMAT!r} version "
            f"{' or '.join(map(str, READABLE))}; make it again, or read it with the release that "
            f"made it"
        )
    return file


def read_columns(path: Path, names: Iterable[str] | None = None) -> Columns:
    """The named fields (default: all that are not optional) of one shard, in memory."""
    wanted = [f.name for f in FIELDS if not f.optional] if names is None else list(names)
    with open_shard(path) as file:
        absent = [name for name in wanted if name not in file]
        if absent:
            raise InputError(f"{path} lacks the field(s) {', '.join(absent)}")
        return {name: file[name][()] for name in wanted}
