"""Test objects that were made from the very bytes of a training object.

ModelNet40 has such objects across its own split, some under two class names. A model that has seen
one in training is not tested on it, so every record has its scores with and without them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

KEY_DIGITS = 16
"""Hexadecimal digits kept of a digest: 64 bits tell ten thousand objects apart."""


def source_keys(digests: NDArray[np.str_]) -> list[str]:
    """What a checkpoint remembers of its training objects: short digests, each once, sorted.

    Args:
        digests: (M,) SHA-256 (hex) of what each row's object was made from; "" where not known.
    """
    return sorted({str(digest)[:KEY_DIGITS] for digest in np.unique(digests)} - {""})


def among(digests: NDArray[np.str_], keys: list[str]) -> NDArray[np.bool_]:
    """(M,) whether each row's object was made from the same bytes as one of ``source_keys``.

    A row whose source is not known is no duplicate.
    """
    short = np.asarray(digests).astype(f"U{KEY_DIGITS}")
    return np.isin(short, np.array(keys, dtype=f"U{KEY_DIGITS}"))
