"""The board's figures as SVG and PNG, the same bytes for the same records."""

from __future__ import annotations

import hashlib
import io
import itertools
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from leaderboard.board import Column, ranked
from leaderboard.comparison import Comparison, counted
from leaderboard.tables.curves import Family
from leaderboard.tables.given import OWN, PER_CLASS, RANDOM, GivenPoses
from leaderboard.tables.layouts import noise_title
from leaderboard.tables.settings import compared_rows, setting_families
from leaderboard.words import engineering, paper_score, row_title
from partialbench.benchmark.records import results
from partialbench.benchmark.testing.metrics import (
    VISIBILITY_EDGES,
    best_pose_errors_deg,
    confusion,
    visibility_bins,
)

# Ids inside an SVG are hashed with this; matplotlib would draw them at random.
_STYLE: dict[Any, Any] = {
    "svg.hashsalt": "partialbench", "svg.fonttype": "path", "font.size": 9,
    # Names are text, whatever signs of mathematics are in them.
    "text.parse_math": False,
    "axes.spines.top": False, "axes.spines.right": False, "figure.dpi": 150,
}  # fmt: skip
K_TICKS = (1, 5, 10, 15, 20)
FEW_CLOUDS = 10
"""A share of fewer clouds says little, and is not drawn."""


def draw_all(
    board: list[Column],
    comparisons: list[Comparison],
    families: list[Family],
    given_poses: list[GivenPoses],
    folder: Path,
) -> dict[str, tuple[str, Figure]]:
    """File stem → (caption, figure). Only figures that have something to show are made."""
    figures: dict[str, tuple[str, Figure]] = {}
    slugs = _slugs(board)
    with mpl.rc_context(_STYLE):
        settings = _by_setting(board)
        if settings is not None:
            figures["settings"] = ("Aligned, rotated and partial clouds", settings)
        for column, comparison in zip(board, comparisons, strict=True):
            slug = slugs[column.key]
            figures[f"accuracy_{slug}"] = (
                f"Accuracy with 95 % intervals over objects: {column.title}",
                _accuracy(column, comparison),
            )
            figures[f"visibility_{slug}"] = (
                f"Accuracy against the share of the surface that is seen: {column.title}",
                _visibility(column),
            )
            seen = _pose_visibility(column, folder)
            if seen is not None:
                figures[f"pose_visibility_{slug}"] = (
                    f"Pose error against the share of the surface that is seen: {column.title}",
                    seen,
                )
            figures[f"cost_{slug}"] = (
                f"Accuracy against multiply-adds of one cloud: {column.title}", _cost(column),
            )  # fmt: skip
            pose = _top_k(column)
            if pose is not None:
                figures[f"pose_{slug}"] = (
                    f"Top-k accuracy of the pose bin: {column.title}",
                    pose,
                )
            poses = _ensemble(column)
            if poses is not None:
                figures[f"ensemble_{slug}"] = (
                    f"Accuracy against the number of poses that decide: {column.title}",
                    poses,
                )
            figures[f"confusion_{slug}"] = (
                f"Confusion of {row_title(column.cells[ranked(column)[0]].results[0])}, all seeds: "
                f"{column.title}",
                _confusion(column, folder),
            )
        for family in families:
            title = f"the {family.axis}: {family.column.title}"
            figures[f"{family.condition}_{slugs[family.column.key]}"] = (
                f"Accuracy against {title}", _curves(family),
            )  # fmt: skip
            poses = _pose_curves(family)
            if poses is not None:
                figures[f"pose_{family.condition}_{slugs[family.column.key]}"] = (
                    f"Pose error against {title}", poses,
                )  # fmt: skip
        for given in given_poses:
            figures[f"given_pose_{slugs[given.column.key]}"] = (
                "Accuracy under a given pose (dashed: the model's own; dotted: a random one): "
                f"{given.column.title}",
                _given(given),
            )
    return figures


