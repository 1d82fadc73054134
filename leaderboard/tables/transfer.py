"""Transfer on equal terms: the same classes, equally mixed, within a data set and across.

A model trained on 40 classes and tested on the 13 that another data set shares faces another task
than in its own domain: fewer and other classes, in another mix. Here both tests keep the clouds of
the classes that all of it shares, every class weighs the same in both, and the model keeps all its
answers in both. What a row gains over another, within and across, can then be set side by side.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from leaderboard.board import Cell, Column, ranked
from leaderboard.comparison import counted
from leaderboard.tables.layouts import Layout
from leaderboard.words import difference, row_title
from partialbench.benchmark.records.results import Result
from partialbench.benchmark.testing.uncertainty import bootstrap_means
from partialbench.errors import InputError

Bounded = tuple[float, float, float]
"""A mean and the bounds of its 95 % interval, by bootstrap over the objects of each class."""


class EqualTerms(NamedTuple):
    """One row within its data set and across, on the classes both share.

    Attributes:
        within, across: mean over the classes of the share of their clouds that are right.
        drop: of ``across`` below ``within``; the two test sets are independent.
    """

    within: Bounded
    across: Bounded
    drop: Bounded


@dataclass(frozen=True)
class Transfer:
    """A column across data sets beside its model's own, rows best first across.

    Attributes:
        classes: that count, in both.
        rows: row name → its accuracies.
        gains: row name → by how much it exceeds the last row within and across, and by how much
            more across, each paired over test clouds.
    """

    within: Column
    across: Column
    classes: tuple[str, ...]
    rows: dict[str, EqualTerms]
    gains: dict[str, EqualTerms]


def find_transfers(board: list[Column], folder: Path) -> list[Transfer]:
    """Every column across data sets that has its own beside it, with the rows that both have.

    Args:
        folder: of the records, with their predictions.
    """
    own = {
        (*column.key[:3], *column.key[6:]): column
        for column in board
        if column.key[:2] == column.key[3:5]
    }
    found = []
    for across in board:
        within = own.get((*across.key[:3], *across.key[6:]))
        if across.key[0] != across.key[3] and within is not None:
            transfer = equal_terms(within, across, folder)
            if transfer.rows:
                found.append(transfer)
    return found


def equal_terms(within: Column, across: Column, folder: Path) -> Transfer:
    """Both columns' rows on the classes that both test sets have clouds of.

    Only seeds count that were tested within and across.

    Raises:
        InputError: the test sets share no class.
    """
    names = [name for name in ranked(across) if name in within.cells]
    tested = {}
    for name in names:
        cells = within.cells[name], across.cells[name]
        seeds = set.intersection(*({r.seed for r in cell.results} for cell in cells))
        if seeds:
            tested[name] = [_right(cell, seeds, folder) for cell in cells]
    if not tested:
        return Transfer(within, across, (), {}, {})
    truths = [next(iter(tested.values()))[side] for side in (0, 1)]
    shared = np.intersect1d(truths[0].classes, truths[1].classes)
    if not len(shared):
        raise InputError(f"{within.title} and {across.title} share no class")
    # (draws, rows) of each side; the first draw is the data as they are.
    sides = []
    for side in (0, 1):
        values = np.stack([of_row[side].right for of_row in tested.values()], axis=1)
        sides.append(_draws(values, truths[side], shared, side))
    inside, outside = sides
    rows, gains = {}, {}
    for i, name in enumerate(tested):
        rows[name] = EqualTerms(
            _bounded(inside[:, i]), _bounded(outside[:, i]), _bounded(inside[:, i] - outside[:, i])
        )
        ahead = [side[:, i] - side[:, -1] for side in sides]
        gains[name] = EqualTerms(*map(_bounded, (*ahead, ahead[1] - ahead[0])))
    return Transfer(within, across, tuple(shared.tolist()), rows, gains)


class _Right(NamedTuple):
    """Of the counted clouds of a test set: class name, object, and the share of seeds right."""

    classes: NDArray[np.str_]
    object_ids: NDArray[np.str_]
    right: NDArray[np.float64]


def _right(cell: Cell, seeds: set[int], folder: Path) -> _Right:
    results: list[Result] = [r for r in cell.results if r.seed in seeds]
    shares = []
    for result in results:
        predictions, label = counted(result, folder)
        shares.append(predictions.predicted == label)
    names = np.array(results[0].train_data.class_names)[label]
    return _Right(names, predictions.object_ids, np.mean(shares, axis=0))


def _draws(values: NDArray, truth: _Right, shared: NDArray, side: int) -> NDArray[np.float64]:
    """(1 + resamples,R) means over classes of their means over clouds; objects are resampled within
    each class, so that every class keeps its weight. NaN but for the first where a class has one
    object."""
    of_classes = []
    for name in shared:
        rows = truth.classes == name
        drawn = bootstrap_means(values[rows], truth.object_ids[rows], seed=_seed(f"{side}{name}"))
        of_classes.append(np.concatenate([values[rows].mean(axis=0)[None], drawn]))
    return np.mean(of_classes, axis=0)


def _seed(name: str) -> int:
    """Classes of equally many objects, and the two sides, are not to be resampled alike."""
    return int.from_bytes(name.encode()[:6], "big")


def _bounded(draws: NDArray) -> Bounded:
    low, high = np.percentile(draws[1:], [2.5, 97.5])
    return float(draws[0]), float(low), float(high)


def transfer_layouts(board: list[Column], folder: Path) -> list[Layout]:
    """A table for each of ``find_transfers``."""
    return [_as_layout(transfer) for transfer in find_transfers(board, folder)]


def _as_layout(transfer: Transfer) -> Layout:
    *_, last = transfer.rows
    titles = {name: row_title(transfer.across.cells[name].results[0]) for name in transfer.rows}
    return Layout(
        f"Transfer on equal terms: {transfer.across.title}",
        f"Accuracy (%) on the {len(transfer.classes)} classes of both test sets, each weighing the "
        f"same, with all the model's answers allowed: within the data set trained on, across, and "
        f"the drop. Gains: over {titles[last]}, the last row, within and across, and how much more "
        f"across. In brackets the 95 % interval over the test objects of each class.",
        ["model", "within", "across", "drop", "gain within", "gain across", "more across"],
        [
            [
                titles[name],
                *map(difference, transfer.rows[name]),
                *(["–"] * 3 if name == last else map(difference, transfer.gains[name])),
            ]
            for name in transfer.rows
        ],
    )
