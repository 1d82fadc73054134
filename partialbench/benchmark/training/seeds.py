"""Seeds of the generators that a model may draw from: torch's, and NumPy's and Python's own."""

from __future__ import annotations

import contextlib
import random
from collections.abc import Iterator

import numpy as np
import torch


def seed_all(seed: int) -> None:
    """Seeds all of them. A model that initialises its weights with NumPy is then repeatable too."""
    torch.manual_seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002, a user's model may draw from it
    random.seed(seed)


@contextlib.contextmanager
def kept() -> Iterator[None]:
    """Whatever is drawn in the block, all generators are afterwards as they were."""
    python, numpy = random.getstate(), np.random.get_state()  # noqa: NPY002
    devices = range(torch.cuda.device_count()) if torch.cuda.is_initialized() else ()
    with torch.random.fork_rng(devices):
        try:
            yield
        finally:
            random.setstate(python)
            np.random.set_state(numpy)  # noqa: NPY002
