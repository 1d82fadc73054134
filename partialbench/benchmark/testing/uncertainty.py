"""How sure a score is, and whether two rows can be told apart.

Views of one object are correlated, so objects, not clouds, are the independent draws: intervals
resample whole objects, and tests flip whole objects. Both speak of the trained networks at hand on
other test objects; how training itself varies is the standard deviation over seeds, told beside.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.seeding import generator

RESAMPLES = 2_000
FLIPS = 10_000
"""At least. Where many pairs are compared there are more: ``flips_for``."""
_CHUNK = 1_000


def per_object(
    values: NDArray, object_ids: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sums of ``values`` (M,R) over each object's clouds, (n,R), and the clouds of each, (n,)."""
    values = np.asarray(values, np.float64)
    object_ids = np.asarray(object_ids)
    if values.ndim != 2 or object_ids.shape != values.shape[:1] or len(values) == 0:
        raise ValueError(
            f"expected (M,R) values and (M,) object ids, M ≥ 1; got {values.shape} and "
            f"{object_ids.shape}"
        )
    _, which = np.unique(object_ids, return_inverse=True)
    counts = np.bincount(which).astype(np.float64)
    sums = np.zeros((len(counts), values.shape[1]))
    np.add.at(sums, which, values)
    return sums, counts


def bootstrap_intervals(
    values: NDArray,
    object_ids: NDArray,
    confidence: float = 0.95,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> NDArray[np.float64]:
    """Percentile intervals of the mean over clouds, by resampling objects.

    Args:
        values: (M,R) per cloud and row, e.g. whether the class is right, averaged over seeds. All
            rows are resampled alike.
        object_ids: (M,) the object each cloud is a view of.

    Returns:
        (R,2) lower and upper bounds. With a single object there is nothing to resample: NaN.

    Source: Efron and Tibshirani 1993, section 13.3, with clusters as the units (ratio of sums, so
    that objects with more views weigh more, as they do in the mean).
    """
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must be between 0 and 1, got {confidence!r}")
    sums, counts = per_object(values, object_ids)
    n = len(counts)
    if n < 2:
        return np.full((sums.shape[1], 2), np.nan)
    rng = generator(seed, "bootstrap", n)
    means = np.concatenate(
        [
            (weights @ sums) / (weights @ counts)[:, None]
            for start in range(0, resamples, _CHUNK)
            for weights in [
                rng.multinomial(n, np.full(n, 1 / n), min(_CHUNK, resamples - start)).astype(float)
            ]
        ]
    )
    tail = 50 * (1 - confidence)
    return np.percentile(means, [tail, 100 - tail], axis=0).T


def flips_for(pairs: int, level: float) -> int:
    """Flips after which the smallest p of so many pairs, times ``pairs``, is a tenth of the level.

    With fewer the correction for many pairs could find no difference, however large it is.
    """
    return max(FLIPS, math.ceil(10 * pairs / level))


def paired_p_value(
    a: NDArray, b: NDArray, object_ids: NDArray, flips: int = FLIPS, seed: int = 0
) -> float:
    """Two-sided p of "rows a and b are equally good", by flipping the sign of whole objects.

    Args:
        a, b: (M,) values of the same clouds.

    Returns:
        (1 + exceedances) / (1 + flips): never 0, and 1 where the rows agree on every object.

    Source: the sign-flip permutation test of paired samples (Good 2005, section 3.2).
    """
    return float(paired_p_values(np.stack([a, b], axis=1), object_ids, flips, seed)[0, 1])


def paired_p_values(
    values: NDArray, object_ids: NDArray, flips: int = FLIPS, seed: int = 0
) -> NDArray[np.float64]:
    """``paired_p_value`` of every pair of rows of ``values`` (M,R): (R,R), symmetric, 1 within."""
    sums, _ = per_object(values, object_ids)
    n, rows = sums.shape
    first, second = np.triu_indices(rows, 1)
    differences = sums[:, first] - sums[:, second]
    observed = np.abs(differences.sum(axis=0))
    # Sums of equal terms in another order may differ in the last bit: a tie must count.
    slack = 1e-9 * (1 + np.abs(differences).sum(axis=0))
    rng = generator(seed, "flips", n)
    exceed = np.zeros(len(first))
    for start in range(0, flips, _CHUNK):
        signs = rng.integers(0, 2, (min(_CHUNK, flips - start), n)) * 2.0 - 1.0
        exceed += (np.abs(signs @ differences) >= observed - slack).sum(axis=0)
    p_values = np.ones((rows, rows))
    p_values[first, second] = p_values[second, first] = (1 + exceed) / (1 + flips)
    return p_values


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's step-down adjustment: compare each to the level, the family's error is kept.

    Source: Holm 1979. The i-th smallest of m is multiplied by m − i + 1, made monotone, cut at 1.
    """
    p = np.asarray(p_values, np.float64)
    order = np.argsort(p, kind="stable")
    stepped = p[order] * (len(p) - np.arange(len(p)))
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(np.maximum.accumulate(stepped), 1.0) if len(p) else stepped
    return adjusted.tolist()


def indistinguishable_groups(different: NDArray[np.bool_]) -> list[list[int]]:
    """Groups of rows no two of which are told apart, as few and as large as they can be.

    Args:
        different: (R,R) symmetric; rows in rank order, best first.

    Returns:
        Lists of row numbers, in order of their best row. Every row is in one at least; two rows
        share one exactly when they are not different.

    Source: insert and absorb (Piepho 2004), what "compact letter displays" show.
    """
    different = np.asarray(different, bool)
    if different.ndim != 2 or not np.array_equal(different, different.T):
        raise ValueError(f"expected a symmetric (R,R) matrix, got shape {different.shape}")
    groups = [frozenset(range(len(different)))] if len(different) else []
    for i, j in zip(*np.nonzero(np.triu(different, 1)), strict=True):
        split: list[frozenset[int]] = []
        for group in groups:
            split += [group - {i}, group - {j}] if {i, j} <= group else [group]
        groups = [g for g in set(split) if not any(g < other for other in split)]
    return sorted(sorted(int(i) for i in group) for group in groups)
