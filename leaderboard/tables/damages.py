"""Trained models on damaged clouds: what each kind of damage costs, and the mean corruption error.

Made from the records that ``partialbench eval --test-damage`` wrote beside the row's own: the same
weights on the same objects. Of a row's seeds those count that were tested under each of its
damages.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from leaderboard.board import Column
from leaderboard.comparison import share_correct
from leaderboard.tables.conditions import Tested, rows_under
from leaderboard.tables.layouts import Layout
from leaderboard.words import percent, row_title
from partialbench.benchmark.records.results import Result
from partialbench.benchmark.testing.damage import KINDS, MODELNET_C, STRENGTHS, parse
from partialbench.benchmark.testing.uncertainty import bootstrap_means
from partialbench.errors import InputError

REFERENCE = "dgcnn"
"""The row that errors are measured against, as ModelNet-C does."""
CLEAN = ""

Bounded = tuple[float, float, float]
"""A figure and the bounds of its 95 % interval, by bootstrap over objects."""


@dataclass(frozen=True)
class Damaged:
    """One row under damage, its seeds averaged.

    Attributes:
        right: damage as records name it, ``CLEAN`` first → (M,) share of seeds that are right.
        object_ids: (M,) of the same clouds.
    """

    seeds: int
    right: dict[str, NDArray[np.float64]]
    object_ids: NDArray[np.str_]

    def accuracy(self, kind: str) -> float | None:
        """Mean over the five strengths of a kind; None where one is missing."""
        names = parse(kind)
        if not self.right.keys() >= set(names):
            return None
        return float(np.mean([self.right[name].mean() for name in names]))

    @property
    def has_all(self) -> bool:
        """Whether it was tested under all that the mean errors are over."""
        return self.right.keys() >= set(parse(MODELNET_C))


@dataclass(frozen=True)
class Damages:
    """The rows of one column that were tested on damaged clouds, best first."""

    column: Column
    rows: dict[str, Damaged]

    @property
    def kinds(self) -> list[str]:
        """Those that some row was tested under at all five strengths, in the order of tables."""
        rows = self.rows.values()
        return [kind for kind in KINDS if any(row.accuracy(kind) is not None for row in rows)]

    def errors(self, name: str) -> tuple[Bounded, Bounded] | None:
        """``mean_errors`` of a row; None where it or the reference lacks a test."""
        row, reference = self.rows[name], self.rows.get(REFERENCE)
        if reference is None or not (row.has_all and reference.has_all):
            return None
        if not np.array_equal(row.object_ids, reference.object_ids):
            raise InputError(
                f"{name} and {REFERENCE} were not tested on the same clouds of "
                f"{self.column.title!r}; run one of them again"
            )
        return mean_errors(row.right, reference.right, row.object_ids)

    @property
    def harmless(self) -> tuple[str, ...]:
        """The kinds that ``RmCE`` leaves out, see ``harmless_kinds``; () without the reference."""
        reference = self.rows.get(REFERENCE)
        if reference is None or not reference.has_all:
            return ()
        return harmless_kinds(reference.right, reference.object_ids)


def harmless_kinds(reference: dict[str, NDArray], object_ids: NDArray) -> tuple[str, ...]:
    """The kinds under which a reference loses nothing that its 95 % interval tells from zero.

    What another row loses there against it is a ratio of two noises. Clouds of any pose, turned in
    the image by a few degrees, are such a kind.
    """
    lost = _wrong(reference, object_ids)[1]
    low = np.percentile(lost[1:], 2.5, axis=0)
    single = np.isnan(low)  # one object has no interval
    loses = np.where(single, lost[0] > 0, low > 0)
    return tuple(kind for kind, harm in zip(MODELNET_C, loses, strict=True) if not harm)


def mean_errors(
    right: dict[str, NDArray], reference: dict[str, NDArray], object_ids: NDArray
) -> tuple[Bounded, Bounded]:
    """mCE and RmCE: the errors under damage, and those beyond the clean ones, against a reference.

    Args:
        right, reference: see ``Damaged.right``; of the same clouds.

    Returns:
        Shares of the reference's: 1 is as good as it, less is better. A kind's error is summed over
        strengths, divided by the reference's, and averaged over ``MODELNET_C``; the second over
        those that are not ``harmless_kinds``, NaN where all are.

    Source: Ren, Pan and Liu 2022, section 3.3.
    """
    own, against = _wrong(right, object_ids), _wrong(reference, object_ids)
    left_out = harmless_kinds(reference, object_ids)
    kept = [kind not in left_out for kind in MODELNET_C]
    return _bounded(own[0], against[0]), _bounded(own[1][:, kept], against[1][:, kept])


def _wrong(right: dict[str, NDArray], object_ids: NDArray) -> tuple[NDArray, NDArray]:
    """Errors under each of ``MODELNET_C`` summed over strengths, and those beyond the clean ones.

    Returns:
        (1 + resamples, kinds) each: as measured, then by bootstrap, objects drawn alike for all.
    """
    values = np.stack([right[name] for name in (CLEAN, *parse(MODELNET_C))], axis=1)
    wrong = 1 - np.concatenate([values.mean(axis=0)[None], bootstrap_means(values, object_ids)])
    by_kind = wrong[:, 1:].reshape(len(wrong), len(MODELNET_C), len(STRENGTHS)).sum(axis=2)
    return by_kind, by_kind - len(STRENGTHS) * wrong[:, :1]


def _bounded(own: NDArray, reference: NDArray) -> Bounded:
    """Args: (draws,kinds) errors, the first as measured, of the row and of the reference."""
    if own.shape[1] == 0:
        return math.nan, math.nan, math.nan
    ratio = np.divide(own, reference, out=np.full_like(own, np.nan), where=reference > 0)
    mean = ratio.mean(axis=1)
    rest = mean[1:][~np.isnan(mean[1:])]
    low, high = np.percentile(rest, [2.5, 97.5]) if len(rest) else (math.nan, math.nan)
    return float(mean[0]), float(low), float(high)


def find_damages(board: list[Column], records: Iterable[Result], folder: Path) -> list[Damages]:
    """Of each column that has such records, what they say.

    Args:
        records: all of the folder's.
    """
    return [
        Damages(column, {name: _damaged(tested, folder) for name, tested in rows.items()})
        for column, rows in rows_under(board, records, "damage", CLEAN)
    ]


def _damaged(tested: Tested, folder: Path) -> Damaged:
    shares = {key: share_correct(tested[key], folder) for key in tested}
    right = {key: share for key, (_, share) in shares.items()}
    return Damaged(len(tested[CLEAN]), right, shares[CLEAN][0])


def as_layout(damages: Damages) -> Layout:
    """Mean errors, and the accuracy under each kind of damage, as a table."""
    rows = []
    for name, row in damages.rows.items():
        errors = damages.errors(name)
        kinds = [row.accuracy(kind) for kind in damages.kinds]
        rows.append(
            [
                row_title(damages.column.cells[name].results[0]),
                percent(float(row.right[CLEAN].mean()), None),
                *(["–", "–"] if errors is None else map(_ratio, errors)),
                *("–" if share is None else percent(share, None) for share in kinds),
            ]
        )
    left_out = ", ".join(damages.harmless)
    without = f" without {left_out}, under which DGCNN loses nothing to speak of" * bool(left_out)
    return Layout(
        f"Damaged clouds: {damages.column.title}",
        "The same weights on the same clouds, damaged in five strengths. mCE: errors under the "
        "seven kinds of ModelNet-C, each against DGCNN's, in %; RmCE: the same of what is lost to "
        f"the clean clouds{without}; less is better, in brackets 95 % intervals over test "
        "objects. Then accuracies (%): on clean clouds, and under each kind, averaged over "
        "strengths.",
        ["model", "clean", "mCE", "RmCE", *damages.kinds],
        rows,
    )


def _ratio(found: Bounded) -> str:
    mean, low, high = found
    if math.isnan(mean):
        return "–"
    bounds = "" if math.isnan(low) else f" ({100 * low:.0f} – {100 * high:.0f})"
    return f"{100 * mean:.1f}{bounds}"
