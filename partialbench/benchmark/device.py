"""The device that a name asks for."""

from __future__ import annotations

import torch

from partialbench.benchmark.preflight import check_device
from partialbench.errors import InputError


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
