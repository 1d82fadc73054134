"""Where a training step of each model would wait for the accelerator: none should.

    python -m benchmarks.host_sync [--models pointnet2-ssg papnet]

No accelerator is needed: a step runs on fake tensors, which have shapes and no values, of a device
that is no CPU. What must know a value (``item``, ``nonzero``, a mask as an index) or brings one to
the host is named with its line. On a CUDA device each such place ends the queue of kernels.
"""

from __future__ import annotations

import argparse
import os
import sys
import traceback
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import (
    DataDependentOutputException,
    DynamicOutputShapeException,
    FakeTensorMode,
)
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode

from partialbench import registry
from partialbench.benchmark import inputs, models
from partialbench.benchmark.prediction import Batch
from partialbench.benchmark.training.loop import WithLoss

DEVICE = "pretended"
CLOUDS, POINTS, NUM_CLASSES = 4, 256, 40
ROOT = Path(__file__).resolve().parent.parent


def _is_ours(path: Path) -> bool:
    """Whether a file is of this tree; an environment within it is not, nor is this file."""
    libraries = {"site-packages", "dist-packages"}
    return path.is_relative_to(ROOT) and libraries.isdisjoint(path.parts) and path != Path(__file__)


class FetchedError(RuntimeError):
    """Values were brought from the device to the host."""


def _require_there(tensor: Tensor) -> None:
    if tensor.device.type != DEVICE:
        raise FetchedError("values are brought to the host")


class _NothingFetched(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        if func is torch.ops.aten._to_copy.default and args[0].device.type == DEVICE:
            _require_there(out)
        return out


def register() -> None:
    """Makes the device known to torch, once a process."""
    if not hasattr(torch, DEVICE):
        backend_registration._setup_privateuseone_for_python_backend(DEVICE)
        backend = getattr(torch, DEVICE)
        backend.get_amp_supported_dtype = lambda: [torch.bfloat16]


def on_device(like: Tensor) -> Tensor:
    """A fake tensor of that layout on the device."""
    fake = torch.empty_strided(like.shape, like.stride(), dtype=like.dtype, device=DEVICE)
    return fake.requires_grad_(like.requires_grad)


def first_wait(name: str, **options: Any) -> str | None:
    """Where a step of a registered model first waits, "file:line: what"; None where it does not."""
    register()
    torch.manual_seed(0)
    model = models.create(name, NUM_CLASSES, options).train()
    real = Batch(
        torch.randn(CLOUDS, POINTS, 3), torch.arange(CLOUDS),
        torch.eye(3).repeat(CLOUDS, 1, 1), torch.eye(3).repeat(CLOUDS, 1, 1),
        torch.randn(CLOUDS, POINTS, 3) if inputs.needs_normals(model) else None,
    )  # fmt: skip
    loss_of = WithLoss(model, 0.1, NUM_CLASSES)
    try:
        with FakeTensorMode(allow_non_fake_inputs=True), _NothingFetched():
            tensors = [*loss_of.named_parameters(), *loss_of.named_buffers()]
            state = {key: on_device(tensor) for key, tensor in tensors}
            batch = Batch(*(None if t is None else on_device(t) for t in real))
            loss = torch.func.functional_call(loss_of, state, (batch,))
            if loss.device.type != DEVICE:
                return f"the loss is on {loss.device}"
            loss.backward()
    except (DataDependentOutputException, DynamicOutputShapeException, FetchedError) as error:
        frames = [
            frame for frame in traceback.extract_tb(error.__traceback__)
            if _is_ours(Path(frame.filename))
        ]  # fmt: skip
        place = frames[-1]
        path = Path(place.filename).relative_to(ROOT)
        return f"{path}:{place.lineno}: {place.line} ({str(error).split(chr(10))[0]})"
    return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--models", nargs="+", default=list(registry.cards()))
    waiting = 0
    for name in parser.parse_args().models:
        wait = first_wait(name)
        waiting += wait is not None
        sys.stdout.write(f"{name:<24} {wait or 'never waits'}\n")
        sys.stdout.flush()
    # Autograd's thread of the pretended device calls Python as it ends. Where the interpreter is
    # being taken down by then, CPython ends the thread and C++ the process ("terminate called").
    os._exit(1 if waiting else 0)


if __name__ == "__main__":
    main()
