"""No cloud gets logits out of all proportion, whatever variant answers.

Why it could: a field that ReLUs held at zero through training has no variance, and the rare cloud
that wakes it is divided by the square root of that, layer after layer.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from baselines.steerable import Fields, GatedBlock
from baselines.steerable.convolution import SteerableConvolution
from papnet.model import LIMIT, VARIANTS, PAPNet
from partialbench.benchmark.prediction import Batch
from partialbench.errors import InputError
from partialbench.registry import card, create

LARGEST_LOGIT = 100.0


def field(seed: int, fields: Fields, clouds: int = 6) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(clouds, fields.channels, 4, 4, 4, generator=generator)


@pytest.mark.parametrize("formulation", ["assembled", "factorised", "spectral"])
def test_a_field_asleep_in_training_is_held_when_it_wakes(formulation: str) -> None:
    torch.manual_seed(0)
    fields = Fields((2, 1, 1))
    layer = SteerableConvolution(fields, fields, 3, padding=1, momentum=1.0, limit=LIMIT,
                                 formulation=formulation)  # fmt: skip
    asleep = field(0, fields)
    asleep[:, 1:5] = 0  # a scalar and a vector
    with torch.no_grad():
        layer.train()(asleep)
        layer.eval()
        awake = asleep.clone()
        awake[2] = field(1, fields)[2]
        held = layer(awake)
        layer.limit = None
        free = layer(awake)
        usual = free[[0, 1, 3, 4, 5]]
        assert free[2].abs().max() > 50 * usual.abs().max(), "as released"
        assert held[2].abs().max() < 10 * usual.abs().max()
        # The others are what they were.
        torch.testing.assert_close(held[[0, 1, 3, 4, 5]], usual, atol=1e-6, rtol=0)


def test_what_is_held_is_the_mean_square_and_nothing_else() -> None:
    fields = Fields((1, 1))
    layer = SteerableConvolution(fields, fields, 3, limit=4.0, padding=1).eval()
    mean, var = torch.tensor([0.5]), torch.tensor([1.0, 3.0])
    x = field(0, fields, 3)
    x[1] = 10 * x[1] + 1
    held = layer._limited(x, mean, var, 4.0)
    scalar, vector = held[1, :1] - 0.5, held[1, 1:]
    assert scalar.square().mean() == pytest.approx(4.0, rel=1e-3)
    assert vector.square().sum(0).mean() == pytest.approx(12.0, rel=1e-3)
    torch.testing.assert_close(vector / vector.norm(), x[1, 1:] / x[1, 1:].norm())
    assert torch.equal(held[0], x[0])
    assert torch.equal(held[2], x[2])


def odd_clouds() -> Tensor:
    """(12,128,3) views of solids, and what no training has: lines, sheets, points, far strays."""
    rng = np.random.default_rng(1)
    t = np.linspace(-1, 1, 128)[:, None]
    balls = rng.normal(size=(4, 128, 3)) * rng.uniform(0.2, 1, (4, 1, 3))
    line = t * [0.3, 0.5, 0.8]
    sheet = np.concatenate([rng.uniform(-1, 1, (128, 2)), np.zeros((128, 1))], axis=1)
    stray = np.concatenate([rng.normal(size=(127, 3)) * 0.01, [[1.0, 1, 1]]])
    pair = np.repeat([[0.0, 0, 0], [0, 0, 1.0]], 64, axis=0)
    point = np.zeros((128, 3))
    shell = rng.normal(size=(128, 3))
    shell /= np.linalg.norm(shell, axis=1, keepdims=True)
    full = rng.uniform(-1, 1, (128, 3))
    helix = np.concatenate([np.cos(9 * t), np.sin(9 * t), t], axis=1)
    others = [line, sheet, stray, pair, point, shell, full, helix]
    return torch.from_numpy(np.stack([*balls, *others])).float()


def boxes(seed: int = 0) -> tuple[Tensor, Tensor]:
    """(8,128,3) turned flat boxes, the only shapes that training sees, and their poses."""
    R = torch.tensor(Rotation.random(8, random_state=seed).as_matrix()).float()
    box = np.random.default_rng(seed).uniform(-1, 1, (8, 128, 3)) * [1.0, 0.6, 0.2]
    return torch.from_numpy(box).float() @ R.mT, R


def trained(variant: str) -> PAPNet:
    """Briefly; then every second scalar of every layer is put to sleep, as long training does to
    some: its bias is as low as keeps it at zero for all that was seen."""
    torch.manual_seed(0)
    few = {"k": 3} if VARIANTS[variant].ensemble else {}
    model = PAPNet(5, variant=variant, grid=16, **few).train()
    optimizer = torch.optim.Adam(model.parameters(), lr=5e-3)
    for step in range(2):
        points, R = boxes(step)
        optimizer.zero_grad()
        model.training_loss(Batch(points, torch.arange(8) % 5, R, R)).backward()
        optimizer.step()

    def put_to_sleep(block: GatedBlock, y: Tensor) -> None:
        most = y[:, : len(block.scalar_bias)].amax((0, 2, 3, 4))
        block.scalar_bias.data[::2] = -most[::2]

    for module in model.modules():
        if hasattr(module, "momentum"):
            module.momentum = 1.0  # the statistics become those of what comes now
        if isinstance(module, GatedBlock):
            module.convolution.register_forward_hook(
                lambda _, __, y, block=module: put_to_sleep(block, y)
            )
    points, R = boxes()
    with torch.no_grad():
        model.training_loss(Batch(points, torch.arange(8) % 5, R, R))
    for module in model.modules():
        module._forward_hooks.clear()
    return model.eval()


@pytest.mark.parametrize("variant", VARIANTS)
def test_no_variant_gives_any_cloud_logits_out_of_proportion(variant: str) -> None:
    model = trained(variant)
    with torch.no_grad():
        logits = model(odd_clouds()).class_logits
        assert logits.abs().max() < LARGEST_LOGIT
        for module in model.modules():
            if isinstance(module, SteerableConvolution):
                module.limit = None
        released = model(odd_clouds()).class_logits
    assert released.abs().max() > 10 * LARGEST_LOGIT, "the test can fail"


def test_two_streams_of_one_backbone_are_one_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    """So its statistics are of clouds as they come and of turned ones, as at test."""
    model, seen = PAPNet(5, variant="input-transformation", grid=16), []
    forward = model.backbone.forward
    monkeypatch.setattr(model.backbone, "forward", lambda p, g: (seen.append(p), forward(p, g))[1])
    R = torch.tensor(Rotation.random(4, random_state=0).as_matrix()).float()
    points = odd_clouds()[:4]
    model.delta_deg, model.snap = 0.0, False
    model.train().training_loss(Batch(points, torch.arange(4), R, R))
    (both,) = seen
    assert both.shape == (8, 128, 3)
    torch.testing.assert_close(both[4:], both[:4] @ R)


def test_the_published_network_is_computed_as_published() -> None:
    assert card("papnet").published_options == {"limit": 0.0}
    published = create("papnet", 5, **card("papnet").published_options)
    ours = create("papnet", 5)
    limits = [
        {m.limit for m in model.modules() if isinstance(m, SteerableConvolution)}
        for model in (published, ours)
    ]
    assert limits == [{None}, {LIMIT}]
    with pytest.raises(InputError, match=r"limit must be 0 .none. or at least 1, got 0.5"):
        create("papnet", 5, limit=0.5)
