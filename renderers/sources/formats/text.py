"""Numbers from the words of a text file, strictly: no word is skipped, cut or taken for 0."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from partialbench.errors import InputError

# NumPy's scanner of whole numbers takes a sign without digits for 0.
_LONE_SIGN = re.compile(rb"[+-](?![0-9])")


def decimals(words: Sequence[bytes], what: str) -> NDArray[np.float64]:
    """The words as float64; ``InputError`` for the first that is no decimal number."""
    return _parsed(words, np.float64, f"{what}; expected a number")


def whole(words: Sequence[bytes], what: str) -> NDArray[np.int64]:
    """The words as int64; ``InputError`` for the first that is no whole number."""
    return _parsed(words, np.int64, f"{what}; expected a whole number")


def _parsed(words: Sequence[bytes], dtype: type, expected: str) -> NDArray:
    found = _from_text(b" ".join(words), dtype)
    if found is not None and len(found) == len(words):
        return found
    for word in words:
        if (one := _from_text(word, dtype)) is None or len(one) != 1:
            raise InputError(f"{word[:40].decode('ascii', 'backslashreplace')!r} is {expected}")
    raise InputError(f"{expected}; found {len(words)} words that are not")


def _from_text(text: bytes, dtype: type) -> NDArray | None:
    """What NumPy's own scanner makes of blank-separated numbers; None where it stops early.

    It takes neither "1_000" nor "0x10" as Python's ``int`` and ``float`` do.
    """
    if not text.strip():
        return np.zeros(0, dtype)
    if dtype is np.int64 and _LONE_SIGN.search(text):
        return None
    with warnings.catch_warnings():
        # NumPy before 2.3 warned where later ones raise.
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.fromstring(text, dtype, sep=" ")
        except (ValueError, DeprecationWarning):
            return None


def unix_lines(content: bytes) -> bytes:
    """The text without a byte order mark, its lines ended by LF whether by CR, CRLF or LF."""
    content = content.removeprefix(b"\xef\xbb\xbf")
    if b"\r" in content:
        content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return content


def shown(words: Sequence[bytes]) -> str:
    """The first words of a line, for an error."""
    return b" ".join(words[:8])[:80].decode("ascii", "backslashreplace")
