"""Trained models over a grid: what rotation, a single view, a sensor and occluders cost each.

Made from the records of ``partialbench eval --checkpoint … --test-grid``: the same weights and
objects in every cell. Cells are paired cloud by cloud, by object and view; of a row's seeds those
count that were tested in every one of its cells.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leaderboard.board import budget_title
from leaderboard.comparison import counted
from leaderboard.tables.layouts import Layout
from leaderboard.words import difference, percent, row_title
from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.records.results import Result
from partialbench.benchmark.testing.uncertainty import bootstrap_intervals
from partialbench.dataset.grid import COMPLETE, ROTATIONS, Cell, parse
from partialbench.errors import InputError

Key = tuple[str, int]
"""A cloud: its object and view."""

Bounded = tuple[float, float, float]
"""A mean over clouds and the bounds of its 95 % interval, by bootstrap over objects."""

BASE = Cell("so3", "one view", "ideal", 0.0)
"""Where an axis is varied, the others are as here."""


@dataclass(frozen=True)
class Step:
    """From one cell to another that differs in one axis.

    Attributes:
        axis, value: the axis, and what it becomes: "sensor", "tof".
        before, after: the cells.
    """

    axis: str
    value: str
    before: Cell
    after: Cell


@dataclass(frozen=True)
class Grid:
    """One row of the board in every cell it was tested in.

    Attributes:
        result: one of its records, for its names.
        right: cell → cloud → share of the seeds that name it rightly.
    """

    result: Result
    seeds: int
    right: dict[Cell, dict[Key, float]]

    @property
    def training(self) -> str:
        """As a column's title has it: "pm40-parametric, partial, board, 25k clouds"."""
        train = self.result.train_data
        return f"{train.id}, {train.setting}, {budget_title(self.result)}"

    def accuracy(self, cell: Cell) -> float | None:
        """Over the cell's own clouds; None where it was not tested."""
        found = self.right.get(cell)
        return float(np.mean(list(found.values()))) if found else None

    def lost(self, step: Step) -> Bounded | None:
        """Accuracy before less that after, over the clouds of both; None without either cell."""
        return self._mean([(step.before, 1.0), (step.after, -1.0)])

    def interaction(self, one: Step, other: Step) -> Bounded | None:
        """What both steps cost together beyond the sum of what each costs alone.

        Both from one cell. Positive: together they cost more. None where a cell is missing.
        """
        both = replace(one.after, **{other.axis: getattr(other.after, other.axis)})
        terms = [(one.before, -1.0), (one.after, 1.0), (other.after, 1.0), (both, -1.0)]
        return self._mean(terms)

    def _mean(self, terms: list[tuple[Cell, float]]) -> Bounded | None:
        if any(cell not in self.right for cell, _ in terms):
            return None
        shared = sorted(set.intersection(*(set(self.right[cell]) for cell, _ in terms)))
        if not shared:
            return None
        values: NDArray = sum(  # type: ignore[assignment]
            weight * np.array([self.right[cell][key] for key in shared]) for cell, weight in terms
        )
        ((low, high),) = bootstrap_intervals(values[:, None], np.array([o for o, _ in shared]))
        return float(values.mean()), float(low), float(high)


def find_grids(records: Iterable[Result], folder: Path) -> list[Grid]:
    """Every row that was tested on a grid, the longest training first, then the best in ``BASE``.

    Raises:
        InputError: a row was tested on two grids: one cell with two test sets.
    """
    grouped: dict[tuple[Any, ...], dict[Cell, list[Result]]] = defaultdict(
        lambda: defaultdict(list)
    )
    for result in records:
        if set(result.conditions) == {"grid"}:
            train = result.train_data
            key = (
                result.row, train.id, train.setting, train.digest, result.protocol_digest,
                milestones.name(result.clouds), result.test_data.id,
            )  # fmt: skip
            grouped[key][parse(result.grid)].append(result)
    grids = []
    for cells in grouped.values():
        seeds = set.intersection(*({r.seed for r in each} for each in cells.values()))
        if seeds:
            first = next(iter(cells.values()))[0]
            right = {
                cell: _by_cloud([r for r in each if r.seed in seeds], folder)
                for cell, each in cells.items()
            }
            grids.append(Grid(first, len(seeds), right))
    return sorted(grids, key=lambda g: (-g.result.clouds, -(g.accuracy(BASE) or 0), g.result.row))


def _by_cloud(seeds: list[Result], folder: Path) -> dict[Key, float]:
    digests = {result.test_data.digest for result in seeds}
    if len(digests) > 1:
        raise InputError(
            f"{seeds[0].row} was tested on {len(digests)} data sets as the cell {seeds[0].grid}: "
            f"{', '.join(d[:12] for d in sorted(digests))}; keep the records of one grid"
        )
    found: dict[Key, list[bool]] = defaultdict(list)
    for result in seeds:
        predictions, label = counted(result, folder)
        keys = zip(predictions.object_ids.tolist(), predictions.views.tolist(), strict=True)
        for key, right in zip(keys, predictions.predicted == label, strict=True):
            found[key].append(bool(right))
    return {key: float(np.mean(hits)) for key, hits in found.items()}


