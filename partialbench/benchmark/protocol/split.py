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
    source_digests: Sequence[str] | NDArray[np.str_] | None = None,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of the training objects and of the validation objects, both ascending.

    Of each class, the nearest whole number to ``validation_fraction`` of its objects validate,
    but at least one object trains. All views of an object go the same way, and so do objects made
    from the same bytes, whatever they are called: as many of them together as come nearest to the
    number. Objects of different classes made from the same bytes train.

    Args:
        object_ids: (M,) one per row.
        labels: (M,) class index per row.
        seed: another seed holds out other objects.
        source_digests: (M,) of what each row's object was made from, "" where it is not known.
    """
    names = np.asarray(object_ids, dtype=str)
    labels = np.asarray(labels)
    if names.shape != labels.shape or labels.ndim != 1:
        raise ValueError(f"got {names.shape} object ids for labels of shape {labels.shape}")
    twins = _twins(names, source_digests)
    held_out: list[str] = []
    for label in np.unique(labels):
        objects = np.unique(names[labels == label])
        rng = generator(seed, "validation", class_names[int(label)])
        count = min(round(validation_fraction * len(objects)), len(objects) - 1)
        chosen: set[str] = set()
        for name in map(str, rng.permutation(objects)):
            together = twins.get(name, {name})
            more = len(chosen) + len(together)
            nearer = more - count <= count - len(chosen)
            if name in chosen or not together <= set(map(str, objects)):
                continue
            if nearer and more < len(objects):
                chosen |= together
        held_out += chosen
    validates = np.isin(names, held_out) if held_out else np.zeros(len(names), bool)
    return np.flatnonzero(~validates), np.flatnonzero(validates)


def _twins(
    names: NDArray[np.str_], source_digests: Sequence[str] | NDArray[np.str_] | None
) -> dict[str, set[str]]:
    """Object → all objects made from the same bytes, for those that are not the only one."""
    if source_digests is None:
        return {}
    made_from: dict[str, set[str]] = {}
    for name, digest in zip(names, np.asarray(source_digests, dtype=str), strict=True):
        if digest:
            made_from.setdefault(str(digest), set()).add(str(name))
    return {name: group for group in made_from.values() if len(group) > 1 for name in group}


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
