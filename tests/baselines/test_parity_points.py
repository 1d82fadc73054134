"""DGCNN and PointNet++ with published weights give what the published code printed for them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from partialbench import registry
from partialbench.errors import InputError

FILES = {
    "dgcnn": ("dgcnn", "logits"),
    "pointnet2-ssg": ("pointnet2_ssg", "log_probs"),
    "pointnet2-msg": ("pointnet2_msg", "log_probs"),
}


def fixture(shared: Path, name: str) -> tuple[dict[str, np.ndarray], torch.Tensor, torch.Tensor]:
    """State, points and published output."""
    stem, output = FILES[name]
    with np.load(shared / "parity" / f"{stem}.npz") as arrays:
        state = {k.removeprefix("state/"): arrays[k] for k in arrays if k.startswith("state/")}
        return state, torch.from_numpy(arrays["points"]), torch.from_numpy(arrays[output])


def output(model: torch.nn.Module, points: torch.Tensor, name: str) -> torch.Tensor:
    with torch.no_grad():
        logits = model(points).class_logits
    return logits if FILES[name][1] == "logits" else logits.log_softmax(dim=-1)


TOLERANCE = 2e-6
"""The fixtures' random weights make logits that hardly depend on the cloud: a layer fed with its
halves swapped moves them by 4e-5 only. Rounding moves them by 1e-6 at most."""


@pytest.mark.parametrize("name", FILES)
def test_logits_are_the_published_ones(shared: Path, name: str) -> None:
    state, points, expected = fixture(shared, name)
    model = registry.load_published(name, state, 40)
    torch.testing.assert_close(output(model, points, name), expected, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("name", FILES)
def test_wrong_weights_do_not_pass(shared: Path, name: str) -> None:
    """The predicate can fail: swapping the two halves of one layer's input is noticed."""
    state, points, expected = fixture(shared, name)
    layer = next(n for n, a in state.items() if a.ndim == 4 and a.shape[1] > 60)
    state[layer] = np.roll(state[layer], state[layer].shape[1] // 2, axis=1)
    model = registry.load_published(name, state, 40)
    assert (output(model, points, name) - expected).abs().max() > 5 * TOLERANCE


@pytest.mark.parametrize("name", FILES)
def test_a_state_for_another_model_is_refused(shared: Path, name: str) -> None:
    state, _, _ = fixture(shared, name)
    with pytest.raises(InputError, match="another number of classes"):
        registry.load_published(name, state, 15)
    dropped = next(n for n in state if n.endswith("running_var") and not n.startswith("bn"))
    with pytest.raises(InputError, match="lacks the weights of"):
        registry.load_published(name, {k: v for k, v in state.items() if k != dropped}, 40)
    with pytest.raises(InputError, match=r"'stn.fc.weight', which this model has no place for"):
        registry.load_published(name, state | {"stn.fc.weight": np.zeros(3)}, 40)
