"""Named arrays as the bytes of an ``.npz`` that depend on the arrays alone, and back."""

from __future__ import annotations

import hashlib
import io
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from partialbench.errors import InputError

LARGEST_MEMBER = 2**28
"""Bytes. A damaged length must not ask for all the memory there is."""
_UNREADABLE = (
    OSError, KeyError, ValueError, EOFError, SyntaxError, TypeError, RuntimeError, MemoryError,
    OverflowError, NotImplementedError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""What Python's zip and NumPy's header readers raise where bytes are not what they should be."""


def to_bytes(arrays: Mapping[str, NDArray]) -> bytes:
    """A compressed .npz, column by column, in which neighbours are alike."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, values in arrays.items():
            array = io.BytesIO()
            np.lib.format.write_array(array, np.asfortranarray(values), allow_pickle=False)
            # A fixed time: numpy.savez would write the clock into the bytes.
            info = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            info.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(info, array.getvalue())
    return buffer.getvalue()


def from_bytes(data: bytes, names: Iterable[str], path: Path, what: str) -> dict[str, NDArray]:
    """The arrays of these names; ``path`` and ``what`` ("a prediction file") are for the sentence.

    Raises:
        InputError: not an archive of exactly these arrays.
    """
    wanted = list(names)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {info.filename: info for info in archive.infolist()}
            if sorted(members) != sorted(f"{name}.npy" for name in wanted):
                raise InputError(
                    f"{path} is not {what}: it holds {', '.join(sorted(members)) or 'nothing'}; "
                    f"expected {', '.join(wanted)}"
                )
            found = {}
            for name in wanted:
                info = members[f"{name}.npy"]
                if info.file_size > LARGEST_MEMBER:
                    raise ValueError(f"{name} would have {info.file_size} bytes")
                content = io.BytesIO(archive.read(info))
                found[name] = np.ascontiguousarray(
                    np.lib.format.read_array(content, allow_pickle=False)
                )
            return found
    except _UNREADABLE as error:
        raise InputError(f"{path} is not {what}: {error}") from error


def content_digest(arrays: Mapping[str, NDArray]) -> str:
    """SHA-256 (hex) of names, types, shapes and values, however they are compressed."""
    whole = hashlib.sha256()
    for name, values in arrays.items():
        whole.update(f"{name} {values.dtype.str} {values.shape}\n".encode())
        whole.update(np.ascontiguousarray(values).tobytes())
    return whole.hexdigest()
