"""What can be said of the arguments of a training before anything heavy is imported or rendered.

A typo is answered in a second, not after torch and a data folder were loaded. What needs them (the
options, the data's classes) is checked later, but before the first step (``training.dry_run``).
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from partialbench import registry, user_code
from partialbench.errors import InputError

FULL_PRECISION = "32-true"
"""As Fabric names what is trained in unless another is asked for."""
PRECISIONS = {
    "32-true": FULL_PRECISION, "32": FULL_PRECISION, "bf16-mixed": "bf16-mixed",
    "bf16": "bf16-mixed", "16-mixed": "16-mixed", "16": "16-mixed",
}  # fmt: skip
"""What can be trained in, by Fabric's names and their short forms. Weights always have 32 bits."""


def check(
    model: str,
    *,
    data: Iterable[Path | str] = (),
    checkpoints: Iterable[Path | str] = (),
    results: Path | str | None = None,
    device: str = "auto",
    precision: str = FULL_PRECISION,
) -> None:
    """Raises ``InputError`` for an argument that cannot be right."""
    check_model(model)
    check_device(device)
    check_precision(precision)
    for weights in checkpoints:
        from partialbench.benchmark.training.find import find_checkpoint  # pydantic, not by --help

        find_checkpoint(weights)
    if results is not None:
        check_output(Path(results), "--results")
    for folder in data:
        check_data(Path(folder))


def check_names(given: Iterable[str], arguments: Iterable[str]) -> None:
    """Raises ``InputError`` for a keyword that is no field of the protocol.

    Args:
        arguments: of the function that was called: one of them may have been meant.
    """
    from partialbench.benchmark.protocol.protocol import FIELDS

    recipe = [field.name for field in dataclasses.fields(registry.Recipe)]
    for name in given:
        if name in FIELDS:
            continue
        if name in recipe:
            raise InputError(f"{name} is a field of the recipe: recipe={{{name!r}: …}}")
        near = registry.close_matches(name, {*arguments, *FIELDS})
        raise InputError(f"no argument and no field of the protocol is called {name!r}{near}")


def check_model(name: str) -> None:
    """A registered name, or a user's "module:factory" that can be looked for; nothing is run."""
    if user_code.is_own(name):
        user_code.find(name)
    else:
        registry.card(name)


def check_device(device: Any) -> tuple[str, int | None]:
    """The kind of a device and its number, None where none was given.

    Args:
        device: its name, or a ``torch.device``, which is called so too.
    """
    device = str(device)
    kind, colon, index = device.partition(":")
    if kind not in ("auto", "cpu", "cuda") or (colon and not (index.isascii() and index.isdigit())):
        raise InputError(f"device must be auto, cpu, cuda or cuda:0 …, got {device!r}")
    if colon and kind != "cuda":
        raise InputError(f"device {kind} has no number, got {device!r}; cuda has, as in cuda:1")
    return kind, int(index) if colon else None


def check_precision(precision: str | int) -> str:
    """The precision as Fabric names it in full."""
    if str(precision) not in PRECISIONS:
        known = sorted(set(PRECISIONS.values()))
        raise InputError(
            f"precision {precision!r} is not trained in; expected {', '.join(known)}: tests are in "
            f"32 bits, so weights are too"
        )
    return PRECISIONS[str(precision)]


def check_output(folder: Path, option: str) -> None:
    """Raises ``InputError`` where a folder is none, cannot be made or cannot be written to."""
    there = folder.absolute()
    while not os.path.lexists(there):
        there = there.parent
    if not there.is_dir():
        raise InputError(f"{option}: {there} is not a folder; choose another")
    if not os.access(there, os.W_OK | os.X_OK):
        raise InputError(f"{option}: {there} cannot be written to; choose another")


def check_data(folder: Path) -> None:
    """Raises ``InputError`` where a folder is not a finished one of ``partialbench render``."""
    from partialbench.dataset import manifest

    found = manifest.load(folder)
    if found.state != "complete":
        raise InputError(
            f"{folder} is unfinished (state {found.state!r}): run its render command again to "
            f"complete it"
        )
