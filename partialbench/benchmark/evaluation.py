"""``evaluate``: the benchmark's whole test of a model, from Python."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

from torch import nn

from partialbench import registry, user_code
from partialbench.benchmark import preflight
from partialbench.benchmark.predict import Classifier
from partialbench.benchmark.records.results import Result
from partialbench.benchmark.run import run_eval
from partialbench.errors import InputError

_TAKEN = {*inspect.signature(run_eval).parameters} - {"results_folder", "protocol_overrides"}
"""Arguments of ``run_eval`` that are called so here too."""


def evaluate(
    model: str | Classifier | Callable[..., nn.Module],
    data: Path | str | None = None,
    *,
    results: Path | str = "results",
    **options: Any,
) -> list[Result]:
    """Trains a model under the protocol and tests it; or tests one that is trained.

    Called again it goes on where it stopped. What is written to ``results`` is what
    ``leaderboard`` makes its tables from.

    Args:
        model: a registered name; your factory, "module:factory" or the function or class itself,
            which is called as factory(num_classes) and must be in a file of its own, so that a
            record can say what was tested; or a ``Classifier``, whose weights are tested as they
            are.
        data: folder of ``partialbench render``; None where ``test_data`` or ``test_grid`` has what
            is to be tested on.
        results: where records go.
        options: those of ``run.run_eval``: ``preset``, ``clouds``, ``seeds``, ``device``,
            ``test_data``, ``recipe``, …, and fields of the protocol.

    Returns:
        One ``Result`` for each milestone, seed and test set: ``result.scores["accuracy"]``.

    Raises:
        InputError: see ``run_eval``; or a model that no record could name.

    ::

        from my_model import make                       # my_model.py: def make(num_classes): …
        for result in partialbench.evaluate(make, "data/pm40", preset="smoke"):
            print(result.row, result.scores["accuracy"])
    """
    preflight.check_names([n for n in options if n not in _TAKEN], {*_TAKEN, "results"})
    if isinstance(model, Classifier):
        if "checkpoint_file" in options:
            raise InputError("give a Classifier or checkpoint_file, not both")
        options["checkpoint_file"] = model.path
        return run_eval(model.name, data, results_folder=results, **options)
    return run_eval(name_of(model), data, results_folder=results, **options)


def name_of(model: str | Callable[..., nn.Module]) -> str:
    """The name by which a record tells of a model: as given, registered, "module:factory" of the
    current folder as the command line would have it, or "file.py:factory" of another.

    Raises:
        InputError: a factory that cannot be found again from a file.
    """
    if isinstance(model, str):
        return model
    if isinstance(model, nn.Module) or not callable(model):
        raise InputError(
            f"got a {type(model).__name__}; expected a model's name, a factory that makes one for "
            f"a number of classes, or a Classifier (load_model) for weights that are trained"
        )
    module, name = getattr(model, "__module__", ""), getattr(model, "__qualname__", "")
    for card in registry.cards().values():
        if card.entry == f"{module}:{name}":
            return card.name
    file = inspect.getsourcefile(model) if name else None
    if module == "__main__" or not file or not Path(file).is_file():
        raise InputError(
            f"{name or model!r} is of {module or 'no module'}; a record must be able to say which "
            f"code was tested: put the factory into a file of its own, my_model.py, and import it"
        )
    if not name.isidentifier():
        raise InputError(
            f"{name} of {module} has no name in its file by which a record could tell of it: "
            f"define it there as a function, def make(num_classes): …"
        )
    path, plain = Path(file).resolve(), f"{module}:{name}"
    found = user_code.find(plain)
    # One name for one model, however it was given: two would be two rows.
    if found is not None and found.resolve() == path:
        return plain
    return user_code.named(f"{path}:{name}")
