"""The protocol, the split by object, recipes and their schedules."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from torch import nn

from partialbench.benchmark.protocol import recipe as recipes
from partialbench.benchmark.protocol.protocol import PRESETS, Protocol, from_dict, protocol
from partialbench.benchmark.protocol.schedule import Schedule, learning_rate
from partialbench.benchmark.protocol.split import balanced_subset, split_by_object
from partialbench.benchmark.training.optimizers import make_optimizer
from partialbench.errors import InputError
from partialbench.registry import ModelCard, Recipe


def test_the_digest_follows_what_is_done_and_not_its_name():
    mini = PRESETS["mini"]
    assert mini.digest == dataclasses.replace(mini, preset="other").digest
    seen = {mini.digest}
    changes = {"num_points": 7, "epochs": 3, "jitter_sigma": 0.5, "version": 99, "split_seed": 1,
               "rotation": "none", "max_test_clouds": 5, "subset": "distinct"}  # fmt: skip
    for name, value in changes.items():
        seen.add(dataclasses.replace(mini, **{name: value}).digest)
    assert len(seen) == 9
    assert len({p.digest for p in PRESETS.values()}) == len(PRESETS)


def test_the_columns_of_earlier_records_stand():
    """Their protocols had no ``subset``."""
    assert PRESETS["mini"].digest.startswith("dbe3b0a6eb92")
    assert PRESETS["small"].digest.startswith("8894e12d8331")
    fields = PRESETS["mini"].as_dict()
    del fields["subset"]
    assert from_dict(fields) == PRESETS["mini"]


def test_an_override_is_another_protocol_and_one_that_changes_nothing_is_not():
    assert protocol("smoke", num_points=256) is PRESETS["smoke"]
    changed = protocol("smoke", epochs=3)
    assert changed.preset == "smoke+"
    assert changed.digest != PRESETS["smoke"].digest
    assert from_dict(changed.as_dict()) == changed


def test_a_number_written_otherwise_is_the_same_protocol():
    assert protocol("small", subset="distinct", jitter_sigma=0) is PRESETS["equal"]
    assert protocol("mini", clouds_seen=1e6).digest == protocol("mini", clouds_seen=10**6).digest
    assert protocol("mini", epochs=8.0).epochs.__class__ is int


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: protocol("smok"), "did you mean smoke"),
        (lambda: protocol("smoke", epoch=3), "did you mean epochs"),
        (lambda: protocol("smoke", epochs=0), "epochs must be a positive whole number, got 0"),
        (
            lambda: protocol("smoke", epochs="two"),
            "epochs must be a positive whole number, got 'two",
        ),
        (lambda: protocol("smoke", num_points=None), "num_points must be a positive whole number"),
        (lambda: protocol("smoke", clouds_seen=1.5), "clouds_seen must be a positive whole number"),
        (lambda: protocol("smoke", split_seed=-1), "split_seed must be a whole number, got -1"),
        (lambda: protocol("smoke", jitter_clip="x"), "jitter_clip must be a number, got 'x'"),
        (lambda: protocol("smoke", rotation="z"), "rotation must be 'so3' or 'none', got 'z'"),
        (lambda: protocol("smoke", validation_fraction=1.0), "validation_fraction"),
        (
            lambda: protocol("smoke", subset="all"),
            "subset must be 'stored' or 'distinct', got 'all",
        ),
        (lambda: from_dict({"preset": "x"}), "missing"),
    ],
)
def test_errors_name_the_value_and_what_was_expected(call, message):
    with pytest.raises(InputError, match=message):
        call()


def test_the_number_of_epochs_keeps_to_the_budget_and_to_the_recipe():
    paper = PRESETS["paper"]
    assert paper.num_epochs(Recipe(epochs=250), 88_587) == math.ceil(2_500_000 / 88_587) == 29
    assert paper.num_epochs(Recipe(epochs=20), 88_587) == 20
    assert paper.num_epochs(Recipe(epochs=20), 10_000_000) == 1
    assert dataclasses.replace(paper, epochs=5).num_epochs(Recipe(epochs=2), 100) == 5


def test_a_budget_that_the_recipe_cuts_short_is_told():
    recipe = Recipe(epochs=8)
    more = protocol("mini", clouds_seen=480_000)
    assert more.describe_epochs(recipe, 26_574) == (
        "8 epochs of 26,574 clouds, where the recipe ends; clouds_seen=480,000 would be 19. "
        "epochs=19 makes it so"
    )
    assert protocol("mini", epochs=19).describe_epochs(recipe, 26_574) == (
        "19 epochs of 26,574 clouds"
    )
    assert protocol("mini", clouds_seen=4_000).describe_epochs(recipe, 26_574) == (
        "1 epoch of 26,574 clouds"
    )


def ids_and_labels(rng, classes=4, objects=10, views=3):
    labels = np.repeat(np.arange(classes), objects * views)
    ids = np.repeat([f"o{i:03d}" for i in range(classes * objects)], views)
    order = rng.permutation(len(ids))
    return ids[order], labels[order]


def test_no_object_is_on_both_sides_and_each_class_gives_its_share(rng):
    ids, labels = ids_and_labels(rng)
    names = list("abcd")
    train, validation = split_by_object(ids, labels, names, 0.2)
    assert sorted([*train, *validation]) == list(range(len(ids)))
    assert not set(ids[train]) & set(ids[validation])
    for label in range(4):
        assert len(set(ids[validation][labels[validation] == label])) == 2


def test_the_split_depends_on_names_and_not_on_row_order(rng):
    ids, labels = ids_and_labels(rng)
    held_out = set(ids[split_by_object(ids, labels, list("abcd"), 0.2)[1]])
    order = rng.permutation(len(ids))
    again = split_by_object(ids[order], labels[order], list("abcd"), 0.2)[1]
    assert set(ids[order][again]) == held_out
    other = split_by_object(ids, labels, list("abcd"), 0.2, seed=1)[1]
    assert set(ids[other]) != held_out


def test_a_class_with_one_object_trains_it():
    train, validation = split_by_object(["a", "a"], np.array([0, 0]), ["x"], 0.9)
    assert train.tolist() == [0, 1]
    assert validation.tolist() == []


def test_a_subset_is_balanced_as_far_as_classes_reach():
    labels = np.array([0] * 50 + [1] * 5 + [2] * 50)
    chosen = balanced_subset(np.arange(105), labels, 35)
    assert np.bincount(labels[chosen]).tolist() == [15, 5, 15]
    assert chosen.tolist() == sorted(chosen)
    assert np.array_equal(chosen, balanced_subset(np.arange(105), labels, 35))
    assert len(balanced_subset(np.arange(105), labels, None)) == 105


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
    schedule = Schedule(recipe, epochs=20)  # patience 2
    rates = []
    for epoch, loss in enumerate([1.0, 0.9, 0.9, 0.9, 0.9, 0.9, 0.9, 0.9]):
        rates.append(schedule.apply(optimizer, model, epoch / 20))
        schedule.end_epoch(loss)
        fresh = Schedule(recipe, epochs=20)
        fresh.load_state_dict(schedule.state_dict())
        schedule = fresh
    assert rates == [1, 1, 1, 1, 1, 0.5, 0.5, 0.5]
    assert schedule.apply(optimizer, model, 0.5) == 0.3  # 0.25, but never under the floor


def test_batch_norm_momentum_follows_its_staircase():
    recipe = Recipe(epochs=250, schedule_options={
        "bn_momentum": {"start": 0.5, "gamma": 0.5, "every_samples": 200_000, "floor": 0.01}
    })  # fmt: skip
    model = nn.Sequential(nn.Linear(2, 2), nn.BatchNorm1d(2))
    schedule = Schedule(recipe, 250)
    optimizer = make_optimizer(model, recipe)
    for samples, momentum in [(0, 0.5), (400_000, 0.125), (2_400_000, 0.01)]:
        schedule.apply(optimizer, model, samples / (250 * 9840))
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
        Schedule(recipe, 1)


def test_every_registered_recipe_can_be_made():
    from partialbench import registry

    model = nn.Linear(2, 2)
    for card in registry.cards().values():
        for preset in ("mini", "paper"):
            recipe = recipes.of_protocol(card, protocol(preset))
            schedule = Schedule(recipe, 3)
            optimizer = make_optimizer(model, recipe)
            for progress in (0.0, 0.5, 0.99):
                assert schedule.apply(optimizer, model, progress) > 0


def test_a_short_protocol_gives_every_model_the_short_recipe():
    card = ModelCard("m", "m:m", "M", "", recipe=Recipe(lr=0.1, epochs=250), short={"epochs": 2})
    assert recipes.of_protocol(card, protocol("paper")) == card.recipe
    short = recipes.of_protocol(card, protocol("mini"))
    assert (short.lr, short.schedule, short.epochs) == (0.003, "one-cycle", 2)
    # The budget caps the epochs, and so does the recipe.
    assert protocol("mini").num_epochs(short, 30_000) == 2
    assert protocol("mini").num_epochs(short, 240_000) == 1
    # "small" knows no share: every model sees its clouds as often.
    small = protocol("small")
    assert small.num_epochs(recipes.of_protocol(card, small), 2_160) == 8


def test_deviations_are_told_in_words():
    card = Recipe(epochs=250, batch_size=32)
    used = recipes.override(card, {"lr": 0.01})
    told = " | ".join(recipes.deviations(card, used, Protocol("x", clouds_seen=100), 20))
    assert "lr 0.01 instead of 0.001" in told
    assert "5 epochs of 20 clouds instead of 250 epochs; the schedule" in told
    assert "batches of 20 clouds" in told
    # What a short recipe says of epochs is neither published nor what was run.
    short = recipes.deviations(
        card, dataclasses.replace(card, epochs=1), Protocol("x", epochs=8), 64
    )
    assert [line for line in short if "epochs" in line] == [
        "8 epochs of 64 clouds instead of 250 epochs; the schedule is scaled to that length"
    ]
    unchanged = recipes.deviations(card, card, Protocol("x", epochs=250), 64)
    assert len(unchanged) == 1
    assert "augmentation" in unchanged[0]
    with pytest.raises(InputError, match="did you mean batch_size"):
        recipes.override(card, {"batchsize": 1})