def _slugs(board: list[Column]) -> dict[tuple[str, ...], str]:
    """Column key → what its files are named by: its slug, and eight digits of the key's SHA-256
    where two columns have one slug (my_data and My-Data): no figure takes another's place.
    """
    alike = Counter(column.slug for column in board)

    def named(column: Column) -> str:
        if alike[column.slug] == 1:
            return column.slug
        digest = hashlib.sha256("\n".join(column.key).encode()).hexdigest()
        return f"{column.slug}-{digest[:8]}".strip("-")

    return {column.key: named(column) for column in board}


def files(
    board: list[Column],
    comparisons: list[Comparison],
    families: list[Family],
    given_poses: list[GivenPoses],
    folder: Path,
) -> dict[str, bytes]:
    """Path below the board's folder → content: every figure as SVG and as PNG."""
    drawn = draw_all(board, comparisons, families, given_poses, folder)
    return {
        f"figures/{name}.{kind}": to_bytes(figure, kind)
        for name, (_, figure) in drawn.items()
        for kind in ("svg", "png")
    }


def to_bytes(figure: Figure, kind: str) -> bytes:
    """The figure as "svg" or "png", without the date matplotlib would add."""
    buffer = io.BytesIO()
    metadata = {"Date": None} if kind == "svg" else {"Software": None}
    with mpl.rc_context(_STYLE):
        figure.savefig(buffer, format=kind, metadata=metadata, bbox_inches="tight")
    return buffer.getvalue()


def _new(width: float = 5.2, height: float = 3.2) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height))
    return figure, figure.subplots()


def _accuracy(column: Column, comparison: Comparison) -> Figure:
    names = ranked(column)
    figure, axes = _new(5.2, 0.8 + 0.28 * len(names))
    means = [100 * column.cells[name].mean() for name in names]
    axes.barh(range(len(names)), means, color="#4878a8", height=0.7)
    for i, name in enumerate(names):
        low, high = comparison.intervals[name]
        axes.plot([100 * low, 100 * high], [i, i], color="black", linewidth=1)
        paper = paper_score(column, column.cells[name].results[0])
        if paper is not None and column.on_paper_data:
            axes.plot(paper, i, marker="D", color="#c44e52", markersize=4)
    axes.set_yticks(range(len(names)), [row_title(column.cells[n].results[0]) for n in names])
    axes.invert_yaxis()
    axes.set_xlim(0, 100)
    axes.set_xlabel(
        "accuracy (%)" + ("; diamond: the paper's, on its data" if column.on_paper_data else "")
    )
    return figure


def _by_setting(board: list[Column]) -> Figure | None:
    """Bars for each model that one data set was run with in two of its settings or more."""
    found = setting_families(board)
    if not found:
        return None
    columns = max(found, key=len)
    names = compared_rows(columns)
    figure, axes = _new(1.5 + 0.7 * len(names))
    step = min(0.27, 0.81 / len(columns))
    for i, (setting, column) in enumerate(columns.items()):
        cells = [column.cells.get(name) for name in names]
        heights = [100 * cell.mean() if cell else np.nan for cell in cells]
        axes.bar(np.arange(len(names)) + step * i, heights, step - 0.02, label=setting)
    axes.set_xticks(np.arange(len(names)) + 0.27, names, rotation=30, ha="right")
    axes.set_ylabel("accuracy (%)")
    axes.legend(frameon=False)
    return figure


def _visibility(column: Column) -> Figure:
    figure, axes = _new()
    for name in ranked(column):
        rows = [r.scores["visibility"] for r in column.cells[name].results]
        seen = [i for i, bin_ in enumerate(rows[0]) if bin_["clouds"] >= FEW_CLOUDS]
        centres = [50 * (rows[0][i]["from"] + rows[0][i]["to"]) for i in seen]
        means = [100 * float(np.mean([row[i]["accuracy"] for row in rows])) for i in seen]
        _line(axes, column, name, centres, means)
    axes.set_xlabel("visible surface (%)")
    axes.set_ylabel("accuracy (%)")
    _legend(axes)
    return figure


