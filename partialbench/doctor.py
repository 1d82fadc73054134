"""``partialbench doctor``: what works on this machine, found by trying it."""

from __future__ import annotations

import importlib
import importlib.util
import os
import platform
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from partialbench import __version__, extras
from partialbench.errors import PartialbenchError

CORE = ("numpy", "scipy", "h5py", "pydantic", "typer", "rich")


@dataclass(frozen=True)
class Finding:
    """One thing that was tried.

    Attributes:
        what: in a few words.
        works: whether it does.
        details: of what version it is; where it does not work, what to do.
        needed: by every command.
    """

    what: str
    works: bool
    details: str
    needed: bool = False


def examine() -> list[Finding]:
    """Everything that a command may need, in the order of the data."""
    system = f"{platform.system()} {platform.machine()}, {_cores()} cores"
    about = f"{__version__}, Python {platform.python_version()}, {system}"
    return [
        Finding("partialbench", True, about, needed=True),
        *(_library(name, needed=True) for name in CORE),
        *(_extra(name) for name in extras.EXTRAS),
        *_variants(),
        _open3d(),
        *_torch(),
        _temporary_space(),
    ]


def _cores() -> int:
    """Those this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return ""


def _tried(what: str, attempt: Callable[[], str], needed: bool = False) -> Finding:
    """What an attempt says, or why it failed, on one line."""
    try:
        return Finding(what, True, attempt(), needed)
    except PartialbenchError as error:
        reason = str(error)
    except Exception as error:  # a library that is broken fails in any way there is
        reason = f"{type(error).__name__}: {error}"
    return Finding(what, False, " ".join(reason.split())[:300], needed)


def _library(name: str, needed: bool) -> Finding:
    def attempt() -> str:
        importlib.import_module(name)
        return _version(name)

    return _tried(name, attempt, needed)


def _extra(name: str) -> Finding:
    """Whether all libraries of an extra are there; none is imported."""
    missing = [module for module in extras.EXTRAS[name] if not _is_there(module)]
    if missing:
        return Finding(
            f"extra [{name}]", False,
            f"{', '.join(missing)} missing: pip install 'partialbench[{name}]'",
        )  # fmt: skip
    return Finding(f"extra [{name}]", True, ", ".join(extras.EXTRAS[name]))


def _is_there(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ImportError:
        return False


def _variants() -> list[Finding]:
    """Each of Mitsuba's variants, by tracing a ray."""
    from partialbench import registry

    def attempt(name: str) -> str:
        registry.load(registry.PICK_VARIANT)(name)
        return "traces a ray"

    names = ("cuda_ad_rgb", "llvm_ad_rgb", "scalar_rgb")
    return [_tried(f"Mitsuba {name}", lambda name=name: attempt(name)) for name in names]  # type: ignore[misc]


def _open3d() -> Finding:
    def attempt() -> str:
        return str(extras.load("open3d").__version__)

    found = _tried("Open3D (simulated scans)", attempt)
    if "cannot open shared object" in found.details:
        lacking = found.details.partition("ImportError: ")[2].partition(":")[0] or found.details
        return Finding(
            found.what, False,
            f"the system library {lacking} is missing; on Debian or Ubuntu: sudo apt-get install "
            f"-y libgl1 libegl1 libx11-6 libusb-1.0-0 libgomp1",
        )  # fmt: skip
    return found


def _torch() -> list[Finding]:
    def version() -> str:
        torch = extras.load("torch")
        return f"{torch.__version__}, {torch.get_num_threads()} threads"

    def bf16() -> str:
        extras.load("torch")
        from partialbench.benchmark.device import bf16_gain

        return f"a product is {bf16_gain():.1f} times as fast as in 32 bits"

    def cuda() -> str:
        torch = extras.load("torch")
        if not torch.cuda.is_available():
            raise PartialbenchError("torch sees no CUDA device; everything runs on the CPU")
        torch.ones(8, device="cuda").sum().item()
        return ", ".join(torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count()))

    return [
        _tried("torch", version),
        _tried("bfloat16 on the CPU", bf16),
        _tried("CUDA", cuda),
    ]


def _temporary_space() -> Finding:
    folder = Path(tempfile.gettempdir())
    free = shutil.disk_usage(folder).free / 2**30
    return Finding("temporary files", free > 1, f"{free:.0f} GiB free in {folder}")
