"""What a training step makes is gone after it.

A custom autograd function that keeps an output of its own on ``ctx`` keeps itself for ever, and all
that it refers to: nothing is wrong but that a training of hours grows until it is killed.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn
from torch.multiprocessing.reductions import StorageWeakRef
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from baselines import vector_neurons
from tests.baselines.test_conformance import CARDS, SMALL, few, fresh


class Made(TorchDispatchMode):
    """Notes every storage that is made while it is on, without keeping it."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: dict[int, StorageWeakRef] = {}

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        for leaf in tree_leaves(out):
            if isinstance(leaf, torch.Tensor):
                storage = leaf.untyped_storage()
                self.seen[storage._cdata] = StorageWeakRef(storage)
        return out


def step(model: nn.Module) -> Made:
    with Made() as made:
        model(few(2)).class_logits.square().mean().backward()
    model.zero_grad(set_to_none=True)
    return made


def outlived(model: nn.Module) -> int:
    """How many storages of a training step are there after it.

    Not those that were there after an earlier one as well: the model's own, its input, and what is
    made once and kept.
    """
    step(model)
    first, second = step(model), step(model)
    kept = {key for key, each in first.seen.items() if not each.expired()}
    return sum(not each.expired() for key, each in second.seen.items() if key not in kept)


@pytest.mark.parametrize("name", CARDS)
def test_nothing_of_a_training_step_outlives_it(name: str) -> None:
    assert outlived(fresh(name, **SMALL.get(name, {})).train()) == 0


def test_what_keeps_itself_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """As it was: the mean of lengths on ctx kept the edges of every step of a vector neuron."""
    forward = vector_neurons._LengthMoments.forward

    def keeping(ctx: Any, *inputs: Any) -> Any:
        ctx.mean, variance = forward(ctx, *inputs)
        return ctx.mean, variance

    monkeypatch.setattr(vector_neurons._LengthMoments, "forward", staticmethod(keeping))
    assert outlived(fresh("vn-dgcnn").train()) > 0
