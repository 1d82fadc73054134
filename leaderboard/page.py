"""The board as one HTML file that asks no other host for anything."""

from __future__ import annotations

import base64
import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import jinja2

from leaderboard.board import Column, ranked
from leaderboard.comparison import Comparison
from leaderboard.gallery import Sample
from leaderboard.layouts import Layout
from leaderboard.words import (
    budget,
    crosses,
    describe,
    duplicates,
    engineering,
    paper_score,
    reported_head,
    row_title,
)

TEMPLATE = Path(__file__).with_name("page.html.jinja")


def as_html(
    board: list[Column],
    comparisons: list[Comparison],
    layouts: list[Layout],
    figures: dict[str, tuple[str, bytes]],
    galleries: list[list[Sample]],
) -> str:
    """The page.

    Args:
        layouts: the paper's tables.
        figures: file stem → (caption, SVG).
        galleries: for each column, the clouds its models disagree on.
    """
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["percent"] = lambda share: "–" if share is None else f"{100 * share:.1f}"
    template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
    columns = [
        _column(column, comparison) for column, comparison in zip(board, comparisons, strict=True)
    ]
    samples = [
        dataclasses.asdict(sample) | {"column": number}
        for number, gallery in enumerate(galleries)
        for sample in gallery
    ]
    # A figure's file ends in the name of its column, where it is of one.
    numbers = {column.slug: str(number) for number, column in enumerate(board)}
    return template.render(
        columns=columns,
        layouts=layouts,
        figures=[
            (numbers.get(stem.rpartition("_")[2], ""), caption, base64.b64encode(svg).decode())
            for stem, (caption, svg) in figures.items()
        ],
        samples=samples,
        # "</script" would end the element, whatever the quotes around it.
        samples_json=json.dumps(samples, separators=(",", ":")).replace("<", "\\u003c"),
    )


def _column(column: Column, comparison: Comparison) -> dict[str, Any]:
    rows = [_row(column, comparison, name) for name in ranked(column)]
    return {
        "title": column.title,
        "about": describe(column),
        "reported": reported_head(column) if column.reported else "",
        "crossed": crosses(column),
        "repeated": duplicates(column),
        "posed": any(row["pose"] for row in rows),
        "rows": rows,
    }


def _row(column: Column, comparison: Comparison, name: str) -> dict[str, Any]:
    cell = column.cells[name]
    first = cell.results[0]
    low, high = comparison.intervals[name]
    return {
        "title": row_title(first),
        "card": first.card,
        "deviations": first.deviations,
        "accuracy": cell.mean(),
        "std": cell.std(),
        "interval": None if math.isnan(low) else (low, high),
        "groups": " ".join(map(str, comparison.groups[name])),
        "without_duplicates": (
            None
            if first.scores["accuracy_without_duplicates"] is None
            else cell.mean("accuracy_without_duplicates")
        ),
        "class_accuracy": cell.mean("class_accuracy"),
        "restricted_accuracy": cell.mean("restricted_accuracy"),
        "calibration_error": cell.mean("calibration_error"),
        "pose": cell.pose,
        "drift": cell.drift,
        "parameters": cell.cost["parameters"],
        "parameters_text": f"{cell.cost['parameters']:,}",
        "multiply_adds": cell.cost["multiply_adds"],
        "multiply_adds_text": engineering(cell.cost["multiply_adds"]),
        "batch_ms": cell.cost["batch_ms"],
        "seeds": [r.seed for r in cell.results],
        "paper": paper_score(column, first),
        "per_class": list(cell.per_class.items()),
        "training": first.training,
        "budget": budget(first),
        "curves": [
            (label, _polyline(first.training["curve"][key]), first.training["curve"][key])
            for key, label in (("train_loss", "training loss"),
                               ("validation_accuracy", "validation accuracy"))
            if len(first.training["curve"][key]) > 1 and None not in first.training["curve"][key]
        ],
        "protocol": first.protocol,
    }  # fmt: skip


def _polyline(values: list[float]) -> str:
    """Values as the points of an SVG line in a box of 100 × 30, from lowest to highest."""
    low, high = min(values), max(values)
    span = high - low or 1.0
    return " ".join(
        f"{100 * i / (len(values) - 1):.1f},{29 - 28 * (value - low) / span:.1f}"
        for i, value in enumerate(values)
    )
