"""The mean of weights over a branch: resumed to the bit, and with statistics of its own."""

from __future__ import annotations

import copy
import dataclasses

import pytest
import torch
from lightning.fabric import Fabric
from torch import nn

from partialbench.benchmark.protocol import recipe as recipes
from partialbench.benchmark.run import make_task
from partialbench.benchmark.training import checkpoint, trunk
from partialbench.benchmark.training.average import (
    FRESH_BATCHES,
    SETTLING,
    WeightMean,
    refresh_statistics,
)
from partialbench.benchmark.training.loop import Loop
from partialbench.benchmark.training.train import train
from partialbench.errors import InputError, TimeLimitError
from partialbench.registry import COMMON_RECIPE, Recipe
from tests.benchmark.memory_clouds import MemoryClouds
from tests.benchmark.test_trunk import PROTOCOL, RECIPE, finished
from tests.benchmark.tiny_models import MODELS

CLOUDS = 400
"""Of 10 a step: the branch is the last 8 of 40 steps."""


def run(folder, average=True, **options):
    recipe = dataclasses.replace(RECIPE, average=average)
    task = make_task(f"{MODELS}:Bare", MemoryClouds(), PROTOCOL, recipe, 0, {})
    return train(task, Fabric(accelerator="cpu", devices=1), folder, CLOUDS, silent=True, **options)


def test_the_weights_tested_are_the_mean_over_the_branch(tmp_path, monkeypatch):
    taken = []
    take = Loop._take

    def remembering(self, batch):
        take(self, batch)
        taken.append({n: p.detach().clone() for n, p in self.bare.named_parameters()})

    monkeypatch.setattr(Loop, "_take", remembering)
    model = run(tmp_path).model
    assert len(taken) == 40
    for name, parameter in model.named_parameters():
        expected = torch.stack([weights[name] for weights in taken[32:]]).mean(0)
        torch.testing.assert_close(parameter, expected)
        assert not torch.equal(parameter, taken[-1][name]), name
    # Saved, and read back, it is the same; without averaging it is the end of the same path.
    stored = finished(tmp_path, CLOUDS)["state"]
    assert all(torch.equal(stored[n], p) for n, p in model.state_dict().items())
    plain = run(tmp_path / "plain", average=False).model
    assert all(torch.equal(p, taken[-1][n]) for n, p in plain.named_parameters())


def test_interrupted_within_the_branch_it_ends_the_same(tmp_path):
    run(tmp_path / "whole")
    for steps in (35, 1):  # in the branch's third step, then in its next one
        left = [steps]

        def should_stop(left=left) -> bool:
            left[0] -= 1
            return left[0] <= 0

        with pytest.raises(TimeLimitError):
            run(tmp_path / "parts", should_stop=should_stop)
    saved = checkpoint.load(trunk.RunFolder(tmp_path / "parts").branch(CLOUDS))
    assert saved["averaged"] == 4
    run(tmp_path / "parts")
    whole, parts = (finished(tmp_path / name, CLOUDS) for name in ("whole", "parts"))
    assert whole["state"].keys() == parts["state"].keys()
    for name, tensor in whole["state"].items():
        assert torch.equal(tensor, parts["state"][name]), name
    assert whole["summary"]["curve"] == parts["summary"]["curve"]


def test_statistics_are_those_of_the_mean_weights():
    torch.manual_seed(0)
    model = nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4))
    mean = WeightMean()
    for _ in range(3):
        with torch.no_grad():
            model[0].weight.add_(torch.randn(4, 3))
        mean.add(model)
    mean.put_into(model)
    points = torch.randn(FRESH_BATCHES, 64, 3)
    before = copy.deepcopy(model[1].running_mean)
    refresh_statistics(model, (model.train()(each) for each in points))
    found = model[0](points[SETTLING:].flatten(0, 1))
    assert not torch.allclose(model[1].running_var, torch.ones(4), atol=0.3)
    torch.testing.assert_close(model[1].running_var, found.var(0), rtol=0.05, atol=0)
    torch.testing.assert_close(model[1].running_mean, found.mean(0), rtol=0, atol=0.05)
    assert not torch.equal(model[1].running_mean, before)
    assert model[1].num_batches_tracked == FRESH_BATCHES


def test_a_recipe_without_it_is_written_as_before_and_one_with_it_is_another_row():
    own = Recipe(**COMMON_RECIPE)
    assert "average" not in recipes.as_dict(own)
    assert recipes.as_dict(recipes.override(own, {"average": True}))["average"] is True
    assert recipes.changes(own, {"average": True}) == {"average": True}
    assert recipes.changes(own, {"average": False}) == {}
    assert Recipe(**recipes.as_dict(own)) == own
    said = recipes.deviations(own, recipes.override(own, {"average": True}), PROTOCOL, 100, CLOUDS)
    assert "average True instead of False" in said
    with pytest.raises(InputError, match="average=True needs the schedule 'warm-up-stable-decay'"):
        recipes.override(Recipe(), {"average": True})
    with pytest.raises(InputError, match="average of a recipe must be of type bool, got 1"):
        recipes.override(own, {"average": 1})
