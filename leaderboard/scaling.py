"""Learning curves: a row's accuracy over the clouds it has seen, and what a power law says of more.

A curve is one row at several milestones, on one data set under one protocol.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import t as student

from leaderboard.board import Column
from leaderboard.comparison import Comparison

FAR = 1_000_000
"""Clouds seen that the law is asked about."""
FEWEST = 4
"""Milestones that a law is fitted to. Three leave one degree of freedom, and an interval that says
nothing."""
_MILESTONE = 7
"""Where in ``Column.key`` the milestone stands."""


class Seen(NamedTuple):
    """A row at one milestone; ``low`` and ``high`` as in ``Comparison.intervals``."""

    clouds: int
    accuracy: float
    low: float
    high: float


class Extrapolation(NamedTuple):
    """What the law expects at ``FAR`` clouds, with the 95 % prediction interval of the regression.

    Attributes:
        exponent: b of error = a·clouds^−b.
    """

    accuracy: float
    low: float
    high: float
    exponent: float


def group(column: Column) -> tuple[str, ...]:
    """What the milestones of a curve share: the column's key without its milestone."""
    return (*column.key[:_MILESTONE], *column.key[_MILESTONE + 1 :])


def learning_curves(
    board: Sequence[Column], comparisons: Sequence[Comparison]
) -> dict[tuple[str, ...], dict[str, list[Seen]]]:
    """``group`` → row name → its milestones by rising number of clouds; one at least."""
    curves: dict[tuple[str, ...], dict[str, list[Seen]]] = defaultdict(dict)
    for column, comparison in zip(board, comparisons, strict=True):
        for name, cell in column.cells.items():
            low, high = comparison.intervals[name]
            seen = Seen(cell.results[0].clouds, cell.mean(), low, high)
            curves[group(column)].setdefault(name, []).append(seen)
    for rows in curves.values():
        for points in rows.values():
            points.sort()
    return dict(curves)


def extrapolate(points: Sequence[Seen], clouds: int = FAR) -> Extrapolation | None:
    """A power law of the error, fitted by least squares to its logarithm, at ``clouds``.

    None for fewer than ``FEWEST`` milestones, where one of them is without error (it has no
    logarithm), and where the curve reaches so far already: then there is the row itself.

    Source: the form is Hestness et al., arXiv:1712.00409, without the constant that a few
    milestones cannot tell from the exponent; the interval is that of a new observation in simple
    linear regression.
    """
    if len(points) < FEWEST or any(p.accuracy >= 1 for p in points):
        return None
    if max(p.clouds for p in points) >= clouds:
        return None
    x = np.log([p.clouds for p in points])
    y = np.log([1 - p.accuracy for p in points])
    slope, intercept = np.polyfit(x, y, 1)
    free, spread = len(x) - 2, float(((x - x.mean()) ** 2).sum())
    residual = float(((y - intercept - slope * x) ** 2).sum()) / free
    far = math.log(clouds)
    width = student.ppf(0.975, free) * math.sqrt(
        residual * (1 + 1 / len(x) + (far - x.mean()) ** 2 / spread)
    )
    expected, best, worst = (
        1 - min(1.0, math.exp(intercept + slope * far + off)) for off in (0, -width, width)
    )
    return Extrapolation(expected, worst, best, float(-slope))
