"""Whether a cloud's answer is its own: scored alone, and in the company of others.

A model that looks at its batch-mates (normalisation by the batch, attention or a prior across it)
answers for a test set, not for a cloud: its accuracy is not what the others' is.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from partialbench.benchmark import inputs
from partialbench.benchmark.clouds import Clouds
from partialbench.benchmark.models import as_prediction
from partialbench.benchmark.records import results
from partialbench.benchmark.testing.isolation import keyed_draws, unchanged
from partialbench.dataset.seeding import generator
from partialbench.errors import InputError

CLOUDS = 8
COMPANY = 32


@torch.inference_mode()
def company_audit(
    model: nn.Module,
    dataset: Clouds,
    num_classes: int,
    device: torch.device | str = "cpu",
    company: int = COMPANY,
) -> dict[str, Any]:
    """How far the class logits of some test clouds move with what is scored beside them.

    The clouds come first in a batch with others, with the same others mirrored, alone, and in a
    batch of themselves; the model draws the same numbers each time and is put back in between. Of a
    model that draws at random only batches of one size are compared: in others it draws otherwise.

    Args:
        company: clouds of a batch, 2 at least.

    Returns:
        ``drift``: the largest root mean square change of the logits (each cloud's mean taken off)
        over their own root mean square; 0 but for rounding where an answer is a cloud's own.
        ``clouds``: how many were looked at. ``random``: whether answers hang on what is drawn.
        ``changed_buffers``: parameters and buffers that scoring changes.

    Raises:
        InputError: logits that are not finite.
    """
    model.eval()
    rows = generator(0, "company audit").permutation(len(dataset))
    size = max(2, company)
    kept = min(CLOUDS, len(rows), size // 2)
    others = np.resize(rows[kept:] if len(rows) > kept else rows, size - kept)
    points, named = inputs.of_rows(model, dataset, rows[:kept], device)
    mates, mates_named = inputs.of_rows(model, dataset, others, device)
    # One (b,N,C) tensor of all that a cloud is answered by, points first.
    points = torch.cat([points, *named.values()], dim=-1)
    mates = torch.cat([mates, *mates_named.values()], dim=-1)

    def ask(batch: Tensor) -> Tensor:
        parts = batch.split(3, dim=-1)
        given = dict(zip(named, (part.clone() for part in parts[1:]), strict=True))
        output = model(parts[0].clone(), **given)
        return as_prediction(output, len(batch), num_classes).class_logits.double()

    changed: set[str] = set()

    def answer(beside: Tensor | None, which: slice = slice(None), key: str = "audit") -> Tensor:
        batch = points[which] if beside is None else torch.cat([points[which], beside])
        with unchanged(model) as names, keyed_draws(key, device=device):
            logits = ask(batch)
        changed.update(names)
        logits = logits[: len(points[which])]
        if not bool(torch.isfinite(logits).all()):
            alone = "alone" if len(batch) == 1 else f"in a batch of {len(batch)}"
            raise InputError(
                f"a test cloud scored {alone} got class logits that are not finite; the model is "
                f"broken or its weights are"
            )
        return logits - logits.mean(dim=1, keepdim=True)

    before = answer(mates)
    compared = [answer(-mates)]
    scale = float(before.square().mean()) ** 0.5 or 1.0
    redrawn = answer(mates, key="another draw")
    random = _rms(redrawn - before) / scale > results.INDEPENDENT / 10
    if not random:
        alone = [answer(None, slice(i, i + 1)) for i in range(kept)]
        compared += [torch.cat(alone), answer(None)]
    return {
        "drift": max(_rms(after - before) for after in compared) / scale,
        "clouds": kept,
        "random": random,
        "changed_buffers": sorted(changed),
    }


def _rms(values: Tensor) -> float:
    return float(values.square().mean()) ** 0.5
