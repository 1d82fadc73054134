"""Main effects of a factorial study, from records, with intervals that include seeds.

    python -m leaderboard.effects leaderboard/records --clouds 200k --data pm40-clouds \\
        --models papnet-steered --factors pose_weight ray stretch

A factor is an option of the model, a field of the protocol or of the recipe, or "model" itself. The
effect of a factor is the mean of the cells at its higher level less that of those at its lower one,
the others balanced; of two together, how much the one's effect grows with the other's level. Every
cell of the factors' levels must have records of as many seeds as there are; what else could differ
between the cells must not.
"""

from __future__ import annotations

import argparse
import inspect
import itertools
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from leaderboard.comparison import correct
from leaderboard.tables.layouts import Layout
from leaderboard.tables.text import layout_as_markdown
from leaderboard.words import difference, percent
from partialbench import registry
from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.protocol.recipe import LATER, of_training
from partialbench.benchmark.records import results
from partialbench.benchmark.records.results import Result
from partialbench.benchmark.testing.uncertainty import Contrast, contrast
from partialbench.errors import InputError
from partialbench.options import plain

MODEL = "model"
Cell = tuple[Any, ...]
"""The level of each factor."""


@dataclass(frozen=True)
class Study:
    """A full factorial of two-level factors.

    Attributes:
        factors: name → its two levels, the lower first.
        accuracy: cell → the accuracy of each of its seeds.
        effects: one or two factors' names → by how much they raise the accuracy.
    """

    factors: dict[str, tuple[Any, Any]]
    accuracy: dict[Cell, list[float]]
    effects: dict[tuple[str, ...], Contrast]


def level(result: Result, factor: str) -> Any:
    """The level of a factor in a record: as it was set, or the default of the model's factory.

    Raises:
        InputError: the model has no such option, the protocol and the recipe no such field.
    """
    if factor == MODEL:
        return result.model
    for fields in (result.options, result.protocol, {**LATER, **result.recipe}):
        if factor in fields:
            return fields[factor]
    default = _defaults(result.model).get(factor, inspect.Parameter.empty)
    if default is inspect.Parameter.empty:
        raise InputError(
            f"{result.model} has no option {factor!r}, nor have the protocol and its recipe a "
            f"field of that name; a factor is one of these, or '{MODEL}'"
        )
    return default


def _defaults(model: str) -> dict[str, Any]:
    parameters = inspect.signature(registry.factory_of(model)).parameters
    return {name: p.default for name, p in parameters.items()}


def analyse(records: Sequence[Result], folder: Path, factors: Sequence[str]) -> Study:
    """The main effects and the interactions of two factors each.

    Args:
        records: of one pair of data sets and one milestone.
        folder: of the records, with their predictions.

    Raises:
        InputError: a factor without exactly two levels, a cell without records, cells with other
            seeds than the rest or only one each, or that differ in more than the factors.
    """
    cells: dict[Cell, list[Result]] = {}
    for result in records:
        cells.setdefault(tuple(level(result, f) for f in factors), []).append(result)
    levels = {f: _two_levels(f, {cell[i] for cell in cells}) for i, f in enumerate(factors)}
    order = list(itertools.product(*levels.values()))
    missing = [cell for cell in order if cell not in cells]
    if missing:
        named = "; ".join(_named(factors, cell) for cell in missing)
        raise InputError(f"no records of {named}: effects need every combination of the levels")
    for cell in order:
        cells[cell].sort(key=lambda r: r.seed)
    _require_alike(cells, factors)
    values, means, reference = [], [], None
    for cell in order:
        seeds = []
        for result in cells[cell]:
            rows, object_ids, right = correct(result, folder)
            if reference is None:
                reference = rows, object_ids
            elif not np.array_equal(reference[0], rows):
                raise InputError(f"{result.run_name} was not tested on the clouds of the others")
            seeds.append(right)
        values.append(np.mean(seeds, axis=0))
        means.append([float(np.mean(right)) for right in seeds])
    assert reference is not None
    signs = {f: _signs(i, len(factors)) for i, f in enumerate(factors)}
    wanted: list[tuple[str, ...]] = [(f,) for f in factors]
    wanted += itertools.combinations(factors, 2)
    effects = {
        names: contrast(
            np.stack(values, axis=1), reference[1], means,
            np.prod([signs[name] for name in names], axis=0) * 2 ** len(names) / len(order),
        )
        for names in wanted
    }  # fmt: skip
    return Study(levels, dict(zip(order, means, strict=True)), effects)


def _two_levels(factor: str, found: set[Any]) -> tuple[Any, Any]:
    if len(found) != 2:
        raise InputError(
            f"{factor} has the levels {sorted(map(str, found))} in these records; a factor has two"
        )
    low, high = sorted(found, key=lambda value: (isinstance(value, str), value))
    return low, high


def _signs(factor: int, factors: int) -> np.ndarray:
    """(2^factors,) −1 or +1: the level of one in each cell, in the order of ``product``."""
    return np.array([2 * cell[factor] - 1 for cell in itertools.product((0, 1), repeat=factors)])


