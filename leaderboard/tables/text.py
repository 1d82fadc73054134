"""The board as Markdown and CSV: pure functions, so the same records give the same bytes."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence

from leaderboard.board import Column, ranked
from leaderboard.comparison import Comparison
from leaderboard.tables.curves import Family
from leaderboard.tables.given import GivenPoses
from leaderboard.tables.layouts import Layout
from leaderboard.tables.not_yet import Asked, sentence
from leaderboard.tables.plain import csv_cell, markdown
from leaderboard.words import (
    budget,
    crosses,
    describe,
    difference,
    duplicates,
    engineering,
    interval,
    model_input,
    networks,
    paper_score,
    percent,
    reported,
    reported_head,
    row_title,
    without_duplicates,
)


def as_markdown(
    board: list[Column],
    comparisons: list[Comparison],
    layouts: list[Layout],
    asked: Sequence[Sequence[Asked]],
) -> str:
    """One table for each column, best row first, with the paper's figure where it has one.

    Below it what is asked for there and is not there yet. The paper's own tables follow.
    """
    parts = ["# Leaderboard\n"]
    for column, comparison, of_column in zip(board, comparisons, asked, strict=True):
        parts += [f"## {markdown(column.title)}\n", markdown(describe(column)) + "\n"]
        head = ["model", "input", "accuracy", "95 % interval", "group", "behind the first"]
        names = ranked(column)
        repeated = duplicates(column) > 0
        if repeated:
            head.append("without duplicates")
        head.append("over classes")
        crossed = crosses(column)
        if crossed:
            head.append("shared classes only")
        posed = any(cell.pose for cell in column.cells.values())
        if posed:
            head += ["pose bin", "pose error"]
        head += ["turned", "parameters", "multiply-adds", "ms a cloud", "training", "seeds"]
        dated = any(cell.date for cell in column.cells.values())
        if dated:
            head.append("date")
        if column.reported:
            head.append(reported_head(column))
        lines = [head]
        for name in names:
            cell, result = column.cells[name], column.cells[name].results[0]
            line = [
                row_title(result),
                model_input(result),
                percent(cell.mean(), cell.std()),
                interval(*comparison.intervals[name]),
                " ".join(map(str, comparison.groups[name])),
                "–" if name == names[0] else difference(comparison.differences[names[0], name]),
            ]
            if repeated:
                line.append(without_duplicates(cell))
            line.append(percent(cell.mean("class_accuracy"), cell.std("class_accuracy")))
            if crossed:
                line.append(percent(cell.mean("restricted_accuracy"), None))
            if posed:
                pose = cell.pose
                line += (
                    [f"{100 * pose.top_1:.1f}", f"{pose.median_deg:.0f}°"] if pose else ["–", "–"]
                )
            cost = cell.cost
            line += [
                f"{100 * cell.drift:.1f}",
                f"{cost['parameters']:,}",
                engineering(cost["multiply_adds"]),
                f"{cost['batch_ms']:.2f}",
                budget(result),
                networks(cell),
            ]
            if dated:
                line.append(cell.date or "–")
            if column.reported:
                line.append(reported(column, result))
            lines.append(line)
        parts += [*_as_lines(lines), ""]
        if told := sentence(of_column):
            parts += [markdown(told), ""]
    parts += map(layout_as_markdown, layouts)
    parts.append(LEGEND)
    return "\n".join(parts)


def layout_as_markdown(layout: Layout) -> str:
    """One table under its title."""
    head = [f"## {markdown(layout.title)}\n", markdown(layout.about) + "\n"]
    return "\n".join([*head, *_as_lines([layout.head, *layout.rows]), ""])


def _as_lines(rows: list[list[str]]) -> list[str]:
    """Header, rule and rows, of plain texts."""
    head, *rest = ["| " + " | ".join(map(markdown, row)) + " |" for row in rows]
    return [head, "| " + " | ".join(["---"] * len(rows[0])) + " |", *rest]


LEGEND = """\
Accuracy in %: share of test clouds named rightly, mean ± standard deviation over seeds; the
interval is over test objects (bootstrap of whole objects). Rows that share a group number cannot be
told apart (paired test over objects and, where rows have several seeds, over seeds; Holm's
correction, 5 %); a row of one seed is one network, not a method. Behind the first: by how many
points, with a 95 % interval over objects; `differences.csv` has every pair of rows. Without
duplicates: the same without the test clouds of objects made from the very bytes of a training
object. Over classes: mean of the per-class accuracies. Pose bin: share of clouds whose best of the
60 bins is the true one under symmetry; pose error: median angle to the truth modulo symmetry.
Turned: how far the logits move when a cloud is turned, in % of their size (0 = invariant).
Multiply-adds and milliseconds are of the forward pass for one cloud, training is the clouds seen
(repeats counted) and the time of one seed (both on the hardware of each record). Reported figures
are the paper's own, on its data.
"""


def as_csv(board: list[Column], comparisons: list[Comparison]) -> str:
    """One line for each row and column, every score as a number."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["model", "variant", "train_data", "train_digest", "test_data", "test_digest", "preset",
         "protocol_digest", "clouds", "seeds", "accuracy", "accuracy_std", "interval_low",
         "interval_high", "groups", "duplicates", "accuracy_without_duplicates", "class_accuracy",
         "restricted_accuracy", "calibration_error", "pose_top1", "pose_top5", "pose_median_deg",
         "pose_within_30", "rotation_drift", "parameters", "multiply_adds", "latency_ms",
         "batch_ms", "train_clouds_seen", "train_seconds", "train_clouds_per_second",
         "peak_memory_bytes", "paper_reported", "paper_reported_other_data", "date"]
    )  # fmt: skip
    for column, comparison in zip(board, comparisons, strict=True):
        for name in ranked(column):
            cell = column.cells[name]
            first, std = cell.results[0], cell.std()
            low, high = comparison.intervals[name]
            posed = cell.pose or [None] * 4
            paper = paper_score(column, first)
            paper = None if paper is None else paper / 100
            alone = first.scores["accuracy_without_duplicates"]
            alone = None if alone is None else cell.mean("accuracy_without_duplicates")
            line = [
                first.model, first.variant, first.train_data.id, first.train_data.digest,
                first.test_data.id, first.test_data.digest, first.protocol["preset"],
                first.protocol_digest, first.clouds, cell.seeds, cell.mean(), std,
                None if math.isnan(low) else low, None if math.isnan(high) else high,
                " ".join(map(str, comparison.groups[name])), first.scores["duplicates"],
                alone, cell.mean("class_accuracy"),
                cell.mean("restricted_accuracy"), cell.mean("calibration_error"), *posed,
                cell.drift, cell.cost["parameters"],
                cell.cost["multiply_adds"], cell.cost["latency_ms"], cell.cost["batch_ms"],
                first.training["clouds_seen"], first.training["seconds"],
                first.training["clouds_per_second"], cell.cost["peak_memory_bytes"],
                *((paper, None) if column.on_paper_data else (None, paper)), cell.date,
            ]  # fmt: skip
            writer.writerow(
                [
                    ""
                    if v is None
                    else f"{v:.6f}"
                    if isinstance(v, float)
                    else csv_cell(v)
                    if isinstance(v, str)
                    else v
                    for v in line
                ]
            )
    return text.getvalue()


