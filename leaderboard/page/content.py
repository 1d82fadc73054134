"""Everything the page says, as JSON data: a pure function of the board."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from leaderboard.board import Column
from leaderboard.comparison import Comparison
from leaderboard.page import facts, rows
from leaderboard.page.clouds import Sample, drawn
from leaderboard.scaling import FAR, Seen, extrapolate, group, learning_curves
from leaderboard.tables.curves import Family
from leaderboard.tables.given import GivenPoses, heading
from leaderboard.tables.layouts import Layout
from leaderboard.tables.not_yet import Asked, absent
from leaderboard.tables.settings import Loss, compared_rows
from leaderboard.tables.viewpoints import Curves
from leaderboard.words import (
    crosses,
    data_words,
    describe,
    duplicates,
    reported_head,
    row_title,
)
from partialbench.benchmark.protocol import milestones
from partialbench.dataset.loader import ShardDataset


@dataclasses.dataclass(frozen=True)
class Found:
    """What was found in a folder of records, all that the page is made from.

    Attributes:
        comparisons, asked, galleries: one for each column of the board.
        settings: each family of settings with its losses.
        views: accuracy and pose error over what a view shows.
        layouts: tables as text, shown behind a click.
        data: test splits that the galleries' clouds are of.
    """

    board: list[Column]
    comparisons: list[Comparison]
    settings: list[tuple[dict[str, Column], dict[str, list[Loss]]]]
    families: list[Family]
    given: list[GivenPoses]
    views: list[Curves]
    asked: list[list[Asked]]
    layouts: list[Layout]
    galleries: list[list[Sample]]
    data: list[ShardDataset]


def content(found: Found, folder: Path) -> dict[str, Any]:
    """Args: folder: of the records, with their predictions."""
    curves = learning_curves(found.board, found.comparisons)
    cards: dict[str, Any] = {}
    columns = []
    for column, comparison, asked, gallery in zip(
        found.board, found.comparisons, found.asked, found.galleries, strict=True
    ):
        for cell in column.cells.values():
            cards.setdefault(cell.results[0].model, rows.card(cell.results[0]))
        lines = rows.rows_of(column, comparison, folder)
        steps = _steps(column, found.settings)
        given = next((given_data(g) for g in found.given if g.column is column), None)
        first = next(iter(column.cells.values())).results[0]
        columns.append(
            {
                "group": _short_group(column),
                "name": column.title,
                "title": _without_milestone(column),
                "kind": kind(column),
                "milestone": milestones.name(first.clouds),
                "clouds": first.clouds,
                "about": describe(column),
                "classes": first.train_data.class_names,
                "crossed": crosses(column),
                "duplicates": duplicates(column),
                "reported": reported_head(column) if column.reported else "",
                "on_paper_data": column.on_paper_data,
                "what": data_words(column),
                "rows": lines,
                "facts": facts.sentences(column, lines, steps, given),
                "cost": facts.cost(lines),
                "settings": steps,
                "given": given,
                "conditions": [
                    condition_data(family) for family in found.families if family.column is column
                ],
                "views": [view_data(curves) for curves in found.views if curves.column is column],
                "asked": {each.name: len(each.seeds) for each in asked},
                "absent": [
                    {"id": each.name, "title": each.title, "state": each.state}
                    for each in absent(asked)
                ],
                "samples": [
                    {"cloud": sample.cloud, "answers": sample.answers} for sample in gallery
                ],
            }
        )
    return {
        "columns": columns,
        "cards": cards,
        "curves": {
            _short_group(column): _curve_data(curves[group(column)]) for column in found.board
        },
        "clouds": drawn([s for gallery in found.galleries for s in gallery], found.data),
        "far": FAR,
        "layouts": [dataclasses.asdict(layout) for layout in found.layouts],
    }


def _steps(
    column: Column, settings: list[tuple[dict[str, Column], dict[str, list[Loss]]]]
) -> dict[str, Any] | None:
    """The column's family of settings, or that of its nearest milestone; None where it has none."""
    related = [
        (family, lost)
        for family, lost in settings
        if any(group(column) == group(other) for other in family.values())
    ]
    if not related:
        return None
    clouds = _clouds(column)
    family, lost = min(
        related,
        key=lambda each: abs(math.log(_clouds(next(iter(each[0].values()))) / clouds)),
    )
    return setting_data(family, lost)


