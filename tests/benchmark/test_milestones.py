"""Milestones: their grammar, their steps and what a row of several costs."""

from __future__ import annotations

import numpy as np
import pytest

from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.protocol.protocol import PRESETS, protocol
from partialbench.errors import InputError
from partialbench.registry import COMMON_RECIPE, Recipe

COMMON = Recipe(**COMMON_RECIPE)


@pytest.mark.parametrize(
    ("text", "clouds"),
    [("25000", 25_000), ("100k", 100_000), ("1M", 1_000_000), ("1.6m", 1_600_000), (64, 64),
     ("6.4K", 6_400), (" 50k ", 50_000), (np.int64(64), 64)],
)  # fmt: skip
def test_a_number_of_clouds_is_read_and_named(text, clouds):
    assert milestones.parse(text) == clouds
    assert milestones.parse(milestones.name(clouds)) == clouds


def test_several_stand_with_commas_or_one_by_one():
    assert milestones.parse_several(["25k,50k", "100k"]) == (25_000, 50_000, 100_000)
    assert milestones.ordered([100_000, "25k", 25_000]) == (25_000, 100_000)
    names = [milestones.name(m) for m in (25_000, 2_500_000, 1_000_000, 6_016)]
    assert names == ["25k", "2500k", "1M", "6016"]


@pytest.mark.parametrize(
    "wrong", ["", "0", "-5", "100 k", "1e5", "0.5", "1.23456k", "k", "100kk", "nan", 0, True, 2.5]
)
def test_what_is_no_number_of_clouds_is_named(wrong):
    with pytest.raises(InputError, match=f"such as 25000, 100k or 1M, got {wrong!r}"):
        milestones.parse(wrong)


def test_a_comma_within_a_number_is_told():
    with pytest.raises(InputError, match="got '000' in '100,000'; commas stand between"):
        milestones.parse_several(["100,000"])
    with pytest.raises(InputError, match="clouds is empty"):
        milestones.ordered([])


def test_a_branch_leaves_after_four_fifths_and_regular_states_are_kept():
    plan = milestones.plan(PRESETS["board"], COMMON, 100_000, 80_000)
    assert (plan.steps, plan.branch_at, plan.warm_up) == (3_125, 2_500, 200)
    assert plan.clouds_seen == 100_000
    assert milestones.regular(2_500, 32) == {625: 25_000, 1_250: 50_000, 2_500: 100_000}
    # Whole numbers all the way: 0.8·m in binary is not 4·m/5.
    assert milestones.branch_step(1_005, 4) == 201


def test_the_last_line_of_a_branchs_log_is_of_a_fifth_of_its_decay():
    plan = milestones.plan(PRESETS["board"], COMMON, 25_000, 80_000)
    trunk = [s for s in range(1, plan.branch_at + 1) if plan.ends_interval(s, False)]
    branch = [s for s in range(plan.branch_at + 1, plan.steps + 1) if plan.ends_interval(s, True)]
    assert trunk == [156, 312, 468, 624]
    assert branch == [656, 687, 718, 749, 781]


def test_the_epochs_of_a_published_recipe_keep_to_the_budget_and_to_the_recipe():
    paper = PRESETS["paper"]

    def epochs(published, clouds, train_clouds):
        plan = milestones.plan(paper, Recipe(epochs=published), clouds, train_clouds)
        assert plan.steps == plan.epochs * (train_clouds // 32)
        assert plan.branch_at == 0
        return plan.epochs

    assert epochs(250, 2_500_000, 88_587) == 29
    assert epochs(20, 2_500_000, 88_587) == 20
    assert epochs(20, 2_500_000, 10_000_000) == 1


def test_the_length_is_told():
    def told(preset, recipe, clouds, train_clouds):
        plan = milestones.plan(protocol(preset), recipe, clouds, train_clouds)
        return milestones.describe(plan, recipe, train_clouds)

    assert told("board", COMMON, 100_000, 80_000) == "100,000 clouds, 1.25 epochs of 80,000 clouds"
    assert told("paper", Recipe(epochs=8), 480_000, 26_574) == (
        "8 epochs of 26,574 clouds, where the recipe ends; 480,000 clouds would be 19"
    )
    assert told("paper", Recipe(epochs=8), 4_000, 26_574) == "1 epoch of 26,574 clouds"


def test_less_than_a_batch_is_no_milestone():
    with pytest.raises(InputError, match="31 clouds are less than one batch of 32"):
        milestones.plan(PRESETS["board"], COMMON, 31, 80_000)
