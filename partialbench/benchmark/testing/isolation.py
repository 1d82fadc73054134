"""Tests that leave no trace: what one draws or changes, the next does not see.

So testing twice, or something else in between, gives the same bytes.
"""

from __future__ import annotations

import contextlib
import copy
import random
import types
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from partialbench.dataset.seeding import generator

_TENSORS = ("_parameters", "_buffers")
_TORCHS_OWN = set(vars(nn.Module())) - {"training"}
"""What every module has, hooks among it: parameters and buffers are kept by themselves."""
_IMMUTABLE = (
    bool, int, float, str, bytes, type(None), type, types.FunctionType, types.BuiltinFunctionType,
    torch.dtype, torch.device, torch.Size,
)  # fmt: skip


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
def unchanged(model: nn.Module, state: State | None = None) -> Iterator[list[str]]:
    """After it the model's parameters, buffers and plain attributes are what they were.

    Args:
        state: what they were, where it is known; taken at the beginning without it.

    Yields:
        a list, which at the end holds the names of the parameters and buffers that were changed.
    """
    state = State(model) if state is None else state
    changed: list[str] = []
    try:
        yield changed
    finally:
        changed += state.restore()


class State:
    """A model's parameters, buffers and plain attributes at a moment, to be put back.

    What shares an object goes on sharing it: a list that holds a layer, a buffer under two names, a
    memory that two modules write to.
    """

    def __init__(self, model: nn.Module) -> None:
        self.modules = dict(model.named_modules())
        self.tensors = {
            (prefix, kind): {
                name: (tensor, None if tensor is None else tensor.detach().clone())
                for name, tensor in getattr(module, kind).items()
            }
            for prefix, module in self.modules.items()
            for kind in _TENSORS
        }
        self.attributes = self._copied(
            {
                prefix: {k: v for k, v in vars(module).items() if k not in _TORCHS_OWN}
                for prefix, module in self.modules.items()
            }
        )
        self.draws = [
            (value, value.get_state())
            for attributes in self.attributes.values()
            for value in attributes.values()
            if isinstance(value, torch.Generator)
        ]

    def restore(self) -> list[str]:
        """Puts everything back; the names of the parameters and buffers that were changed."""
        changed = []
        for (prefix, kind), tensors in self.tensors.items():
            held: dict[str, Tensor | None] = getattr(self.modules[prefix], kind)
            for name in held.keys() | tensors.keys():
                own, before = tensors.get(name, (None, None))
                now = held.get(name)
                if name not in tensors or not _equal(before, now):
                    changed.append(f"{prefix}.{name}" if prefix else name)
                    _put_back(held, name, own, before, known=name in tensors)
                elif now is not own:
                    held[name] = own
        # Copies again: what is put back may be changed again.
        for prefix, attributes in self._copied(self.attributes).items():
            has = self.modules[prefix].__dict__
            has.update(attributes)
            for name in has.keys() - attributes.keys() - _TORCHS_OWN:
                del has[name]
        for generator_, drawn in self.draws:
            generator_.set_state(drawn)
        return sorted(changed)

    def _copied(self, attributes: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
        """Copies that refer to the model's own modules and tensors, not to copies of these."""
        own = [*self.modules.values()]
        own += [pair[0] for held in self.tensors.values() for pair in held.values()]
        memo = {id(each): each for each in own}
        return {
            prefix: {name: _copy(value, memo) for name, value in has.items()}
            for prefix, has in attributes.items()
        }


def _copy(value: Any, memo: dict[int, Any]) -> Any:
    """A copy, or the thing itself where it has none (an open file, a tensor of a graph)."""
    if isinstance(value, (*_IMMUTABLE, nn.Module, torch.Generator)):
        return value
    try:
        return copy.deepcopy(value, memo)
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
    held: dict[str, Tensor | None],
    name: str,
    own: Tensor | None,
    before: Tensor | None,
    known: bool,
) -> None:
    """Into the very tensor that was there, where that can be: others may hold on to it."""
    if not known:
        del held[name]
        return
    if own is not None and before is not None:
        if own.shape == before.shape and own.dtype == before.dtype and not own.is_inference():
            own.data.copy_(before)
            before = own
        else:
            before = before.clone()
    held[name] = before
