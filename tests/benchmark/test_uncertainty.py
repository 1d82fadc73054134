"""Intervals that cover, tests that keep their level, groups that say what they should."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy import stats

from partialbench.benchmark.testing.uncertainty import (
    bootstrap_intervals,
    difference_intervals,
    holm,
    indistinguishable_groups,
    median_interval,
    paired_p_value,
    paired_p_values,
    seed_test,
    share_intervals,
)


def clustered(rng, objects, views):
    """Whether each view is right: an object's chance is Beta(0.6, 0.3), so its views correlate."""
    chance = rng.beta(0.6, 0.3, objects)
    return (rng.random((objects, views)) < chance[:, None]).astype(float).reshape(-1)


def test_intervals_cover_clustered_data_and_the_naive_ones_do_not(rng):
    objects, views, trials, truth = 150, 8, 1500, 0.6 / 0.9
    ids = np.repeat(np.arange(objects), views)
    # Every trial is a row: the resampling weights are shared, each row's data are its own.
    values = np.stack([clustered(rng, objects, views) for _ in range(trials)], axis=1)
    low, high = bootstrap_intervals(values, ids).T
    covered = ((low <= truth) & (truth <= high)).mean()
    assert 0.93 <= covered <= 0.97
    low, high = bootstrap_intervals(values, np.arange(len(values)), resamples=400).T
    naive = ((low <= truth) & (truth <= high)).mean()
    assert naive < 0.8


def test_an_interval_is_the_normal_one_for_many_independent_clouds(rng):
    values = (rng.random((4000, 1)) < 0.8).astype(float)
    (low, high), mean = bootstrap_intervals(values, np.arange(4000))[0], values.mean()
    half = 1.96 * np.sqrt(mean * (1 - mean) / 4000)
    assert (low, high) == pytest.approx((mean - half, mean + half), abs=0.1 * half)


def test_degenerate_intervals():
    assert bootstrap_intervals(np.ones((5, 1)), np.arange(5)).tolist() == [[1.0, 1.0]]
    assert np.isnan(bootstrap_intervals(np.ones((5, 1)), np.zeros(5))).all()
    again = [bootstrap_intervals(np.eye(6), np.arange(6)) for _ in range(2)]
    assert np.array_equal(*again)
    with pytest.raises(ValueError, match="M ≥ 1"):
        bootstrap_intervals(np.ones((0, 1)), np.zeros(0))


def test_a_share_that_every_cloud_agrees_on_is_not_known_to_the_digit():
    """Hanley and Lippman-Hand 1983: of n that never fail, 3/n may (one-sided 95 %)."""
    ids = np.repeat(np.arange(15), 2)
    right = np.stack([np.ones(30), np.zeros(30), np.arange(30) % 2], axis=1)
    (all_low, all_high), (no_low, no_high), mixed = share_intervals(right, ids)
    exact = stats.binomtest(15, 15).proportion_ci(method="exact")
    assert (all_low, all_high) == pytest.approx((exact.low, 1.0))
    assert (no_low, no_high) == pytest.approx((0.0, 1 - exact.low))
    assert mixed.tolist() == bootstrap_intervals(right, ids)[2].tolist()
    assert share_intervals(np.ones((30, 1)), ids, 0.9)[0, 0] == pytest.approx(0.05 ** (1 / 15))
    assert np.isnan(share_intervals(np.ones((2, 1)), np.zeros(2))).all()


def test_the_interval_of_a_median_resamples_whole_objects(rng):
    values = rng.normal(size=2000)
    low, high = median_interval(values, np.arange(2000))
    half = 1.96 * np.sqrt(np.pi / 2 / 2000)  # of the median of many normal draws
    assert low < np.median(values) < high
    assert (high - low) / 2 == pytest.approx(half, rel=0.15)
    # Copies of a cloud are no new objects: the same objects, four views each, know no more.
    again = median_interval(np.repeat(values, 4), np.repeat(np.arange(2000), 4))
    assert again == pytest.approx((low, high), abs=1e-9)
    # Of three values each draw's median is one of them.
    assert median_interval(np.array([1.0, 2.0, 9.0]), np.arange(3)) == (1.0, 9.0)
    assert np.isnan(median_interval(np.ones(5), np.zeros(5))).all()