def curves_as_csv(families: list[Family], given_poses: list[GivenPoses]) -> str:
    """One line for each point of each curve, then for each pose that a row was given."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["column", "condition", "x", "row", "seeds", "accuracy", "interval_low", "interval_high",
         "pose_median_deg"]
    )  # fmt: skip
    for family in families:
        for name, points in family.curves.items():
            for p in points:
                pose_deg = math.nan if p.pose_deg is None else p.pose_deg
                figures = (p.accuracy, p.low, p.high, pose_deg)
                writer.writerow(
                    [csv_cell(family.column.title), csv_cell(family.condition), f"{p.x:g}",
                     csv_cell(name), p.seeds,
                     *("" if math.isnan(f) else f"{f:.6f}" for f in figures)]
                )  # fmt: skip
    for given in given_poses:
        for name, told in given.rows.items():
            for pose, accuracy in told.accuracy.items():
                writer.writerow(
                    [csv_cell(given.column.title), "pose", pose, csv_cell(name), told.seeds,
                     *("" if math.isnan(f) else f"{f:.6f}" for f in accuracy), ""]
                )  # fmt: skip
    return text.getvalue()


def differences_as_csv(board: list[Column], comparisons: list[Comparison]) -> str:
    """One line for each pair of rows of a column: by how much the better one is better."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["column", "row", "other", "difference", "low", "high", "p_holm"])
    for column, comparison in zip(board, comparisons, strict=True):
        for pair, found in comparison.differences.items():
            figures = [*found, comparison.p_values[pair]]
            writer.writerow(
                [
                    csv_cell(column.title),
                    *map(csv_cell, pair),
                    *("" if math.isnan(f) else f"{f:.6f}" for f in figures),
                ]
            )
    return text.getvalue()
