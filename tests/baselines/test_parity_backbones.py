"""The modern backbones with published weights give what the published code printed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from partialbench import registry
from partialbench.errors import InputError

FILES = {"pointmlp-elite": "pointmlp_elite", "pointnext-s": "pointnext_s", "pct": "pct"}
TOLERANCE = 1e-4
every_model = pytest.mark.parametrize("name", FILES)


def fixture(shared: Path, name: str) -> tuple[dict[str, np.ndarray], dict[str, Tensor]]:
    """State, and everything else that the file holds."""
    with np.load(shared / "parity" / "modern" / f"{FILES[name]}.npz") as arrays:
        state = {k.removeprefix("state/"): arrays[k] for k in arrays if k.startswith("state/")}
        rest = {k: torch.from_numpy(arrays[k]) for k in arrays if not k.startswith("state/")}
    return state, rest


@torch.no_grad()
def off(model: nn.Module, rest: dict[str, Tensor]) -> float:
    return float((model(rest["points"]).class_logits - rest["logits"]).abs().max())


@every_model
def test_logits_are_the_published_ones(shared: Path, name: str) -> None:
    state, rest = fixture(shared, name)
    assert off(registry.load_published(name, state, 40), rest) <= TOLERANCE


@every_model
def test_quirks_are_what_makes_them_so(shared: Path, name: str) -> None:
    """The row itself, which chooses points by where they are, answers otherwise."""
    state, rest = fixture(shared, name)
    model = registry.create(name, 40).eval()
    model.load_state_dict(registry.load_published(name, state, 40).state_dict())
    assert off(model, rest) > 10 * TOLERANCE


@every_model
def test_wrong_weights_do_not_pass(shared: Path, name: str) -> None:
    """The predicate can fail: swapping the two halves of one layer's input is noticed."""
    state, rest = fixture(shared, name)
    layer = next(n for n, a in state.items() if a.ndim >= 2 and a.shape[1] > 60)
    state[layer] = np.roll(state[layer], state[layer].shape[1] // 2, axis=1)
    assert off(registry.load_published(name, state, 40), rest) > 5 * TOLERANCE


@every_model
def test_a_state_for_another_model_is_refused(shared: Path, name: str) -> None:
    state, _ = fixture(shared, name)
    with pytest.raises(InputError, match="another number of classes"):
        registry.load_published(name, state, 15)
    dropped = next(n for n in state if n.endswith("running_var"))
    with pytest.raises(InputError, match="lacks the weights of"):
        registry.load_published(name, {k: v for k, v in state.items() if k != dropped}, 40)
    with pytest.raises(InputError, match=r"'stn.fc.weight', which this model has no place for"):
        registry.load_published(name, state | {"stn.fc.weight": np.zeros(3)}, 40)


def test_inner_values_are_the_published_ones(shared: Path) -> None:
    """Of the first level of each: where a convention is off, this says which."""
    for name, layer, wanted in (
        ("pointmlp-elite", "stages.0", "stage1"),
        ("pointnext-s", "levels.0", "sa1"),
        ("pct", "levels.0", "local_0"),
        ("pct", "attention.0", "attention_1"),
    ):
        state, rest = fixture(shared, name)
        model, seen = registry.load_published(name, state, 40), []
        hook = model.get_submodule(layer).register_forward_hook(
            lambda _module, _inputs, output, seen=seen: seen.append(output)
        )
        off(model, rest)
        hook.remove()
        torch.testing.assert_close(seen[0].mT, rest[wanted], atol=TOLERANCE, rtol=0)


def test_pct_with_keys_of_its_own_is_refused(shared: Path) -> None:
    state, _ = fixture(shared, "pct")
    key = "pt_last.sa1.k_conv.weight"
    with pytest.raises(InputError, match="k_conv has other weights"):
        registry.load_published("pct", state | {key: state[key] + 1}, 40)


@pytest.mark.parametrize("name", FILES)
def test_an_unknown_quirk_is_named(name: str) -> None:
    with pytest.raises(InputError, match="no quirk 'begin'"):
        registry.create(name, 40, quirks="begin")
