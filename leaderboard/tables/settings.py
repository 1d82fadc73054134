"""Aligned, about z, rotated, partial: what each step of the first figure costs every model."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np

from leaderboard.board import Cell, Column, own_columns, ranked
from leaderboard.comparison import share_correct
from leaderboard.tables.layouts import Layout
from leaderboard.words import difference, percent, row_title
from partialbench.benchmark.testing.uncertainty import bootstrap_intervals, per_object

SETTINGS = ("aligned", "z-rotated", "rotated", "partial")


def setting_families(board: list[Column]) -> list[dict[str, Column]]:
    """Setting → column, for each data set, protocol and milestone with a row in two or more.

    The settings are in the paper's order; "z-rotated" is of the literature. Only columns trained
    and tested alike are in it. Where a setting was trained with several numbers of clouds there is
    a family for each number, in which a setting that has not that number is stood for by the
    nearest that it has. Of columns that differ in digests alone it is the one with most rows, as in
    table 1.
    """
    trained: dict[tuple[str, ...], dict[str, list[Column]]] = {}
    for column in own_columns(board):
        data, setting, *budget = column.key[0], column.key[1], *column.key[6:8]
        trained.setdefault((data, *budget), {}).setdefault(setting, []).append(column)
    families = {}
    for columns in trained.values():
        for size in sorted({c.training_clouds for each in columns.values() for c in each}):
            family = {s: _nearest(columns[s], size) for s in SETTINGS if s in columns}
            if compared_rows(family):
                families[tuple(column.key for column in family.values())] = family
    return list(families.values())


def _nearest(columns: list[Column], size: int) -> Column:
    return min(columns, key=lambda c: (abs(c.training_clouds - size), -len(c.cells)))


def compared_rows(family: dict[str, Column]) -> list[str]:
    """The rows that two settings of the family have, or more; best in the first setting first."""
    columns = family.values()
    names = dict.fromkeys(name for column in columns for name in ranked(column))
    return [name for name in names if sum(name in column.cells for column in columns) > 1]


Loss = tuple[float, float, float] | None
"""Accuracy in one setting less that in the next, the mean over shared objects, with its interval;
None where no object was tested in both."""


def losses(family: dict[str, Column], folder: Path) -> dict[str, list[Loss]]:
    """Of each of ``compared_rows``: what is lost at each step from one setting to the next."""
    found = {}
    for name in compared_rows(family):
        cells = [column.cells.get(name) for column in family.values()]
        shares = [_by_object(cell, folder) if cell else {} for cell in cells]
        found[name] = [_loss(before, after) for before, after in itertools.pairwise(shares)]
    return found


def as_layout(family: dict[str, Column], lost: dict[str, list[Loss]]) -> Layout:
    """The accuracies of a family, and its losses, as a table."""
    rows = []
    for name in compared_rows(family):
        cells = [column.cells.get(name) for column in family.values()]
        rows.append(
            [
                row_title(next(cell for cell in cells if cell).results[0]),
                *(percent(cell.mean(), cell.std()) if cell else "–" for cell in cells),
                *("–" if step is None else difference(step) for step in lost[name]),
            ]
        )
    setting, first = next(iter(family.items()))
    sizes = ", ".join(f"{column.training_clouds:,} {name}" for name, column in family.items())
    return Layout(
        f"By setting: {first.title.replace(f', {setting}', '')}",
        "After the paper's first figure. Lost: accuracy (%) in one setting less that in the next, "
        "over the objects tested in both, with the 95 % interval by bootstrap over them. Training "
        f"clouds: {sizes}.",
        [
            "model",
            *family,
            *(f"{before} − {after}" for before, after in itertools.pairwise(family)),
        ],
        rows,
    )


def _loss(before: dict[str, float], after: dict[str, float]) -> Loss:
    both = sorted(before.keys() & after.keys())
    if not both:
        return None
    lost = np.array([before[o] - after[o] for o in both])[:, None]
    ((low, high),) = bootstrap_intervals(lost, np.array(both))
    return float(lost.mean()), float(low), float(high)


def _by_object(cell: Cell, folder: Path) -> dict[str, float]:
    """Object → share of its clouds that are right, averaged over seeds."""
    object_ids, values = share_correct(cell.results, folder)
    sums, counts = per_object(values[:, None], object_ids)
    return dict(zip(np.unique(object_ids).tolist(), (sums[:, 0] / counts).tolist(), strict=True))
