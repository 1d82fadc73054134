"""Recipes as published: smoothing over the other classes."""

import pytest
import torch
from torch.nn.functional import cross_entropy, log_softmax

from partialbench import registry
from partialbench.benchmark.recipe import label_smoothing


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
