"""Tests that leave no trace: what one draws or changes, the next does not see.

So testing twice, or something else in between, gives the same bytes.
"""

from __future__ import annotations

import contextlib
import copy
import random
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from partialbench.dataset.seeding import generator

_TENSORS = ("_parameters", "_buffers")


@contextlib.contextmanager
def keyed_draws(*key: str | int, device: torch.device | str = "cpu") -> Iterator[None]:
    """Within it torch, NumPy's global generator and ``random`` draw what the key says.

    After it they go on as if it had not been.
    """
    device = torch.device(device)
    devices = [device] if device.type == "cuda" else []
    numpy_state, python_state = np.random.get_state(), random.getstate()  # noqa: NPY002
    with torch.random.fork_rng(devices):
        seed = int(generator(0, "test", *key).integers(2**32))
        torch.manual_seed(seed)
        np.random.seed(seed)  # noqa: NPY002
        random.seed(seed)
        try:
            yield
        finally:
            np.random.set_state(numpy_state)  # noqa: NPY002
            random.setstate(python_state)


@contextlib.contextmanager
def unchanged(model: nn.Module) -> Iterator[list[str]]:
    """After it the model's parameters, buffers and plain attributes are what they were.

    Yields:
        a list, which at the end holds the names of the parameters and buffers that were changed.
    """
    saved = [(name, module, *_snapshot(module)) for name, module in model.named_modules()]
    changed: list[str] = []
    try:
        yield changed
    finally:
        for prefix, module, tensors, attributes in saved:
            for kind in _TENSORS:
                held: dict[str, Tensor | None] = getattr(module, kind)
                for name in held.keys() | tensors[kind].keys():
                    before, now = tensors[kind].get(name), held.get(name)
                    if not _equal(before, now):
                        changed.append(f"{prefix}.{name}" if prefix else name)
                        _put_back(held, name, before, known=name in tensors[kind])
            module.__dict__.update(attributes)
            for name in module.__dict__.keys() - attributes.keys() - _OWN:
                del module.__dict__[name]
        changed.sort()


_OWN = {*_TENSORS, "_modules"}


def _snapshot(module: nn.Module) -> tuple[dict[str, dict[str, Tensor | None]], dict[str, Any]]:
    tensors = {
        kind: {
            name: None if tensor is None else tensor.detach().clone()
            for name, tensor in getattr(module, kind).items()
        }
        for kind in _TENSORS
    }
    attributes = {k: _copied(v) for k, v in module.__dict__.items() if k not in _OWN}
    return tensors, attributes


def _copied(value: Any) -> Any:
    """A copy, or the thing itself where it has none (an open file, a tensor of a graph)."""
    if callable(value) or isinstance(value, nn.Module):
        return value
    try:
        return copy.deepcopy(value)
    except Exception:
        return value


def _equal(before: Tensor | None, now: Tensor | None) -> bool:
    if before is None or now is None:
        return before is now
    if before.shape != now.shape or before.dtype != now.dtype or before.device != now.device:
        return False
    # By bits: NaN where NaN was is no change.
    return bool(torch.equal(_bits(before), _bits(now)))


def _bits(tensor: Tensor) -> Tensor:
    return tensor.detach().reshape(-1).contiguous().view(torch.uint8)


def _put_back(
    held: dict[str, Tensor | None], name: str, before: Tensor | None, known: bool
) -> None:
    now = held.get(name)
    if not known:
        del held[name]
    elif isinstance(now, nn.Parameter) and before is not None and before.shape == now.shape:
        now.data.copy_(before)  # an optimiser holds on to it
    else:
        held[name] = before
