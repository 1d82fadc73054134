"""Which rows train, which validate, which are tested: functions of names, not of row order."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.seeding import generator


def split_by_object(
    object_ids: Sequence[str] | NDArray[np.str_],
    labels: NDArray,
    class_names: Sequence[str],
    validation_fraction: float,
    seed: int = 0,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of the training objects and of the validation objects, both ascending.

    Of each class, the nearest whole number to ``validation_fraction`` of its objects validate,
    but at least one object trains. All views of an object go the same way.

    Args:
        object_ids: (M,) one per row.
        labels: (M,) class index per row.
        seed: another seed holds out other objects.
    """
    names = np.asarray(object_ids, dtype=str)
    labels = np.asarray(labels)
    if names.shape != labels.shape or labels.ndim != 1:
        raise ValueError(f"got {names.shape} object ids for labels of shape {labels.shape}")
    held_out: list[NDArray] = []
    for label in np.unique(labels):
        objects = np.unique(names[labels == label])
        rng = generator(seed, "validation", class_names[int(label)])
        count = min(round(validation_fraction * len(objects)), len(objects) - 1)
        held_out.append(rng.permutation(objects)[:count])
    validates = np.isin(names, np.concatenate(held_out)) if held_out else np.zeros(0, bool)
    return np.flatnonzero(~validates), np.flatnonzero(validates)


def balanced_subset(
    rows: NDArray[np.int64], labels: NDArray, limit: int | None, seed: int = 0
) -> NDArray[np.int64]:
    """At most ``limit`` of ``rows``, ascending, the classes as evenly as their sizes allow.

    Args:
        rows: (m,) row numbers.
        labels: (M,) class index of every row of the data set, indexed by ``rows``.
        limit: None keeps all.
    """
    if limit is None or len(rows) <= limit:
        return rows
    order = generator(seed, "subset").permutation(len(rows))
    shuffled = rows[order]
    classes = np.asarray(labels)[shuffled]
    # A row's rank within its class: taking the lowest ranks first fills all classes alike.
    by_class = np.argsort(classes, kind="stable")
    counts = np.bincount(classes)
    starts = np.repeat(np.cumsum(counts) - counts, counts)
    rank = np.empty_like(by_class)
    rank[by_class] = np.arange(len(rows)) - starts
    return np.sort(shuffled[np.argsort(rank, kind="stable")[:limit]])
