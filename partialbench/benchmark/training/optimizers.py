"""From a recipe to an optimiser."""

from __future__ import annotations

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
    if recipe.optimizer == "adam":
        return torch.optim.Adam(parameters, lr=recipe.lr, weight_decay=recipe.weight_decay)
    if recipe.optimizer == "adamw":
        return torch.optim.AdamW(parameters, lr=recipe.lr, weight_decay=recipe.weight_decay)
    if recipe.optimizer == "muon":
        return Muon(parameters, recipe.lr, recipe.weight_decay)
    if recipe.optimizer == "sgd":
        return torch.optim.SGD(
            parameters, lr=recipe.lr, momentum=recipe.momentum, weight_decay=recipe.weight_decay
        )
    raise InputError(
        f"no optimizer named {recipe.optimizer!r}{close_matches(recipe.optimizer, OPTIMIZERS)}"
    )
