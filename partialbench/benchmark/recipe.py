"""From a published recipe to an optimiser, and what our protocol changes about it, in words."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import torch
from torch import nn
from torch.optim import Optimizer

from partialbench.benchmark.muon import Muon
from partialbench.benchmark.protocol import Protocol
from partialbench.errors import InputError
from partialbench.registry import SHORT_RECIPE, ModelCard, Recipe, close_matches

OPTIMIZERS = ("adam", "adamw", "muon", "sgd")


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


def label_smoothing(recipe: Recipe, num_classes: int) -> float:
    """The recipe's smoothing in torch's sense: ε over the others is ε·K/(K − 1) over all."""
    if recipe.smoothing_over_others:
        return recipe.label_smoothing * num_classes / (num_classes - 1)
    return recipe.label_smoothing


def of_protocol(card: ModelCard, protocol: Protocol) -> Recipe:
    """The recipe with which a protocol trains a model: the published one or the short one."""
    if protocol.recipe == "published":
        return card.recipe
    return override(card.recipe, {**SHORT_RECIPE, **card.short})


def override(recipe: Recipe, changes: Mapping[str, Any]) -> Recipe:
    """The recipe with fields changed; an unknown field raises ``InputError``."""
    known = [f.name for f in dataclasses.fields(Recipe)]
    for name in changes:
        if name not in known:
            raise InputError(f"a recipe has no field {name!r}{close_matches(name, known)}")
    return dataclasses.replace(recipe, **changes)


def as_dict(recipe: Recipe) -> dict[str, Any]:
    """Plain JSON data."""
    fields = dataclasses.asdict(recipe)
    fields["schedule_options"] = {
        k: dict(v) if isinstance(v, Mapping) else list(v) if isinstance(v, tuple) else v
        for k, v in recipe.schedule_options.items()
    }
    return fields


def deviations(published: Recipe, used: Recipe, protocol: Protocol, train_clouds: int) -> list[str]:
    """What this run changes about the published recipe, one sentence a change."""
    before, after = as_dict(published), as_dict(used)
    changes = [
        f"{name} {after[name]!r} instead of {before[name]!r}"
        for name in before
        if after[name] != before[name]
    ]
    epochs = protocol.num_epochs(used, train_clouds)
    if epochs != used.epochs:
        changes.append(
            f"{epochs} epochs of {train_clouds:,} clouds instead of {used.epochs} published "
            f"epochs; the schedule is scaled to that length"
        )
    if used.batch_size > train_clouds:
        changes.append(f"batches of {train_clouds} clouds, all there are, not {used.batch_size}")
    turn = "random rotation" if protocol.rotation == "so3" else "no rotation"
    jitter = (
        f"jitter {protocol.jitter_sigma:g} clipped at {protocol.jitter_clip:g}"
        if protocol.jitter_sigma else "no jitter"
    )  # fmt: skip
    changes.append(
        f"the protocol's augmentation instead of the published one: {turn}, {jitter}, a random "
        f"{protocol.num_points} of the {protocol.subset} points"
    )
    return changes
