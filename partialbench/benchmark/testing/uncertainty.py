"""How sure a score is, and whether two rows can be told apart.

Views of one object are correlated, so objects, not clouds, are the independent draws: intervals
resample whole objects, and tests flip whole objects. These speak of the trained networks at hand on
other test objects. Another training would give another network: where rows have several seeds,
``seed_test`` says whether two methods differ, trainings being drawn anew as well as objects.

Every row is resampled alike, and a chunk of draws is one product of matrices: time and memory grow
with rows, not with pairs of rows, but for the p-values themselves.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from partialbench.dataset.seeding import generator

RESAMPLES = 2_000
FLIPS = 10_000
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
    means = bootstrap_means(values, object_ids, resamples, seed)
    return np.stack(_bounds(means, confidence), axis=1)


def share_intervals(
    right: NDArray, object_ids: NDArray, confidence: float = 0.95
) -> NDArray[np.float64]:
    """``bootstrap_intervals`` of shares of clouds that are right, (M,R) between 0 and 1.

    Where all are right, or none, every resampling says the same; the interval is then the exact one
    of as many draws as there are objects (Clopper and Pearson 1934), so 15 of 15 is 78 to 100 %.
    """
    bounds = bootstrap_intervals(right, object_ids, confidence)
    sums, counts = per_object(right, object_ids)
    n = len(counts)
    if n > 1:
        margin = 1 - ((1 - confidence) / 2) ** (1 / n)
        bounds[(sums == 0).all(axis=0), 1] = margin
        bounds[(sums == counts[:, None]).all(axis=0), 0] = 1 - margin
    return bounds


def bootstrap_means(
    values: NDArray, object_ids: NDArray, resamples: int = RESAMPLES, seed: int = 0
) -> NDArray[np.float64]:
    """(resamples,R) means over clouds, objects resampled; NaN with a single object."""
    sums, counts = per_object(values, object_ids)
    n = len(counts)
    if n < 2:
        return np.full((resamples, sums.shape[1]), np.nan)
    chunks = []
    for start in range(0, resamples, _CHUNK):
        drawn = _draws(n, resamples, seed)[start : start + _CHUNK].astype(float)
        chunks.append((drawn @ sums) / (drawn @ counts)[:, None])
    return np.concatenate(chunks)


def median_interval(
    values: NDArray, object_ids: NDArray, confidence: float = 0.95, seed: int = 0
) -> tuple[float, float]:
    """Percentile interval of the median over clouds, objects resampled as in
    ``bootstrap_intervals`` but 1,000 times; NaN with a single object.

    Args:
        values: (M,) per cloud. object_ids: (M,).
    """
    values, object_ids = np.asarray(values, np.float64), np.asarray(object_ids)
    names, which = np.unique(object_ids, return_inverse=True)
    if len(names) < 2:
        return np.nan, np.nan
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    # One chunk: a median is no product of matrices, and takes its time.
    drawn = _draws(len(names), RESAMPLES, seed)[:_CHUNK]
    twice = 2 * np.cumsum(drawn[:, which[order]], axis=1, dtype=np.int32)
    total = twice[:, -1:] // 2
    lower = np.argmax(twice >= total, axis=1)
    upper = lower.copy()
    # Of an even number of clouds there are two in the middle, which may differ.
    at = np.take_along_axis(twice, lower[:, None], axis=1)
    even = np.flatnonzero(at == total)
    upper[even] = np.argmax(twice[even] > total[even], axis=1)
    low, high = _bounds((ordered[lower] + ordered[upper]) / 2, confidence)
    return float(low), float(high)


@functools.lru_cache(maxsize=32)  # the bins of one test set, column after column
def _draws(n: int, resamples: int, seed: int) -> NDArray[np.int16]:
    """(resamples,n) how often each object is drawn. One test set is resampled for many tables."""
    rng = generator(seed, "bootstrap", n)
    drawn = np.concatenate(
        [
            rng.multinomial(n, np.full(n, 1 / n), min(_CHUNK, resamples - start)).astype(np.int16)
            for start in range(0, resamples, _CHUNK)
        ]
    )
    drawn.flags.writeable = False
    return drawn


def _bounds(means: NDArray, confidence: float = 0.95) -> tuple[NDArray, NDArray]:
    """The percentiles (…,) of (resamples,…) that hold the middle share."""
    tail = 50 * (1 - confidence)
    low, high = np.percentile(means, [tail, 100 - tail], axis=0)
    return low, high


def difference_intervals(
    values: NDArray, object_ids: NDArray, confidence: float = 0.95, seed: int = 0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """``bootstrap_intervals`` of every row less every other, both resampled alike.

    Returns:
        low, high: (R,R), of the row's mean less the column's.
    """
    means = bootstrap_means(values, object_ids, seed=seed)
    rows = means.shape[1]
    low, high = np.zeros((rows, rows)), np.zeros((rows, rows))
    for i in range(rows - 1):
        low[i, i + 1 :], high[i, i + 1 :] = _bounds(
            means[:, i, None] - means[:, i + 1 :], confidence
        )
        low[i + 1 :, i], high[i + 1 :, i] = -high[i, i + 1 :], -low[i, i + 1 :]
    return low, high


def paired_p_value(
    a: NDArray, b: NDArray, object_ids: NDArray, flips: int = FLIPS, seed: int = 0
) -> float:
    """Two-sided p of "rows a and b are equally good", by flipping the sign of whole objects.

    Args:
        a, b: (M,) values of the same clouds.

    Returns:
        (1 + exceedances) / (1 + flips), or 2·exp(−T²/(2·Σd²)) where that is less: a bound on the
        chance that flips of the objects' differences d reach their sum T, which can be as small as
        many pairs ask for. 1 where the rows agree on every object.

    Source: the sign-flip permutation test of paired samples (Good 2005, section 3.2); Hoeffding
    1963, theorem 2.
    """
    return float(paired_p_values(np.stack([a, b], axis=1), object_ids, flips, seed)[0, 1])


def paired_p_values(
    values: NDArray, object_ids: NDArray, flips: int = FLIPS, seed: int = 0
) -> NDArray[np.float64]:
    """``paired_p_value`` of every pair of rows of ``values`` (M,R): (R,R), symmetric, 1 within.

    Each flip is drawn once for all pairs: the flipped difference of two rows is that of their
    flipped sums.
    """
    sums, _ = per_object(values, object_ids)
    n, rows = sums.shape
    if rows < 2:
        return np.ones((rows, rows))
    totals = sums.sum(axis=0)
    observed = np.abs(totals[:, None] - totals)
    # Sums of equal terms in another order may differ in the last bit: a tie must count.
    reach = observed - 1e-9 * (1 + np.abs(sums).sum(axis=0)[:, None] + np.abs(sums).sum(axis=0))
    rng = generator(seed, "flips", n)
    exceed = np.zeros((rows, rows), np.int64)
    for start in range(0, flips, _CHUNK):
        signs = rng.integers(0, 2, (min(_CHUNK, flips - start), n)) * 2.0 - 1.0
        flipped = (signs @ sums).T
        for i in range(rows - 1):
            apart = np.abs(flipped[i] - flipped[i + 1 :])
            exceed[i, i + 1 :] += np.count_nonzero(apart >= reach[i, i + 1 :, None], axis=1)
    drawn = (1.0 + exceed + exceed.T) / (1 + flips)
    squares = _squares_apart(sums)
    exponent = np.divide(observed**2, 2 * squares, out=np.zeros_like(squares), where=squares > 0)
    p_values = np.minimum(drawn, 2 * np.exp(-exponent))
    np.fill_diagonal(p_values, 1.0)
    return p_values


def _squares_apart(columns: NDArray) -> NDArray[np.float64]:
    """(R,R) sums of squared differences of every two columns of (n,R)."""
    products = columns.T @ columns
    own = np.diag(products)
    return np.maximum(own[:, None] + own - 2 * products, 0.0)


def seed_test(
    values: NDArray, object_ids: NDArray, seed_means: Sequence[Sequence[float]]
) -> NDArray[np.float64] | None:
    """Two-sided p of "methods a and b are equally good", of which the seeds are draws.

    Welch's t: the variance of a difference is that over objects, for the networks at hand, and that
    of each row's mean over trainings. The latter is the pooled one of all rows with two seeds or
    more, or the row's own where that is larger; its degrees of freedom are the pooled ones.

    Args:
        values: (M,R) per cloud and row, averaged over seeds.
        seed_means: for each row the mean of each of its seeds.

    Returns:
        (R,R) symmetric, 1 within; None where no row has two seeds: nothing says how trainings vary.

    Source: Welch 1947, with Satterthwaite's degrees of freedom.
    """
    freedom = sum(len(means) - 1 for means in seed_means)
    if freedom == 0:
        return None
    squares = [float(np.var(means)) * len(means) for means in seed_means]
    pooled = sum(squares) / freedom
    own = np.array(
        [
            max(pooled, square / (len(means) - 1) if len(means) > 1 else 0.0) / len(means)
            for square, means in zip(squares, seed_means, strict=True)
        ]
    )
    sums, counts = per_object(values, object_ids)
    n, clouds = len(counts), counts.sum()
    means = sums.sum(axis=0) / clouds
    over_objects = _squares_apart(sums - counts[:, None] * means) / clouds**2 * n / max(n - 1, 1)
    over_seeds = own[:, None] + own
    variance = over_objects + over_seeds
    ahead = np.abs(means[:, None] - means)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(ahead > 0, ahead / np.sqrt(variance), 0.0)
        weights = over_objects**2 / max(n - 1, 1) + over_seeds**2 / freedom
        degrees = np.where(weights > 0, variance**2 / weights, np.inf)
    p_values = 2 * stats.t.sf(t, degrees)
    np.fill_diagonal(p_values, 1.0)
    return p_values


class Contrast(NamedTuple):
    """A weighted sum of rows' means: its value, the bounds of its interval, and p of "it is 0".

    Attributes:
        objects, seeds: its standard errors over test objects and over trainings.
    """

    value: float
    low: float
    high: float
    p_value: float
    objects: float
    seeds: float


def contrast(
    values: NDArray,
    object_ids: NDArray,
    seed_means: Sequence[Sequence[float]],
    weights: Sequence[float],
    confidence: float = 0.95,
) -> Contrast:
    """A weighted sum of rows' means over clouds, of methods of which the seeds are draws.

    The rows are paired: the sum is made for each cloud, and whole objects are the draws. Variance
    over objects and over trainings are added as in ``seed_test``; the latter is pooled over all
    rows with two seeds or more, each weighing as its square weight over its number of seeds.

    Args:
        values: (M,R) per cloud and row, averaged over seeds.
        seed_means: for each row the mean of each of its seeds.
        weights: (R,).

    Raises:
        ValueError: no row has two seeds: nothing says how trainings vary.

    Source: Welch 1947, with Satterthwaite's degrees of freedom.
    """
    freedom = sum(len(means) - 1 for means in seed_means)
    if freedom == 0:
        raise ValueError("an interval that includes seeds needs a row with two seeds or more")
    weighted = np.asarray(weights, np.float64)
    squares = sum(float(np.var(means)) * len(means) for means in seed_means)
    numbers = np.array([len(means) for means in seed_means], np.float64)
    over_seeds = squares / freedom * float((weighted**2 / numbers).sum())
    sums, counts = per_object(np.asarray(values, np.float64) @ weighted[:, None], object_ids)
    n, clouds = len(counts), counts.sum()
    value = float(sums.sum() / clouds)
    residuals = sums[:, 0] - counts * value
    over_objects = float((residuals**2).sum()) / clouds**2 * n / max(n - 1, 1)
    variance = over_objects + over_seeds
    parts = over_objects**2 / max(n - 1, 1) + over_seeds**2 / freedom
    degrees = variance**2 / parts if parts > 0 else np.inf
    reach = float(stats.t.ppf(0.5 + confidence / 2, degrees)) * variance**0.5
    if variance > 0:
        p_value = 2 * float(stats.t.sf(abs(value) / variance**0.5, degrees))
    else:
        p_value = 1.0 if value == 0 else 0.0
    return Contrast(
        value, value - reach, value + reach, p_value, over_objects**0.5, over_seeds**0.5
    )


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

    Each group is as large as it can be; there are as many as it takes for each two rows that are
    not told apart to share one (what "compact letter displays" show, Piepho 2004).
    """
    different = np.asarray(different, bool)
    if different.ndim != 2 or not np.array_equal(different, different.T):
        raise ValueError(f"expected a symmetric (R,R) matrix, got shape {different.shape}")
    alike = ~different
    np.fill_diagonal(alike, True)
    shared = np.zeros_like(alike)
    groups = []
    for first in range(len(alike)):
        while True:
            missing = alike[first] & ~shared[first]
            missing[:first] = False
            if not missing.any():
                break
            # From the worst row it lacks upwards: neighbours in rank are the likeliest to be alike.
            start = int(np.flatnonzero(missing)[-1])
            group, open_to = [first], alike[first].copy()
            for row in sorted(range(len(alike)), key=lambda r: abs(r - start)):
                if row != first and open_to[row]:
                    group.append(row)
                    open_to &= alike[row]
            shared[np.ix_(group, group)] = True
            groups.append(sorted(group))
    return sorted(groups)
