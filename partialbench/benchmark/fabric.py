"""On which device, in how many processes and in what precision a training runs."""

from __future__ import annotations

import os
import warnings

import torch
from lightning.fabric import Fabric
from lightning.fabric.strategies import DDPStrategy

from partialbench.benchmark.device import find_device, say_slow_bf16
from partialbench.benchmark.preflight import check_precision
from partialbench.errors import InputError


def make_fabric(device: str, precision: str) -> Fabric:
    """A launched Fabric on ``device``; with torchrun's variables set, one process of many."""
    kind, index = find_device(device)
    precision = check_precision(precision)
    if kind == "cpu" and precision == "bf16-mixed":
        say_slow_bf16()
    processes, nodes = 1, 1
    if "LOCAL_WORLD_SIZE" in os.environ:  # torchrun sets it
        processes = int(os.environ["LOCAL_WORLD_SIZE"])
        nodes = int(os.environ["WORLD_SIZE"]) // processes
    several = processes * nodes > 1
    if several:
        # It is said for every model that has no such parameter, which is most.
        warnings.filterwarnings("ignore", "find_unused_parameters=True was specified")
    try:
        fabric = Fabric(
            accelerator=kind,
            devices=[index] if index is not None else processes,
            num_nodes=nodes,
            # A head that the loss does not reach trains in one process, so it does in several.
            strategy=DDPStrategy(find_unused_parameters=True) if several else "auto",
            precision=precision,  # type: ignore[arg-type]
        )
    except ValueError as error:
        raise InputError(f"device {device!r}, precision {precision!r}: {error}") from error
    fabric.launch()
    # cuDNN would round what it convolves to 10 bits, in tests too, and call it 32.
    torch.backends.cudnn.allow_tf32 = False
    return fabric
