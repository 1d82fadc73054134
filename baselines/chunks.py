"""A few rows at a time, so that what is made of them stays in a cache."""

from __future__ import annotations

import torch

CHUNK, DEVICE_CHUNK = 1 << 20, 1 << 26
"""Values handled at a time where a product is not kept: 4 MB, which stays in a core's cache, and on
other devices 256 MB, so that there are few launches and little memory still."""


def chunks(rows: int, values_per_row: int, device: torch.device) -> list[slice]:
    values = CHUNK if device.type == "cpu" else DEVICE_CHUNK
    step = max(1, values // values_per_row)
    return [slice(start, min(start + step, rows)) for start in range(0, rows, step)]