def test_the_paired_test_equals_every_sign_pattern_counted():
    rng = np.random.default_rng(3)
    a, b = rng.random((2, 16)).round(1)
    ids = np.repeat(np.arange(8), 2)
    difference = (a - b).reshape(8, 2).sum(1)
    sums = [abs(np.dot(s, difference)) for s in itertools.product((-1, 1), repeat=8)]
    exact = np.mean(np.array(sums) >= abs(difference.sum()) - 1e-9)
    assert paired_p_value(a, b, ids, flips=200_000) == pytest.approx(exact, abs=0.005)


def test_the_paired_test_keeps_its_level_and_finds_what_is_there(rng):
    rejected = 0
    ids = np.repeat(np.arange(60), 5)
    for _ in range(300):
        chance = np.repeat(rng.beta(0.6, 0.3, 60), 5)
        # Each model has its own luck with an object: equally good, yet correlated within objects.
        luck = np.repeat(rng.normal(0, 0.2, (2, 60)), 5, axis=1)
        a, b = (rng.random((2, 300)) < np.clip(chance + luck, 0, 1)).astype(float)
        rejected += paired_p_value(a, b, ids, flips=400) <= 0.05
    assert rejected / 300 < 0.09
    better = np.ones(300)
    worse = (rng.random(300) < 0.9).astype(float)
    assert paired_p_value(better, worse, ids) < 0.001
    assert paired_p_value(worse, worse, ids) == 1.0


def test_a_matrix_of_tests_is_the_tests_of_its_pairs(rng):
    values = (rng.random((90, 3)) < (0.5, 0.6, 0.9)).astype(float)
    ids = np.repeat(np.arange(30), 3)
    matrix = paired_p_values(values, ids)
    assert np.array_equal(matrix, matrix.T)
    assert np.diag(matrix).tolist() == [1, 1, 1]
    assert matrix[0, 2] == paired_p_value(values[:, 0], values[:, 2], ids)


@pytest.mark.parametrize("rows", [2, 60, 400])
def test_many_pairs_do_not_hide_a_difference(rng, rows):
    """The smallest p, times the number of pairs, must stay below the level."""
    pairs = rows * (rows - 1) // 2
    values = np.stack([np.ones(40), np.zeros(40)], axis=1)
    p = paired_p_values(values, np.arange(40))[0, 1]
    assert p >= 2 * 0.5**40  # what counting every sign pattern would give
    assert holm([p] + [1.0] * (pairs - 1))[0] <= 0.05 / 10


def test_the_bound_is_no_less_than_every_sign_pattern_counted():
    rng = np.random.default_rng(5)
    for lead in (0.2, 0.5, 0.8):
        values = np.stack([rng.random(12) + lead, rng.random(12)], axis=1)
        difference = values[:, 0] - values[:, 1]
        sums = [abs(np.dot(s, difference)) for s in itertools.product((-1, 1), repeat=12)]
        exact = np.mean(np.array(sums) >= abs(difference.sum()) - 1e-9)
        # One flip alone, so that the bound is what is returned wherever it says anything.
        assert paired_p_values(values, np.arange(12), flips=1)[0, 1] >= exact


def test_differences_are_resampled_alike(rng):
    values = rng.random((60, 4))
    ids = np.repeat(np.arange(20), 3)
    low, high = difference_intervals(values, ids)
    for i, j in itertools.combinations(range(4), 2):
        ((a, b),) = bootstrap_intervals((values[:, i] - values[:, j])[:, None], ids)
        assert (low[i, j], high[i, j]) == pytest.approx((a, b))
        assert (low[j, i], high[j, i]) == pytest.approx((-b, -a))


