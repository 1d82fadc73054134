"""Names of files as names of objects: in signs that a terminal, JSON and HDF5 take."""

from __future__ import annotations

import os


def printable(name: str) -> str:
    r"""The name with each byte that is no UTF-8 and each unprintable sign written as in ``\xe9``.

    What a file system calls a file may be any bytes; Python hands those that are no text on as
    surrogates, which neither a terminal nor HDF5 takes.
    """
    text = os.fsencode(name).decode("utf-8", "backslashreplace")
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
