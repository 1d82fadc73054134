"""The protocol, the split by object, recipes and their schedules."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from partialbench.benchmark.protocol.protocol import (
    PRESETS,
    default_clouds,
    from_dict,
    protocol,
)
from partialbench.benchmark.protocol.split import balanced_subset, split_by_object
from partialbench.errors import InputError


def test_the_digest_follows_what_is_done_and_not_its_name():
    board = PRESETS["board"]
    assert board.digest == dataclasses.replace(board, preset="other").digest
    seen = {board.digest}
    changes = {"num_points": 7, "warm_up": 3, "jitter_sigma": 0.5, "version": 99, "split_seed": 1,
               "rotation": "none", "max_test_clouds": 5, "subset": "stored",
               "stretch": 1.25}  # fmt: skip
    for name, value in changes.items():
        seen.add(dataclasses.replace(board, **{name: value}).digest)
    assert len(seen) == 10
    assert len({p.digest for p in PRESETS.values()}) == len(PRESETS)


def test_an_override_is_another_protocol_and_one_that_changes_nothing_is_not():
    assert protocol("smoke", num_points=256) is PRESETS["smoke"]
    changed = protocol("smoke", warm_up=3)
    assert changed.preset == "smoke+"
    assert changed.digest != PRESETS["smoke"].digest
    assert from_dict(changed.as_dict()) == changed
    assert default_clouds(changed) == (64,)


def test_a_number_written_otherwise_is_the_same_protocol():
    assert protocol("board", jitter_sigma=0, stretch=1) is PRESETS["board"]
    assert protocol("board", warm_up=8.0).warm_up.__class__ is int
    # What makes another preset is that preset.
    assert protocol("board", warm_up=0, max_train_clouds=32, max_test_clouds=16).preset == "smoke"


def test_clouds_in_training_are_as_in_testing_and_alike_for_every_model():
    board = PRESETS["board"]
    assert (board.subset, board.jitter_sigma, board.stretch) == ("distinct", 0.0, 1.0)
    assert (board.rotation, board.recipe, board.num_points) == ("so3", "common", 256)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: protocol("smok"), "did you mean smoke"),
        (lambda: protocol("smoke", rotations="so3"), "did you mean rotation"),
        (lambda: protocol("smoke", max_test_clouds=0), "must be a positive whole number, got 0"),
        (lambda: protocol("smoke", warm_up="two"), "warm_up must be a whole number, got 'two"),
        (lambda: protocol("paper", warm_up=9), "warm_up=9 would have no effect on published"),
        (lambda: protocol("board", recipe="short"), "must be 'published' or 'common', got 'short'"),
        (lambda: protocol("board", stretch=0.8), r"stretch must be 1 \(none\) or more, got 0.8"),
        (lambda: protocol("smoke", num_points=None), "num_points must be a positive whole number"),
        (lambda: protocol("smoke", num_points=1.5), "num_points must be a positive whole number"),
        (lambda: protocol("smoke", split_seed=-1), "split_seed must be a whole number, got -1"),
        (lambda: protocol("smoke", jitter_clip="x"), "jitter_clip must be a number, got 'x'"),
        (lambda: protocol("smoke", rotation="z"), "rotation must be 'so3' or 'none', got 'z'"),
        (lambda: protocol("smoke", validation_fraction=1.0), "validation_fraction"),
        (
            lambda: protocol("smoke", subset="all"),
            "subset must be 'stored' or 'distinct', got 'all",
        ),
        (lambda: from_dict({"preset": "x"}), "missing"),
        (lambda: from_dict({**PRESETS["board"].as_dict(), "version": 2}), "of version 3"),
    ],
)
def test_errors_name_the_value_and_what_was_expected(call, message):
    with pytest.raises(InputError, match=message):
        call()


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
