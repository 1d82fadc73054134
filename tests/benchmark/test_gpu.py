"""Every model on a CUDA device: what it computes on a CPU, and a training that learns."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from partialbench import registry
from partialbench.benchmark.models import as_prediction
from partialbench.benchmark.prediction import Batch
from partialbench.benchmark.run import run_eval
from partialbench.benchmark.training.loop import WithLoss
from partialbench.geometry.rotations import haar_rotations
from tests.benchmark.tiny_models import MODELS, SMALL

DEVICE = "cuda"
CLASSES, CLOUDS, POINTS = 5, 8, 160
SMALLER = {"papnet": {"grid": 16}, "steerable-cnn": {"grid": 16}, "simpleview": {"image": 32}}

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device"),
]


@pytest.fixture(autouse=True)
def full_float32(monkeypatch):
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)


def batch_of(labels: Tensor, name: str) -> Batch:
    """Clouds on ellipsoids whose axes their labels choose, with normals if the model takes them."""
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((len(labels), POINTS, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    axes = np.stack([np.ones(CLASSES), np.linspace(0.2, 1, CLASSES), np.full(CLASSES, 0.3)], 1)
    turns = haar_rotations(rng, len(labels))
    points = (directions * axes[labels.numpy(), None]) @ turns.swapaxes(1, 2)
    rotation = torch.from_numpy(turns).float()
    batch = Batch(torch.from_numpy(points).float(), labels, rotation, rotation)
    if "normals" not in registry.card(name).inputs:
        return batch
    normals = (directions / axes[labels.numpy(), None]) @ turns.swapaxes(1, 2)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return batch._replace(normals=torch.from_numpy(normals).float())


def model_of(name: str) -> nn.Module:
    torch.manual_seed(0)
    return registry.create(name, CLASSES, **SMALLER.get(name, {}))


def moved(batch: Batch) -> Batch:
    return Batch(**{k: t.to(DEVICE) for k, t in batch._asdict().items() if t is not None})


@pytest.mark.parametrize("name", sorted(registry.cards()))
def test_answers_and_gradients_are_those_of_the_cpu(name):
    batch = batch_of(torch.arange(CLOUDS) % CLASSES, name)
    here = model_of(name).eval()
    with torch.no_grad():
        for parameter in here.parameters():
            if parameter.ndim == 1:
                # A bias of zero leaves empty voxels on ReLU's edge, where rounding decides.
                parameter.add_(0.05 * torch.randn(parameter.shape))
    there = copy.deepcopy(here).to(DEVICE)
    found = []
    for model, given in ((here, batch), (there, moved(batch))):
        more = {} if given.normals is None else {"normals": given.normals}
        logits = as_prediction(model(given.points, **more), CLOUDS, CLASSES).class_logits
        logits.square().mean().backward()
        gradients = [p.grad.flatten() for p in model.parameters() if p.grad is not None]
        found.append((logits.detach().cpu(), torch.cat(gradients).cpu()))
    for ours, theirs in zip(*found, strict=True):
        assert float((ours - theirs).norm() / theirs.norm().clamp_min(1e-6)) < 5e-3


@pytest.mark.parametrize("precision", [torch.float32, torch.bfloat16], ids=["32", "bf16"])
@pytest.mark.parametrize("name", sorted(registry.cards()))
def test_a_training_learns(name, precision):
    batch = moved(batch_of(torch.arange(CLOUDS) % CLASSES, name))
    trained = WithLoss(model_of(name).to(DEVICE), 0.0, CLASSES).train()
    optimizer = torch.optim.Adam(trained.parameters(), lr=1e-3)
    losses = []
    for _ in range(12):
        with torch.autocast(DEVICE, torch.bfloat16, enabled=precision is torch.bfloat16):
            loss = trained(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert np.isfinite(losses).all()
    assert np.mean(losses[-3:]) < np.mean(losses[:3])


def test_a_training_begun_there_ends_here(data, tmp_path):
    """The weights of a CUDA training answer alike on the CPU, and its record names the device."""
    (made,) = run_eval(
        f"{MODELS}:Posed", data, results_folder=tmp_path, **{**SMALL, "device": DEVICE}
    )
    assert made.environment["device"] == torch.cuda.get_device_name(0)
    (checkpoint,) = (tmp_path / "runs").glob("*/branch-*/checkpoint.pt")
    (again,) = run_eval(
        f"{MODELS}:Posed", data, checkpoint_file=checkpoint, results_folder=tmp_path / "cpu",
        device="cpu",
    )  # fmt: skip
    assert abs(again.scores["accuracy"] - made.scores["accuracy"]) < 0.02