def _clouds(column: Column) -> int:
    return next(iter(column.cells.values())).results[0].clouds


def kind(column: Column) -> str:
    """Which tab a column is on: "partial", "complete" or "transfer"."""
    if column.key[:2] != column.key[3:5]:
        return "transfer"
    return "partial" if column.key[1].partition(",")[0] == "partial" else "complete"


def _short_group(column: Column) -> str:
    """The same for every milestone of one comparison; short enough for an address."""
    digests = (column.key[2], column.key[5], column.key[6])
    return "-".join([column.key[0], column.key[1], *(digest[:6] for digest in digests)])


def _without_milestone(column: Column) -> str:
    return re.sub(r", [^,(]* clouds(?= \(|$)", "", column.title)


def setting_data(family: dict[str, Column], lost: dict[str, list[Loss]]) -> dict[str, Any]:
    """Of each row that two settings have, or more: its accuracy in each, what each step costs."""
    return {
        "milestone": milestones.name(_clouds(next(iter(family.values())))),
        "settings": list(family),
        "sizes": [column.training_clouds for column in family.values()],
        "rows": [
            {
                "id": name,
                "title": row_title(
                    next(c.cells[name] for c in family.values() if name in c.cells).results[0]
                ),
                "shares": [
                    column.cells[name].mean() if name in column.cells else None
                    for column in family.values()
                ],
                "lost": [None if step is None else _finite(step) for step in lost[name]],
            }
            for name in compared_rows(family)
        ],
    }


def given_data(given: GivenPoses) -> dict[str, Any]:
    """Accuracies under each pose that rows were told, with intervals."""
    return {
        "poses": [[pose, heading(pose)] for pose in given.poses],
        "rows": [
            {
                "id": name,
                "title": row_title(given.column.cells[name].results[0]),
                "accuracy": {pose: _finite(found) for pose, found in told.accuracy.items()},
                "gain": None if told.gain is None else _finite(told.gain),
            }
            for name, told in given.rows.items()
        ],
    }


def condition_data(family: Family) -> dict[str, Any]:
    """Points as [x, accuracy, low, high, pose error in degrees or None]."""
    return {
        "condition": family.condition,
        "axis": family.axis,
        "rows": [
            {
                "id": name,
                "title": row_title(family.column.cells[name].results[0]),
                "points": [_finite((p.x, p.accuracy, p.low, p.high, p.pose_deg)) for p in points],
            }
            for name, points in family.curves.items()
        ],
    }


def view_data(curves: Curves) -> dict[str, Any]:
    """Row → for each bin [middle, clouds, accuracy, low, high, pose error, low, high]."""
    return {
        "quantity": curves.quantity,
        "rows": {
            name: [
                _short((p.start + p.end) / 2, p.clouds, p.accuracy, p.low, p.high,
                       p.pose_deg, p.pose_low, p.pose_high)
                for p in places
            ]
            for name, places in curves.rows.items()
        },
    }  # fmt: skip


def _curve_data(curves: dict[str, list[Seen]]) -> dict[str, Any]:
    """Row → points as [clouds, accuracy, low, high], and what a power law says of more."""
    found = {}
    for name, points in sorted(curves.items()):
        far = extrapolate(points)
        found[name] = {
            "points": [_finite(point) for point in points],
            "far": None if far is None else _finite(far),
        }
    return found


def _finite(values: Sequence[float | None]) -> list[float | None]:
    """As they are, for they are printed; None for NaN."""
    return [None if v is None or v != v else float(v) for v in values]


def _short(*values: float | None) -> list[float | None]:
    """Five digits, for figures; None for NaN."""
    return [None if v is None else float(f"{v:.5g}") for v in _finite(values)]
