"""From a recipe to an optimiser."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import nn
from torch.optim import Optimizer

from partialbench.benchmark.protocol.recipe import OPTIMIZERS
from partialbench.benchmark.training.muon import Muon
from partialbench.errors import InputError
from partialbench.registry import Recipe, close_matches


def make_optimizer(model: nn.Module, recipe: Recipe) -> Optimizer:
    """The recipe's optimiser over every parameter that asks for a gradient."""
    parameters = [p for p in model.parameters() if p.requires_grad]
    if not parameters:
        raise InputError(f"{type(model).__name__} has no trainable parameters")
    if recipe.optimizer in ("adam", "adamw"):
        kind = torch.optim.Adam if recipe.optimizer == "adam" else torch.optim.AdamW
        # One pass over weights, gradients and state instead of ten; real numbers only.
        fused = all(p.is_floating_point() for p in parameters)
        return kind(parameters, lr=recipe.lr, weight_decay=recipe.weight_decay, fused=fused)
    if recipe.optimizer == "muon":
        return Muon(parameters, recipe.lr, recipe.weight_decay)
    if recipe.optimizer == "sgd":
        return torch.optim.SGD(
            parameters, lr=recipe.lr, momentum=recipe.momentum, weight_decay=recipe.weight_decay
        )
    raise InputError(
        f"no optimizer named {recipe.optimizer!r}{close_matches(recipe.optimizer, OPTIMIZERS)}"
    )


def as_made(saved: Mapping[str, Any], optimizer: Optimizer) -> dict[str, Any]:
    """A saved state that is gone on with in the way in which this optimiser was made.

    A state says how its optimiser took its steps, in one pass or in several, which is no part of
    what they are.
    """
    groups = [
        {**group, **{name: made[name] for name in ("fused", "foreach") if name in made}}
        for group, made in zip(saved["param_groups"], optimizer.param_groups, strict=True)
    ]
    return {**saved, "param_groups": groups}
