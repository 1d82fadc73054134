"""A training's folder is worked on by one process at a time."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from partialbench.dataset.lock import sole_user


@contextlib.contextmanager
def hold(folder: Path, first: bool = True) -> Iterator[None]:
    """Makes the folder and holds it while the block runs, as ``dataset.lock.sole_user`` does.

    Of several processes of one training, the ``first`` does.
    """
    if not first:
        yield
        return
    instead = "choose another --results folder or other seeds"
    with sole_user(folder, "working on", instead):
        yield
