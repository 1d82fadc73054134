"""Names of files as ids of objects: printable, and no longer than a shard holds."""

from __future__ import annotations

import hashlib
import os

from partialbench.dataset.schema import OBJECT_ID_BYTES

_DIGITS = 16


def printable(name: str) -> str:
    r"""The name with each byte that is no UTF-8 and each unprintable sign written as in ``\xe9``.

    What a file system calls a file may be any bytes; Python hands those that are no text on as
    surrogates, which neither a terminal nor HDF5 takes.
    """
    text = os.fsencode(name).decode("utf-8", "backslashreplace")
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def object_id(name: str) -> str:
    """The name if it is printable and fits into a shard; else made so, its end by a digest.

    Distinct names give distinct ids.
    """
    shown = printable(name)
    encoded = shown.encode()
    if len(encoded) <= OBJECT_ID_BYTES:
        return shown
    digest = hashlib.sha256(os.fsencode(name)).hexdigest()[:_DIGITS]
    head = encoded[: OBJECT_ID_BYTES - _DIGITS - 1].decode("utf-8", "ignore")
    return f"{head}~{digest}"
