"""Schedules: the published curves, the common one, and recipes under both kinds of protocol."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from torch import nn

from partialbench import registry
from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.protocol import recipe as recipes
from partialbench.benchmark.protocol.milestones import Plan
from partialbench.benchmark.protocol.protocol import protocol
from partialbench.benchmark.protocol.schedule import Schedule, grown_rate, learning_rate
from partialbench.benchmark.training.optimizers import make_optimizer
from partialbench.errors import InputError
from partialbench.registry import ModelCard, Recipe

COMMON = recipes.override(Recipe(), {**registry.COMMON_RECIPE, "lr": 1.0, "batch_size": 10})


# The published curves, evaluated by hand.
def test_a_staircase_in_samples_is_the_published_one_at_full_length():
    pointnet = Recipe(
        lr=1e-3, epochs=250, schedule="step",
        schedule_options={"gamma": 0.7, "every_samples": 200_000, "floor": 1e-5},
    )  # fmt: skip
    total = 250 * 9840
    for samples, steps in [(0, 0), (199_999, 0), (200_000, 1), (1_000_000, 5), (total - 1, 12)]:
        assert learning_rate(pointnet, samples / total) == pytest.approx(1e-3 * 0.7**steps)
    low = dataclasses.replace(pointnet, epochs=2500)
    assert learning_rate(low, 0.9999) == 1e-5


def test_milestones_and_epoch_steps_scale_with_the_length():
    papnet = Recipe(
        lr=0.005, epochs=20, schedule="step",
        schedule_options={"gamma": 0.1, "milestones": (10, 15)},
    )  # fmt: skip
    rates = [learning_rate(papnet, e / 20) for e in (0, 9.99, 10, 14.99, 15, 19.99)]
    assert rates == pytest.approx([5e-3, 5e-3, 5e-4, 5e-4, 5e-5, 5e-5])
    every = Recipe(lr=1.0, epochs=200, schedule="step",
                   schedule_options={"gamma": 0.5, "every_epochs": 20})  # fmt: skip
    assert learning_rate(every, 0.25) == 0.25  # epoch 50: two steps


def test_cosine_and_one_cycle_equal_torch():
    parameter = nn.Parameter(torch.zeros(1))
    steps = 40
    for recipe, make in [
        (
            Recipe(lr=0.1, schedule="cosine", schedule_options={"final_lr": 0.001}),
            lambda o: torch.optim.lr_scheduler.CosineAnnealingLR(o, steps, 0.001),
        ),
        (
            Recipe(lr=0.1, schedule="one-cycle", schedule_options={"pct_start": 0.25}),
            # torch counts its steps from 0 to total − 1.
            lambda o: torch.optim.lr_scheduler.OneCycleLR(
                o, 0.1, steps + 1, pct_start=(0.25 * steps + 1) / (steps + 1)
            ),
        ),
    ]:
        optimizer = torch.optim.SGD([parameter], lr=0.1)
        scheduler = make(optimizer)
        for step in range(steps):
            assert learning_rate(recipe, step / steps) == pytest.approx(
                optimizer.param_groups[0]["lr"], rel=1e-6
            )
            optimizer.step()
            scheduler.step()


def test_plateau_cuts_after_its_scaled_patience_and_survives_a_resume():
    recipe = Recipe(lr=1.0, epochs=100, schedule="plateau",
                    schedule_options={"factor": 0.5, "patience": 10, "floor": 0.3})  # fmt: skip
    model = nn.Linear(2, 2)
    optimizer = make_optimizer(model, recipe)
    twenty = Plan(20, 1, 20, 0, 0, 1, epochs=20)
    schedule = Schedule(recipe, twenty)  # patience 2
    rates = []
    for epoch, loss in enumerate([1.0, 0.9, 0.9, 0.9, 0.9, 0.9, 0.9, 0.9]):
        rates.append(schedule.apply(optimizer, model, epoch))
        schedule.end_epoch(loss)
        fresh = Schedule(recipe, twenty)
        fresh.load_state_dict(schedule.state_dict())
        schedule = fresh
    assert rates == [1, 1, 1, 1, 1, 0.5, 0.5, 0.5]
    assert schedule.apply(optimizer, model, 10) == 0.3  # 0.25, but never under the floor


def test_batch_norm_momentum_follows_its_staircase():
    recipe = Recipe(epochs=250, schedule_options={
        "bn_momentum": {"start": 0.5, "gamma": 0.5, "every_samples": 200_000, "floor": 0.01}
    })  # fmt: skip
    model = nn.Sequential(nn.Linear(2, 2), nn.BatchNorm1d(2))
    schedule = Schedule(recipe, Plan(0, 1, 250 * 9840, 0, 0, 9840, epochs=250))
    optimizer = make_optimizer(model, recipe)
    for samples, momentum in [(0, 0.5), (400_000, 0.125), (2_400_000, 0.01)]:
        schedule.apply(optimizer, model, samples)
        assert model[1].momentum == momentum


@pytest.mark.parametrize(
    ("recipe", "message"),
    [
        (Recipe(schedule="cosin"), "did you mean cosine"),
        (Recipe(schedule="cosine", schedule_options={"last_lr": 1}), "did you mean final_lr"),
    ],
)
def test_an_unknown_schedule_or_option_is_refused(recipe, message):
    with pytest.raises(InputError, match=message):
        Schedule(recipe, Plan(1, 1, 1, 0, 0, 1, epochs=1))


def test_the_common_rate_rises_stays_and_falls_to_zero():
    plan = milestones.plan(protocol("board", warm_up=40), COMMON, 1_000, 10_000)  # of 10 a step
    rates = [grown_rate(COMMON, plan, step) for step in range(plan.steps)]
    assert rates[:5] == pytest.approx([0.25, 0.5, 0.75, 1.0, 1.0])
    assert set(rates[3:80]) == {1.0}
    assert rates[80:82] == pytest.approx([1.0, 0.95])
    assert rates[-1] == pytest.approx(1 / 20)
    assert np.allclose(np.diff(rates[80:]), -1 / 20)


def test_the_trunk_is_the_same_whatever_the_milestone():
    board = protocol("board", warm_up=2_000)
    near, far = (milestones.plan(board, COMMON, m, 10_000) for m in (1_000, 64_000))
    for step in range(near.branch_at):
        assert grown_rate(COMMON, near, step) == grown_rate(COMMON, far, step)
    # A milestone within the warm-up decays from what was reached.
    assert grown_rate(COMMON, near, near.branch_at) == pytest.approx(81 / 200)


def test_every_registered_recipe_can_be_made():
    model = nn.Linear(2, 2)
    for card in registry.cards().values():
        for preset in ("board", "paper"):
            followed = protocol(preset)
            recipe = recipes.of_protocol(card, followed)
            recipes.require_fits(recipe, followed)
            plan = milestones.plan(followed, recipe, 100_000, 1_000)
            schedule = Schedule(recipe, plan)
            optimizer = make_optimizer(model, recipe)
            for progress in (0.0, 0.5, 0.99):
                assert schedule.apply(optimizer, model, int(progress * plan.steps)) > 0


def test_a_common_protocol_gives_every_model_the_common_recipe():
    card = ModelCard("m", "m:m", "M", "", recipe=Recipe(lr=0.1, epochs=250), common={"lr": 2e-3})
    assert recipes.of_protocol(card, protocol("paper")) == card.recipe
    common = recipes.of_protocol(card, protocol("board"))
    assert (common.lr, common.schedule, common.epochs) == (2e-3, "warm-up-stable-decay", None)
    assert (common.optimizer, common.batch_size) == ("adamw", 32)


@pytest.mark.parametrize(
    ("preset", "changes", "message"),
    [
        ("board", {"epochs": 4}, "epochs=4 does not go with .*--clouds"),
        ("board", {"schedule": "cosine"}, "epochs=None does not go with the schedule 'cosine'"),
        ("board", {"schedule": "cosine", "epochs": 4}, "'cosine' does not go with the protocol"),
        ("board", {"schedule_options": {"bn_momentum": {}}}, "has no option 'bn_momentum'"),
        ("paper", {"epochs": None}, "epochs=None does not go"),
        ("paper", {"epochs": None, "schedule": "warm-up-stable-decay"}, "keep theirs"),
    ],
)
def test_a_schedule_of_the_other_kind_is_refused(preset, changes, message):
    followed = protocol(preset)
    own = recipes.of_protocol(registry.card("pointnet"), followed)
    changes = {"schedule_options": {}} | changes
    with pytest.raises(InputError, match=message):
        recipes.require_fits(recipes.override(own, changes), followed)


def test_deviations_are_told_in_words():
    published = protocol("paper")
    card = Recipe(epochs=250, batch_size=32)
    used = recipes.override(card, {"lr": 0.01})
    told = " | ".join(recipes.deviations(card, used, published, 20, 100))
    assert "lr 0.01 instead of 0.001" in told
    assert "5 epochs of 20 clouds instead of 250 epochs; the schedule" in told
    assert "batches of 20 clouds" in told
    unchanged = recipes.deviations(card, card, published, 64, 64 * 250)
    assert len(unchanged) == 1
    assert "augmentation" in unchanged[0]
    board = protocol("board", stretch=1.25)
    common = recipes.of_protocol(ModelCard("m", "m:m", "M", "", recipe=card), board)
    told = " | ".join(recipes.deviations(card, common, board, 80_000, 100_000))
    assert (
        "100,000 clouds, 1.25 epochs of 80,000 clouds, instead of 250 epochs: warm-up over 6,400 "
        "clouds, a constant rate, and a decay to zero over the last fifth"
    ) in told
    assert "random rotation, stretched by up to 1.25 along the object's axes, no jitter" in told
    with pytest.raises(InputError, match="did you mean batch_size"):
        recipes.override(card, {"batchsize": 1})