def _pose_visibility(column: Column, folder: Path) -> Figure | None:
    """Median pose error of the clouds in each bin of visibility, over all seeds."""
    posed = _posed(column)
    if not posed:
        return None
    figure, axes = _new()
    centres = [50 * (low + high) for low, high in itertools.pairwise(VISIBILITY_EDGES)]
    for name in posed:
        stored = [results.read_predictions(folder, r) for r in column.cells[name].results]
        errors = np.concatenate([best_pose_errors_deg(p) for p in stored])
        which = visibility_bins(np.concatenate([p.visible_fraction for p in stored]))
        drawn = [i for i in range(len(centres)) if (which == i).sum() >= FEW_CLOUDS]
        medians = [np.median(errors[which == i]) for i in drawn]
        _line(axes, column, name, [centres[i] for i in drawn], medians)
    axes.set_xlabel("visible surface (%)")
    axes.set_ylabel("median pose error (°)")
    _legend(axes)
    return figure


def _curves(family: Family) -> Figure:
    figure, axes = _new()
    for name, points in family.curves.items():
        x = [p.x for p in points]
        _line(axes, family.column, name, x, [100 * p.accuracy for p in points])
        axes.fill_between(x, [100 * p.low for p in points], [100 * p.high for p in points],
                          color=_look(family.column, name)["color"], alpha=0.15,
                          linewidth=0)  # fmt: skip
    axes.set_ylabel("accuracy (%)")
    _condition_axis(axes, family)
    return figure


def _pose_curves(family: Family) -> Figure | None:
    figure, axes = _new()
    for name, points in family.curves.items():
        posed = [(p.x, p.pose_deg) for p in points if p.pose_deg is not None]
        if posed:
            x, degrees = zip(*posed, strict=True)
            _line(axes, family.column, name, x, degrees)
    if not axes.lines:
        return None
    axes.set_ylabel("median pose error (°)")
    _condition_axis(axes, family)
    return figure


def _is_noise(pose: str) -> bool:
    """Whether it lies on the curve over the noise."""
    return pose not in (OWN, RANDOM) and not pose.startswith(PER_CLASS)


def _given(given: GivenPoses) -> Figure:
    """Against the noise on the true pose; level lines where the model has its own or a random."""
    figure, axes = _new()
    noises = [float(pose) for pose in given.poses if _is_noise(pose)]
    for name, told in given.rows.items():
        means = {pose: 100 * mean for pose, (mean, _, _) in told.accuracy.items()}
        noisy = {float(pose): y for pose, y in means.items() if _is_noise(pose)}
        _line(axes, given.column, name, list(noisy), list(noisy.values()))
        for pose, style in ((OWN, "--"), (RANDOM, ":")):
            if pose in means:
                axes.axhline(means[pose], linestyle=style, linewidth=1,
                             color=_look(given.column, name)["color"])  # fmt: skip
    axes.set_xticks(noises, [f"{x:g}" for x in noises])
    axes.set_xlabel("noise on every Euler angle of the true pose, ± (°)")
    axes.set_ylabel("accuracy (%)")
    _legend(axes)
    return figure


def _condition_axis(axes: Axes, family: Family) -> None:
    places = sorted({p.x for points in family.curves.values() for p in points})
    if family.condition == "points":
        axes.set_xscale("log", base=2)
        axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xticks(places, [f"{x:g}" for x in places])
    axes.minorticks_off()
    axes.set_xlabel(family.axis)
    _legend(axes)


