"""Counter-based randomness: every draw is keyed by what it is for, never by when it happens.

A generator depends only on its key, so output is bit-identical for any number of workers, any
shard size and any interruption. Seed 0 is a seed like any other.
"""

from __future__ import annotations

import hashlib

import numpy as np


def generator(seed: int, *key: str | int) -> np.random.Generator:
    """A generator for one purpose, e.g. ``generator(0, "pm40", "train", "chair_0001", 3, "pose")``.

    ``key`` parts are joined with their types, so that ``("a", 1)`` and ``("a", "1")`` differ.
    Source of the bits: Philox keyed by BLAKE2b of the key, so neighbouring keys are independent.
    """
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer):
        raise TypeError(f"seed must be an integer, got {seed!r} ({type(seed).__name__})")
    digest = hashlib.blake2b(repr((int(seed), *key)).encode(), digest_size=16).digest()
    return np.random.Generator(np.random.Philox(key=int.from_bytes(digest, "little")))