def _require_alike(cells: Mapping[Cell, list[Result]], factors: Sequence[str]) -> None:
    seeds = {cell: [r.seed for r in found] for cell, found in cells.items()}
    for cell, found in seeds.items():
        if len(set(found)) < len(found):
            raise InputError(
                f"{_named(factors, cell)} has several records of one seed ({found}): they differ "
                f"in more than {', '.join(factors)}; leave some out with --where"
            )
    if len({tuple(s) for s in seeds.values()}) > 1:
        told = "; ".join(f"{_named(factors, cell)}: {s}" for cell, s in seeds.items())
        raise InputError(f"the cells have different seeds ({told}); give those that all have")
    if len(next(iter(seeds.values()))) < 2:
        raise InputError("each cell has one seed: nothing says how trainings vary")
    ways = {_beside(r, factors) for found in cells.values() for r in found}
    if len(ways) > 1:
        first, second, *_ = sorted(ways)
        apart = sorted(set(first) ^ set(second))
        raise InputError(
            f"the records differ in more than {', '.join(factors)}: "
            f"{', '.join(f'{name}={value}' for name, value in apart)}; name it as a factor, or "
            f"leave records out with --where"
        )


def _beside(result: Result, factors: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """What must be the same in all cells: everything but the factors."""
    fields = {
        **{f"recipe {k}": v for k, v in of_training(result.recipe).items()},
        **{f"protocol {k}": v for k, v in result.protocol.items() if k != "preset"},
        **{f"option {k}": v for k, v in result.options.items()},
        "model": result.model, "trained on": result.train_data.digest, "clouds": result.clouds,
        "tested on": result.test_data.digest,
    }  # fmt: skip
    if MODEL in factors:  # a model's own recipe and options go with it
        fields = {k: v for k, v in fields.items() if not k.startswith(("recipe ", "option "))}
    return tuple(
        sorted((k, str(v)) for k, v in fields.items() if k.rpartition(" ")[2] not in factors)
    )


def _named(factors: Sequence[str], cell: Cell) -> str:
    return ", ".join(f"{f}={value}" for f, value in zip(factors, cell, strict=True))


def as_layouts(study: Study) -> list[Layout]:
    """The cells, then the effects in points of accuracy."""
    seeds = len(next(iter(study.accuracy.values())))
    cells = [
        [*map(str, cell), percent(float(np.mean(found)), float(np.std(found, ddof=1)))]
        for cell, found in study.accuracy.items()
    ]
    effects = [
        [
            " × ".join(_change(study, name) for name in names),
            difference((found.value, found.low, found.high)),
            f"{found.p_value:.3f}", f"{100 * found.objects:.2f}", f"{100 * found.seeds:.2f}",
        ]
        for names, found in study.effects.items()
    ]  # fmt: skip
    return [
        Layout(
            "Accuracy (%) of every cell",
            f"Mean and standard deviation of {seeds} seeds.",
            [*study.factors, "accuracy"],
            cells,
        ),
        Layout(
            "Effects, in points of accuracy",
            "Of a factor's higher level over its lower one, the others balanced, and of two: how "
            "much the one's effect grows with the other. In brackets the 95 % interval over test "
            "objects and trainings; then p, and the standard errors of the two.",
            ["effect", "points", "p", "over objects", "over seeds"],
            effects,
        ),
    ]


def _change(study: Study, name: str) -> str:
    low, high = study.factors[name]
    return f"{name} {low} → {high}"


def select(
    records: Iterable[Result],
    models: Sequence[str],
    data: str,
    test: str,
    clouds: int,
    where: Mapping[str, Any],
) -> list[Result]:
    """The records of a study: of these models, data and milestone, under no other condition.

    Args:
        where: option or field → its value. A model that has none of that name is kept: it is as
            the others are with that value.
    """  # fmt: skip
    kept = []
    for result in records:
        ids = (result.train_data.id, result.test_data.id, result.clouds)
        if (
            result.model in models
            and ids == (data, test, clouds)
            and not result.conditions
            and all(_fits(result, name, value) for name, value in where.items())
        ):
            kept.append(result)
    if not kept:
        raise InputError(
            f"no records of {', '.join(models)} on {data}, tested on {test}, at "
            f"{milestones.name(clouds)} clouds"
        )
    return kept


def _fits(result: Result, name: str, value: Any) -> bool:
    try:
        return bool(level(result, name) == value)
    except InputError:
        return True


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("records", type=Path, help="a folder of records")
    parser.add_argument("--models", nargs="+", required=True)
    parser.add_argument("--factors", nargs="+", required=True)
    parser.add_argument("--data", required=True, help="trained on: pm40-clouds")
    parser.add_argument("--test", help="tested on; by default the same")
    parser.add_argument("--clouds", required=True, help="the milestone: 200k")
    parser.add_argument("--where", nargs="*", default=[], help="pose_weight=0")
    given = parser.parse_args()
    where = {name: plain(value) for name, _, value in (w.partition("=") for w in given.where)}
    records = select(
        results.read_folder(given.records), given.models, given.data, given.test or given.data,
        milestones.parse(given.clouds), where,
    )  # fmt: skip
    study = analyse(records, given.records, given.factors)
    sys.stdout.write("\n".join(layout_as_markdown(layout) for layout in as_layouts(study)))


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(f"error: {error}")