def _cost(column: Column) -> Figure:
    figure, axes = _new()
    for name in ranked(column):
        cell = column.cells[name]
        x, y = cell.cost["multiply_adds"], 100 * cell.mean()
        axes.plot(max(x, 1), y, linestyle="", label=_label(column, name), **_look(column, name))
    axes.set_xscale("log")
    places = _log_places([max(cell.cost["multiply_adds"], 1) for cell in column.cells.values()])
    axes.set_xticks(places, [engineering(value) for value in places])
    axes.minorticks_off()
    axes.margins(0.15)
    axes.set_xlabel("multiply-adds of one cloud")
    axes.set_ylabel("accuracy (%)")
    _legend(axes)
    return figure


def _log_places(values: Sequence[float]) -> list[float]:
    """Powers of ten among them; 1, 2 and 5 times such where those are few; else the ends."""
    low, high = min(values), max(values)
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for factors in ((1,), (1, 2, 5)):
        found = [f * 10.0**p for p in powers for f in factors if low <= f * 10.0**p <= high]
        if len(found) > 1:
            return found
    return sorted({low, high})


def _top_k(column: Column) -> Figure | None:
    posed = _posed(column)
    if not posed:
        return None
    figure, axes = _new()
    for name in posed:
        curves = [r.scores["pose"]["top_k"] for r in column.cells[name].results]
        mean = 100 * np.mean(curves, axis=0)
        _line(axes, column, name, range(1, len(mean) + 1), mean)
    axes.set_xlabel("k")
    axes.set_xticks(K_TICKS)
    axes.set_ylabel("true pose bin among the k best (%)")
    _legend(axes)
    return figure


def _ensemble(column: Column) -> Figure | None:
    """The paper's figure of k and δ: accuracy over ensemble sizes, a curve for each row."""
    deciding = [n for n in ranked(column) if column.cells[n].results[0].scores["ensemble"]]
    if not deciding:
        return None
    figure, axes = _new()
    for name in deciding:
        cell = column.cells[name]
        mean = 100 * np.mean([r.scores["ensemble"] for r in cell.results], axis=0)
        _line(axes, column, name, range(1, len(mean) + 1), mean, noise_title(cell.results[0]))
    axes.set_xlabel("k, poses that decide")
    axes.set_xticks(K_TICKS)
    axes.set_ylabel("accuracy (%)")
    _legend(axes)
    return figure


def _confusion(column: Column, folder: Path) -> Figure:
    seeds = column.cells[ranked(column)[0]].results
    names = seeds[0].train_data.class_names
    counts = np.zeros((len(names), len(names)))
    for result in seeds:
        stored, label = counted(result, folder)
        counts += confusion(label, stored.predicted, len(names))
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    size = 1.5 + 0.16 * len(names)
    figure, axes = _new(size, size)
    axes.imshow(100 * shares, cmap="Blues", vmin=0, vmax=100)
    for set_ticks in (axes.set_xticks, axes.set_yticks):
        set_ticks(range(len(names)), names, fontsize=6)
    axes.tick_params(axis="x", rotation=90)
    axes.set_xlabel("named")
    axes.set_ylabel("true")
    return figure


def _line(axes: Axes, column: Column, name: str, x: Any, y: Any, label: str = "") -> None:
    """A row's curve; it is called as in every figure unless ``label`` says otherwise."""
    axes.plot(x, y, markersize=3, linewidth=1, label=label or _label(column, name),
              **_look(column, name))  # fmt: skip


def _posed(column: Column) -> list[str]:
    """The rows that have a pose, best first."""
    return [name for name in ranked(column) if column.cells[name].pose]


def _label(column: Column, name: str) -> str:
    return row_title(column.cells[name].results[0])


def _look(column: Column, name: str) -> dict[str, Any]:
    """A row's colour and marker, the same in every figure of its column."""
    rank = ranked(column).index(name)
    return {"color": f"C{rank % 10}", "marker": "os^Dv*"[rank // 10 % 6]}


def _legend(axes: Axes) -> None:
    axes.legend(frameon=False, fontsize=7, loc="upper left", bbox_to_anchor=(1, 1))
