"""The device that a name asks for."""

from __future__ import annotations

import logging
import time

import torch

from partialbench.benchmark.preflight import check_device
from partialbench.errors import InputError

log = logging.getLogger(__name__)


def bf16_gain() -> float:
    """How many times as fast a product of matrices is on this CPU in bfloat16 as in 32 bits."""
    a = torch.rand(256, 256)
    seconds = {}
    for kind in (torch.float32, torch.bfloat16):
        left, taken = a.to(kind), []
        for _ in range(6):
            start = time.perf_counter()
            left @ left
            taken.append(time.perf_counter() - start)
        seconds[kind] = min(taken)  # the first is warm-up, and others may use the processor
    return seconds[torch.float32] / seconds[torch.bfloat16]


def say_slow_bf16() -> None:
    """Warns where bfloat16 was asked for and the processor computes it more slowly."""
    gain = bf16_gain()
    if gain < 1:
        log.warning(
            "bf16 was asked for, but on this processor a product in bfloat16 takes %.1f times as "
            "long as in 32 bits: it trains in bf16 all the same; leave --precision out to be "
            "faster", 1 / gain,
        )  # fmt: skip


def find_device(device: str) -> tuple[str, int | None]:
    """The kind of a device that is there, "cpu" or "cuda", and its number or None.

    "auto" is CUDA where there is some. Not Fabric's choice: on a Mac that is a device without
    64-bit numbers.

    Raises:
        InputError: no such device.
    """
    kind, index = check_device(device)
    if kind == "auto":
        kind = "cuda" if torch.cuda.is_available() else "cpu"
    if kind == "cuda" and not torch.cuda.is_available():
        raise InputError("device cuda was asked for, but torch sees no CUDA device; give cpu")
    if index is not None and index >= torch.cuda.device_count():
        raise InputError(
            f"device {device} was asked for, but torch sees {torch.cuda.device_count()} CUDA "
            f"device(s), counted from 0"
        )
    return kind, index
