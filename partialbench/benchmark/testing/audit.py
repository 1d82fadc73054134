"""What a trained model claims, costs and does, measured on a few clouds of the test set.

The rotation audit turns clouds at random and looks at how far the answer moves: a model whose card
claims rotation invariance should not move at all, beyond rounding.
"""

from __future__ import annotations

import resource
import statistics
import sys
import time
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from partialbench.benchmark import inputs
from partialbench.benchmark.clouds import Clouds
from partialbench.benchmark.models import as_prediction, num_parameters
from partialbench.dataset.seeding import generator
from partialbench.geometry.rotations import haar_rotations

AUDIT_CLOUDS = 24
AUDIT_TURNS = 2
COST_BATCH = 32
LATENCY_REPEATS = 5


@torch.inference_mode()
def rotation_audit(
    model: nn.Module,
    dataset: Clouds,
    num_classes: int,
    device: torch.device | str = "cpu",
    clouds: int = AUDIT_CLOUDS,
    turns: int = AUDIT_TURNS,
) -> dict[str, Any]:
    """How far the class logits move when a cloud is turned about the camera.

    Returns:
        ``drift``: root mean square change of the logits (each cloud's mean taken off, which no
        probability depends on) over their own root mean square; 0 is invariant, about 1.4 is
        unrelated. ``changed``: share of turned clouds whose class changes. ``clouds``, ``turns``:
        over how many.
    """
    model.eval()
    rng = generator(0, "rotation audit")
    rows = np.sort(rng.permutation(len(dataset))[:clouds])
    points, more = inputs.of_rows(model, dataset, rows, device)

    def answer(turn: Tensor | None = None) -> Tensor:
        # Copies: a model may change what it is given.
        turned = [x.clone() if turn is None else x @ turn.mT for x in (points, *more.values())]
        output = model(turned[0], **dict(zip(more, turned[1:], strict=True)))
        logits = as_prediction(output, len(points), num_classes).class_logits.double()
        return logits - logits.mean(dim=1, keepdim=True)

    before = answer()
    moved, changed = 0.0, 0.0
    for _ in range(turns):
        turn = torch.from_numpy(haar_rotations(rng, len(rows)).astype(np.float32)).to(device)
        after = answer(turn)
        moved += float((after - before).square().mean()) / turns
        changed += float((after.argmax(1) != before.argmax(1)).double().mean()) / turns
    size = float(before.square().mean())
    return {
        "drift": (moved / size) ** 0.5 if size > 0 else 0.0,
        "changed": changed,
        "clouds": len(rows),
        "turns": turns,
    }


@torch.inference_mode()
def cost(
    model: nn.Module,
    dataset: Clouds,
    device: torch.device | str = "cpu",
    batch_size: int = COST_BATCH,
) -> dict[str, Any]:
    """Parameters, arithmetic and time of the forward pass.

    Returns:
        ``parameters``; ``multiply_adds`` of one cloud (matrix products and convolutions, as torch
        counts them); ``latency_ms`` of one cloud alone and ``batch_ms`` per cloud in a batch, each
        the median of a few runs after one that is not counted; ``peak_memory_bytes``: on CUDA the
        most the allocator held in this pass, elsewhere the process's high-water mark so far.
    """
    model.eval()
    device = torch.device(device)
    rows = np.arange(min(batch_size, len(dataset)))
    points, more = inputs.of_rows(model, dataset, rows, device)

    def run(clouds: int) -> None:
        # Copies: a model may change what it is given.
        given = {name: value[:clouds].clone() for name, value in more.items()}
        model(points[:clouds].clone(), **given)

    with FlopCounterMode(display=False) as counter:
        run(1)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)

    def milliseconds(clouds: int, repeats: int) -> float:
        times = []
        for _ in range(repeats + 1):
            _wait(device)
            start = time.perf_counter()
            run(clouds)
            _wait(device)
            times.append(1e3 * (time.perf_counter() - start))
        return statistics.median(times[1:])

    return {
        "parameters": num_parameters(model),
        "multiply_adds": counter.get_total_flops() // 2,
        "latency_ms": milliseconds(1, LATENCY_REPEATS),
        "batch_ms": milliseconds(len(rows), 1) / len(rows),
        "batch_size": len(rows),
        "peak_memory_bytes": peak_memory_bytes(device),
    }


def peak_memory_bytes(device: torch.device) -> int:
    """On CUDA the allocator's peak since it was last reset, elsewhere this process's so far."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
