"""Recipes as published: smoothing over the other classes."""

import pytest
import torch
from torch.nn.functional import cross_entropy, log_softmax

from partialbench import registry
from partialbench.benchmark.protocol.recipe import changes, label_smoothing, override
from partialbench.errors import InputError
from partialbench.registry import Recipe


@pytest.mark.parametrize("num_classes", [15, 40])
def test_dgcnns_smoothing_is_spread_over_the_other_classes(num_classes):
    """Its release: 1 − ε on the label, ε/(K − 1) on each other; torch spreads over all K."""
    logits = torch.randn(6, num_classes, generator=torch.Generator().manual_seed(0))
    labels = torch.arange(6)
    target = torch.full_like(logits, 0.2 / (num_classes - 1))
    target[torch.arange(6), labels] = 0.8
    published = -(target * log_softmax(logits, 1)).sum(1).mean()
    recipe = registry.card("dgcnn").recipe
    ours = cross_entropy(logits, labels, label_smoothing=label_smoothing(recipe, num_classes))
    torch.testing.assert_close(ours, published)
    plain = cross_entropy(logits, labels, label_smoothing=recipe.label_smoothing)
    assert (plain - published).abs() > 1e-4


def test_what_a_recipe_says_already_is_no_change():
    own = Recipe(lr=1e-3, schedule="step", schedule_options={"gamma": 0.1, "milestones": (1, 2)})
    assert changes(own, {"lr": 0.001, "batch_size": 32.0}) == {}
    assert changes(own, {"schedule_options": {"gamma": 0.1, "milestones": [1, 2]}}) == {}
    assert changes(own, {"lr": 1, "epochs": 3}) == {"lr": 1.0, "epochs": 3}


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"lr": "abc"}, "lr of a recipe must be a number, not negative, got 'abc'"),
        ({"lr": -1}, "got -1"),
        ({"lr": float("nan")}, "got nan"),
        ({"batch_size": 1}, "batch_size of a recipe must be a whole number, 2 or more, got 1"),
        ({"batch_size": True}, "got True"),
        ({"clip_norm": 0}, "a positive number or null"),
        ({"optimizer": "adm"}, "did you mean adam"),
        ({"schedule": "steps"}, "did you mean step"),
        ({"schedule": "step"}, "schedule 'step' needs gamma"),
        ({"schedule": "step", "schedule_options": {"gamma": 0.1}}, "a staircase needs"),
        ({"schedule": "plateau"}, "schedule 'plateau' needs factor, patience"),
        ({"schedule_options": "gamma"}, "must be of type mapping, got 'gamma'"),
    ],
)
def test_a_recipe_that_cannot_train_is_refused(fields, message):
    with pytest.raises(InputError, match=message):
        override(Recipe(), fields)
