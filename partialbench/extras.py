"""Which extra of the distribution a library comes with, and what to say where it is not there.

The core reads, verifies and keeps records with NumPy, SciPy and HDF5 alone. Everything else is
imported where it is used; what is missing then is named with the line that installs it.
"""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterator
from types import ModuleType

from partialbench.errors import PartialbenchError

EXTRAS: dict[str, tuple[str, ...]] = {
    "render": ("mitsuba", "drjit", "trimesh", "manifold3d", "mapbox_earcut", "lxml", "DracoPy"),
    "scan": ("open3d",),
    "train": ("torch", "lightning", "e3nn", "roma", "safetensors"),
    "board": ("matplotlib", "jinja2", "pandas"),
    "export": ("pyarrow", "PIL"),
    "cluster": ("distributed", "dask"),
    "log": ("tensorboard",),
    "stereo": ("cv2",),
}
"""Extra → the libraries, by the names they are imported by, that only it brings."""


class MissingExtraError(PartialbenchError, ImportError):
    """A library is not installed; the message has the line that installs it."""


def extra_of(module: str) -> str | None:
    """The extra that brings a module ("torch.utils" → "train"), None for any other module."""
    top = module.partition(".")[0]
    return next((extra for extra, modules in EXTRAS.items() if top in modules), None)


def explained(error: ImportError) -> MissingExtraError | None:
    """What to tell a user of a failed import; None where no extra would mend it."""
    extra = extra_of(error.name or "")
    if extra is None or not isinstance(error, ModuleNotFoundError):
        return None
    return MissingExtraError(
        f"{error.name} is not installed, and this needs it: pip install 'partialbench[{extra}]'"
    )


@contextlib.contextmanager
def needed() -> Iterator[None]:
    """Turns an import that fails for want of an extra into ``MissingExtraError``."""
    try:
        yield
    except ImportError as error:
        said = explained(error)
        if said is None:
            raise
        raise said from error


def load(module: str) -> ModuleType:
    """An installed module; ``MissingExtraError`` where its extra is missing."""
    with needed():
        return importlib.import_module(module)
