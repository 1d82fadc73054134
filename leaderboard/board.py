"""The board: columns of records that may be compared, and their rows.

A column is one pair of training and test data under one protocol, by digest: results that differ in
any of the three never share a column. A row is one model (and variant); its seeds are averaged.
What was tested under another condition than trained on makes no column, but ``curves``, or
``given`` where it was told the pose.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.protocol.protocol import PRESETS
from partialbench.benchmark.records.results import Result


class Pose(NamedTuple):
    """How well a row finds poses.

    Attributes:
        top_1, top_5: share of clouds whose true bin is among the 1, 5 most probable.
        median_deg: angle from the best bin to the truth, modulo symmetry, in degrees.
        within_30: share of clouds whose best bin errs by less than 30°.
    """

    top_1: float
    top_5: float
    median_deg: float
    within_30: float


@dataclass(frozen=True)
class Cell:
    """One row's results in one column.

    Attributes:
        results: one per seed, in seed order.
    """

    results: tuple[Result, ...]

    @property
    def seeds(self) -> int:
        return len(self.results)

    def mean(self, score: str = "accuracy") -> float:
        """Over seeds."""
        return _mean(r.scores[score] for r in self.results)

    def std(self, score: str = "accuracy") -> float | None:
        """Sample standard deviation over seeds; None for one seed."""
        if self.seeds < 2:
            return None
        return float(np.std([r.scores[score] for r in self.results], ddof=1))

    @property
    def pose(self) -> Pose | None:
        """How well poses are found, each figure a mean over seeds; None for a row without pose."""
        found = [r.scores["pose"] for r in self.results]
        if not all(found):
            return None
        return Pose(
            top_1=_mean(pose["top_k"][0] for pose in found),
            top_5=_mean(pose["top_k"][4] for pose in found),
            median_deg=_mean(pose["median_deg"] for pose in found),
            within_30=_mean(pose["within_30"] for pose in found),
        )

    @property
    def drift(self) -> float:
        """How far logits move when a cloud is turned, as a share of their size, over seeds."""
        return _mean(r.rotation_audit["drift"] for r in self.results)

    @property
    def cost(self) -> dict[str, Any]:
        """Of the last seed, which the newest code has measured."""
        return self.results[-1].cost

    @property
    def date(self) -> str:
        """The last day on which a seed was tested; "" where no record says."""
        return max(result.date for result in self.results)

    @property
    def per_class(self) -> dict[str, float]:
        """Accuracy over seeds of each class that has test clouds."""
        seeds = [r.scores["per_class"] for r in self.results]
        return {
            label: _mean(shares[label] for shares in seeds)
            for label, share in seeds[0].items()
            if share is not None
        }


@dataclass
class Column:
    """What may be compared.

    Attributes:
        key: ``Result.column``.
        title: as printed; has numbers of training clouds, or else digests, only where two columns
            would otherwise read the same.
        reported: key of the paper's own figures for this pair of data sets ("pm40>ps15"), or "".
        on_paper_data: whether the column's data are the paper's own, so that its figures may stand
            beside the column's without a word.
        cells: row name → cell.
    """

    key: tuple[str, ...]
    title: str
    reported: str
    on_paper_data: bool = False
    cells: dict[str, Cell] = field(default_factory=dict)

    @property
    def training_clouds(self) -> int:
        """Trained on in one pass, without those held out for validation."""
        return next(iter(self.cells.values())).results[0].train_data.clouds

    @property
    def slug(self) -> str:
        """The title without spaces and other signs, what the files of its figures are named by."""
        return re.sub(r"[^A-Za-z0-9.+]+", "-", self.title.replace("→", "to")).strip("-").lower()


def make_board(results: Iterable[Result]) -> list[Column]:
    """The columns of some results: a data set's own test set first, then others, by name."""
    grouped: dict[tuple[str, ...], dict[str, list[Result]]] = defaultdict(lambda: defaultdict(list))
    for result in sorted(results, key=lambda r: (r.run_name, r.seed)):
        if result.conditions:
            continue
        grouped[result.column][result.row].append(result)
    columns = []
    for key, cells in grouped.items():
        first = next(iter(cells.values()))[0]
        columns.append(
            Column(
                key,
                _title(first),
                _reported(first),
                _on_paper_data(first),
                {
                    row: Cell(tuple(sorted(found, key=lambda r: r.seed)))
                    for row, found in cells.items()
                },
            )
        )
    columns.sort(key=lambda column: (column.key[0], column.key[3] != column.key[0], column.title))
    _tell_apart(columns)
    return columns


def own_columns(board: list[Column]) -> list[Column]:
    """Those trained and tested on one data set, in one setting."""
    return [column for column in board if column.key[:2] == column.key[3:5]]


def ranked(column: Column) -> list[str]:
    """Row names, best accuracy first; equals by name."""
    return sorted(column.cells, key=lambda name: (-column.cells[name].mean(), name))


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))


def _title(result: Result) -> str:
    train, test = result.train_data, result.test_data
    sets = train.id if train.id == test.id else f"{train.id} → {test.id}"
    setting = train.setting if train.setting == test.setting else (
        f"{train.setting} → {test.setting}"
    )  # fmt: skip
    return f"{sets}, {setting}, {budget_title(result)}"


def budget_title(result: Result) -> str:
    """The protocol's title and the milestone: "board, 100k clouds"."""
    return f"{protocol_title(result)}, {milestones.name(result.clouds)} clouds"


def protocol_title(result: Result) -> str:
    """The preset and what was changed about it, "board stretch=1.25".

    "board+" where the preset itself has changed since.
    """
    used = dict(result.protocol)
    name = str(used.pop("preset"))
    preset = PRESETS.get(name.removesuffix("+"))
    if preset is None or preset.preset == name or preset.version != used["version"]:
        return name
    own = preset.as_dict()
    changed = (f"{field}={value}" for field, value in used.items() if own.get(field) != value)
    return " ".join([preset.preset, *changed])


def _reported(result: Result) -> str:
    """The paper's own name of the pair, by kind of data: its PM40 is our pm40 in every source."""
    data = (result.train_data, result.test_data)
    ids = [d.id.partition("-")[0] for d in data]
    if not set(ids) <= {"pm40", "ps15"} or any(d.setting != "partial" for d in data):
        return ""
    return ids[0] if ids[0] == ids[1] else ">".join(ids)


PAPER_CLASSES = {"pm40": 40, "ps15": 15}
"""Data set id → its number of classes in the paper. Made from anything else it is other data."""


def _on_paper_data(result: Result) -> bool:
    """Whether it was trained and tested on one of the paper's data sets, with all its classes.

    A folder of some of ModelNet40's classes has its id too, and a transfer its own rules.
    """
    train, test = result.train_data, result.test_data
    shares = result.scores["per_class"]
    return (
        train.id == test.id
        and train.setting == test.setting == "partial"
        and len(shares) == PAPER_CLASSES.get(train.id)
        and None not in shares.values()
    )


def _tell_apart(columns: list[Column]) -> None:
    """Adds to equal titles their numbers of training clouds, or else digits of their digests."""
    alike = defaultdict(list)
    for column in columns:
        alike[column.title].append(column)
    for same in alike.values():
        if len(same) == 1:
            continue
        sizes = {column.training_clouds for column in same}
        for column in same:
            digests = (column.key[2], column.key[5], column.key[6])
            column.title += (
                f" ({column.training_clouds:,} training clouds)"
                if len(sizes) == len(same)
                else " (" + " ".join(digest[:6] for digest in digests) + ")"
            )