def trained(rng, seeds, spread, ahead=0.0):
    """A method's seeds on 150 objects of three views: (M, seeds) whether each is right."""
    chance = np.repeat(np.random.default_rng(7).normal(0.5, 1.2, 150), 3)
    logits = [
        chance + ahead + rng.normal(0, spread) + np.repeat(rng.normal(0, 0.4, 150), 3)
        for _ in range(seeds)
    ]
    return (rng.random((seeds, 450)) < 1 / (1 + np.exp(-np.array(logits)))).astype(float).T


@pytest.mark.parametrize("spread", [0.1, 0.3])
@pytest.mark.parametrize("seeds", [2, 3])
def test_two_groups_of_seeds_of_one_method_are_not_told_apart(rng, seeds, spread):
    """The objects alone would tell the networks apart: they are others, the method is one."""
    ids, trials = np.repeat(np.arange(150), 3), 250
    methods = networks = 0
    for _ in range(trials):
        rows = [trained(rng, seeds, spread) for _ in range(2)]
        values = np.stack([row.mean(axis=1) for row in rows], axis=1)
        methods += seed_test(values, ids, [row.mean(axis=0) for row in rows])[0, 1] <= 0.05
        networks += paired_p_value(*values.T, ids, flips=200) <= 0.05
    # Two standard deviations of so many trials above the level.
    assert methods / trials <= 0.05 + 2 * np.sqrt(0.05 * 0.95 / trials)
    assert networks > methods


def test_seeds_find_a_large_difference_and_one_network_says_nothing_of_trainings(rng):
    ids = np.repeat(np.arange(150), 3)
    good, poor = trained(rng, 3, 0.1, 1.5), trained(rng, 3, 0.1)
    values = np.stack([good.mean(axis=1), poor.mean(axis=1)], axis=1)
    assert seed_test(values, ids, [good.mean(axis=0), poor.mean(axis=0)])[0, 1] < 0.01
    assert seed_test(values, ids, [[0.5], [0.5]]) is None
    # A row of one network borrows the spread of those that have several.
    borrowed = seed_test(values, ids, [good.mean(axis=0), [float(values[:, 1].mean())]])[0, 1]
    assert 0 < borrowed < 0.05


def test_holm_by_hand_and_beside_scipy():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([]) == []
    assert holm([0.5, 0.9]) == [1.0, 1.0]
    # Never below Benjamini–Hochberg, never above Bonferroni.
    p = np.random.default_rng(0).random(20) ** 3
    assert np.all(np.array(holm(p)) >= stats.false_discovery_control(p) - 1e-12)
    assert np.all(np.array(holm(p)) <= np.minimum(1, 20 * p) + 1e-12)


def test_groups_by_hand():
    different = np.zeros((4, 4), bool)
    assert indistinguishable_groups(different) == [[0, 1, 2, 3]]
    for i, j in [(0, 2), (0, 3), (1, 3)]:
        different[i, j] = different[j, i] = True
    assert indistinguishable_groups(different) == [[0, 1], [1, 2], [2, 3]]
    assert indistinguishable_groups(~np.eye(3, dtype=bool)) == [[0], [1], [2]]
    assert indistinguishable_groups(np.zeros((0, 0), bool)) == []


@pytest.mark.parametrize("seed", range(20))
def test_rows_share_a_group_exactly_when_they_are_not_different(seed):
    rng = np.random.default_rng(seed)
    upper = np.triu(rng.random((8, 8)) < 0.5, 1)
    different = upper | upper.T
    groups = [set(g) for g in indistinguishable_groups(different)]
    for i, j in itertools.combinations(range(8), 2):
        assert any({i, j} <= g for g in groups) != different[i, j]
    assert set().union(*groups) == set(range(8))
    assert not any(a < b for a in groups for b in groups)