def steps_of(grid: Grid) -> list[Step]:
    """The steps away from what is easiest that a grid has both cells of.

    Rotations from none to z to any, of complete clouds and of one view; from complete to one view
    in any rotation; from ideal depth to each sensor, and from no occluders to each, from ``BASE``.
    """
    cells = list(grid.right)
    found = []
    for shown in dict.fromkeys(cell.shown for cell in cells):
        for before, after in itertools.pairwise(ROTATIONS):
            one = replace(BASE, shown=shown)
            title = f"{after}, {shown}"
            found.append(
                Step("rotation", title, replace(one, rotation=before), replace(one, rotation=after))
            )
    found.append(Step("shown", "one view", replace(BASE, shown=COMPLETE), BASE))
    for sensor in dict.fromkeys(cell.sensor for cell in cells):
        found.append(Step("sensor", sensor, BASE, replace(BASE, sensor=sensor)))
    for share in sorted({cell.occluders for cell in cells}):
        found.append(Step("occluders", f"{share:g}", BASE, replace(BASE, occluders=share)))
    return [s for s in found if s.before != s.after and {s.before, s.after} <= grid.right.keys()]


def grid_layouts(grids: list[Grid]) -> list[Layout]:
    """Small multiples, a table for each row; what each axis costs; which axes interact."""
    if not grids:
        return []
    interactions = _interactions(grids)
    return [_costs(grids), *([interactions] if interactions else []), *map(_multiple, grids)]


def _multiple(grid: Grid) -> Layout:
    """A row's accuracy in every cell: a line for what is seen, a column for each rotation."""
    kinds = dict.fromkeys(replace(cell, rotation=BASE.rotation) for cell in grid.right)
    rotations = [r for r in ROTATIONS if any(cell.rotation == r for cell in grid.right)]
    rows = []
    for kind in sorted(
        kinds, key=lambda c: (c.shown != COMPLETE, c.occluders, c.sensor != "ideal")
    ):
        shares = [grid.accuracy(replace(kind, rotation=r)) for r in rotations]
        rows.append([_title(kind), *("–" if s is None else percent(s, None) for s in shares)])
    return Layout(
        f"Over the grid: {row_title(grid.result)}, {grid.training}",
        "Accuracy (%) of the same weights on the same objects; columns: the rotation from the "
        "object to the cloud.",
        ["clouds", *rotations],
        rows,
    )


def _title(cell: Cell) -> str:
    if cell.shown == COMPLETE:
        return COMPLETE
    before = f", {cell.occluders:.0%} occluded" if cell.occluders else ""
    return f"{cell.shown}, {cell.sensor}{before}"


def _costs(grids: list[Grid]) -> Layout:
    steps = {(s.axis, s.value): s for grid in grids for s in steps_of(grid)}
    rows = []
    for grid in grids:
        lost = [grid.lost(step) for step in steps.values()]
        costs = ["–" if each is None else difference(each) for each in lost]
        rows.append([row_title(grid.result), grid.training, *costs])
    return Layout(
        "What each axis of the grid costs",
        "Accuracy (%) lost by one step, over the clouds of both cells, with the 95 % interval over "
        "objects: to a wider rotation; from complete clouds to one view; from there, in any "
        "rotation, to a sensor; to occluders.",
        ["model", "trained on", *(f"{axis}: {value}" for axis, value in steps)],
        rows,
    )


def _interactions(grids: list[Grid]) -> Layout | None:
    """Pairs of steps from ``BASE`` along two axes whose joint cost is not the sum, surely."""
    rows = []
    for grid in grids:
        from_base = [s for s in steps_of(grid) if s.before == BASE]
        # Rotations lead to the base; undone, they are steps from it.
        from_base += [
            Step(s.axis, f"{s.before.rotation} instead of {s.after.rotation}", s.after, s.before)
            for s in steps_of(grid)
            if s.axis == "rotation" and s.after == BASE
        ]
        for one, other in itertools.combinations(from_base, 2):
            if one.axis == other.axis:
                continue
            found = grid.interaction(one, other)
            if found and (found[1] > 0 or found[2] < 0):
                pair = f"{one.axis} {one.value} × {other.axis} {other.value}"
                rows.append([row_title(grid.result), grid.training, pair, difference(found)])
    if not rows:
        return None
    return Layout(
        "Which axes of the grid interact",
        "What two steps cost together beyond the sum of what each costs, in points of accuracy, "
        "where the 95 % interval over objects leaves out 0: above 0 they make each other worse. "
        "Not corrected for the number of pairs.",
        ["model", "trained on", "steps", "beyond the sum"],
        rows,
    )
