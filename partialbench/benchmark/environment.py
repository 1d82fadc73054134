"""On what, and with what, a result was made."""

from __future__ import annotations

import os
import platform
import subprocess
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

import partialbench
from partialbench.benchmark.preflight import FULL_PRECISION

if TYPE_CHECKING:
    from lightning.fabric import Fabric

PACKAGES = ("numpy", "scipy", "torch", "lightning", "e3nn")


def precision_of(fabric: Fabric) -> str:
    """As Fabric names it in full: "bf16-mixed" where "bf16" was asked for."""
    return str(fabric.strategy.precision.precision)


def describe(
    device: torch.device, processes: int = 1, precision: str = FULL_PRECISION
) -> dict[str, Any]:
    """JSON data: hardware, versions, and the commit of the source tree (None outside one)."""
    if device.type == "cuda":
        accelerator = torch.cuda.get_device_name(device)
    else:
        accelerator = device.type
    return {
        "device": accelerator,
        "processes": processes,
        "precision": precision,
        "cpu": _cpu_name(),
        # Processors of one name differ in it, and in speed by as much as two.
        "instructions": torch.backends.cpu.get_cpu_capability(),
        **_half_precision(device, precision),
        "cores": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count(),
        "threads": torch.get_num_threads(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "packages": {"partialbench": partialbench.__version__}
        | {name: metadata.version(name) for name in PACKAGES},
        "git_commit": git_commit(),
    }


def _half_precision(device: torch.device, precision: str) -> dict[str, bool]:
    """Whether a CPU's products in bfloat16 were its own instructions, where it was trained in."""
    if device.type != "cpu" or precision != "bf16-mixed":
        return {}
    return {"bf16_instructions": bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())}


def git_commit() -> str | None:
    """The commit this package's source tree is at, with "+changes" where files differ from it.

    For a copy without its repository, as in a container, the variable PARTIALBENCH_COMMIT says it.
    """
    root = Path(partialbench.__file__).resolve().parents[1]
    if not (root / ".git").exists():
        return os.environ.get("PARTIALBENCH_COMMIT")
    try:
        commit = _git(root, "rev-parse", "HEAD")
        changed = _git(root, "status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.SubprocessError):
        return None
    return commit + ("+changes" if changed else "")


def _git(root: Path, *arguments: str) -> str:
    done = subprocess.run(
        ["git", "-C", str(root), *arguments],
        check=True, capture_output=True, text=True, timeout=20,
    )  # fmt: skip
    return done.stdout.strip()


def _cpu_name() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
