"""Which file of weights a user means: a checkpoint, a run's folder, or a name that comes with us.

Needs no torch: what is not there is said before anything heavy is loaded.
"""

from __future__ import annotations

from pathlib import Path

from partialbench import given as doors
from partialbench import registry
from partialbench.benchmark.records import weights
from partialbench.benchmark.training.trunk import RunFolder, progress
from partialbench.errors import InputError

BRANCHES = "branch-*/checkpoint.pt"


def find_checkpoint(given: Path | str) -> Path:
    """The file that a path or a name means.

    Args:
        given: a checkpoint or packed weights; a run's folder, for its furthest milestone; a folder
            of results with one run; or the name of a model whose weights are in this release. A
            folder of that very name is ``./NAME``, and a ``Path`` is always a path.

    Raises:
        InputError: there is none, or more than one.
    """
    if isinstance(given, str) and given in weights.names():
        return weights.file_of(given)
    path = doors.path(given, "weights")
    if path.is_file():
        return path
    if not path.is_dir():
        if str(given) in registry.cards():
            raise InputError(
                f"no weights of {given} come with this release, and no file or folder is called "
                f"so; give what eval wrote{weights.but_these(str(given))}"
            )
        raise InputError(f"no checkpoint at {path}{weights.but_these(str(given))}")
    if (path / "checkpoint.pt").is_file():  # a milestone's own folder
        return path / "checkpoint.pt"
    found = [
        _furthest(run)
        for pattern in (".", "*", "runs/*")
        for run in sorted(path.glob(pattern) if pattern != "." else [path])
        if any(run.glob(BRANCHES))
    ]
    if not found:
        raise InputError(f"no checkpoint in {path}; expected one that partialbench eval wrote")
    if len(found) > 1:
        named = ", ".join(str(one.parents[1].relative_to(path)) for one in found[:6])
        raise InputError(f"{path} has {len(found)} runs, give the folder of one: {named}")
    return found[0]


def _furthest(run: Path) -> Path:
    """Of a training's finished milestones the one with the most clouds."""
    done = progress(run).milestones_done
    if not done:
        raise InputError(f"{run} has no finished milestone yet; run the same eval again")
    return RunFolder(run).branch(max(done))
