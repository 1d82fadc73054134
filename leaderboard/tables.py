"""The board as Markdown, CSV and LaTeX: pure functions, so the same records give the same bytes."""

from __future__ import annotations

import csv
import io
import math

from leaderboard.board import Column, ranked
from leaderboard.comparison import Comparison
from partialbench.benchmark.results import Result


def as_markdown(board: list[Column], comparisons: list[Comparison]) -> str:
    """One table for each column, best row first, with the paper's figure where it has one."""
    parts = ["# Leaderboard\n"]
    for column, comparison in zip(board, comparisons, strict=True):
        parts += [f"## {column.title}\n", describe(column) + "\n"]
        head = ["model", "input", "accuracy", "95 % interval", "group", "over classes"]
        crossed = crosses(column)
        if crossed:
            head.append("shared classes only")
        posed = any(cell.results[0].scores["pose"] for cell in column.cells.values())
        if posed:
            head += ["pose bin", "pose error"]
        head += ["turned", "parameters", "multiply-adds", "ms a cloud", "seeds"]
        if column.reported:
            head.append(f"{reported_name(column)} (reported)")
        lines = [head, ["---"] * len(head)]
        for name in ranked(column):
            cell, result = column.cells[name], column.cells[name].results[0]
            low, high = comparison.intervals[name]
            line = [
                row_title(result),
                result.card["representation"] or "–",
                percent(cell.mean(), cell.std()),
                "–" if math.isnan(low) else f"{100 * low:.1f} – {100 * high:.1f}",
                " ".join(map(str, comparison.groups[name])),
                percent(cell.mean("class_accuracy"), cell.std("class_accuracy")),
            ]
            if crossed:
                line.append(percent(cell.mean("restricted_accuracy"), None))
            if posed:
                pose = result.scores["pose"]
                line += (
                    [f"{100 * pose['top_k'][0]:.1f}", f"{pose['median_deg']:.0f}°"]
                    if pose
                    else ["–", "–"]
                )
            cost = result.cost
            line += [
                f"{100 * result.rotation_audit['drift']:.1f}",
                f"{cost['parameters']:,}",
                engineering(cost["multiply_adds"]),
                f"{cost['batch_ms']:.2f}",
                str(cell.seeds),
            ]
            if column.reported:
                line.append(reported(column, result))
            lines.append(line)
        parts += ["| " + " | ".join(line) + " |" for line in lines]
        parts.append("")
    parts.append(LEGEND)
    return "\n".join(parts)


LEGEND = """\
Accuracy in %: share of test clouds named rightly, mean ± standard deviation over seeds; the
interval is over test objects (bootstrap of whole objects). Rows that share a group number cannot be
told apart (paired test over objects, Holm's correction, 5 %). Over classes: mean of the per-class
accuracies. Pose bin: share of clouds whose best of the 60 bins is the true one under symmetry; pose
error: median angle to the truth modulo symmetry. Turned: how far the logits move when a cloud is
turned, in % of their size (0 = invariant). Multiply-adds and milliseconds are of the forward pass
for one cloud (on the hardware of each record). Reported figures are the paper's own, on its data.
"""


def describe(column: Column) -> str:
    """What every row of the column was trained and tested on, in one sentence."""
    first = next(iter(column.cells.values())).results[0]
    train, test = first.train_data, first.test_data
    return (
        f"Trained on {train.clouds:,} clouds of {train.objects:,} objects ({train.id}, "
        f"{train.digest[:12]}), tested on {first.scores['clouds']:,} clouds of "
        f"{first.scores['objects']:,} objects ({test.id}, {test.digest[:12]}); protocol "
        f"{first.protocol['preset']} ({first.protocol_digest[:12]})."
    )


def as_csv(board: list[Column], comparisons: list[Comparison]) -> str:
    """One line for each row and column, every score as a number."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["model", "variant", "train_data", "train_digest", "test_data", "test_digest", "preset",
         "protocol_digest", "seeds", "accuracy", "accuracy_std", "interval_low", "interval_high",
         "groups", "class_accuracy", "restricted_accuracy", "calibration_error", "pose_top1",
         "pose_top5", "pose_median_deg", "pose_within_30", "rotation_drift", "parameters",
         "multiply_adds", "latency_ms", "batch_ms", "train_clouds_per_second",
         "peak_memory_bytes", "paper_reported"]
    )  # fmt: skip
    for column, comparison in zip(board, comparisons, strict=True):
        for name in ranked(column):
            cell = column.cells[name]
            first, std = cell.results[0], cell.std()
            low, high = comparison.intervals[name]
            pose = first.scores["pose"]
            posed = (
                [pose["top_k"][0], pose["top_k"][4], pose["median_deg"], pose["within_30"]]
                if pose
                else [None] * 4
            )
            paper = first.card["paper_scores"].get(column.reported)
            line = [
                first.model, first.variant, first.train_data.id, first.train_data.digest,
                first.test_data.id, first.test_data.digest, first.protocol["preset"],
                first.protocol_digest, cell.seeds, cell.mean(), std,
                None if math.isnan(low) else low, None if math.isnan(high) else high,
                " ".join(map(str, comparison.groups[name])), cell.mean("class_accuracy"),
                cell.mean("restricted_accuracy"), cell.mean("calibration_error"), *posed,
                first.rotation_audit["drift"], first.cost["parameters"],
                first.cost["multiply_adds"], first.cost["latency_ms"], first.cost["batch_ms"],
                first.training["clouds_per_second"], first.cost["peak_memory_bytes"],
                None if paper is None else paper / 100,
            ]  # fmt: skip
            writer.writerow(
                ["" if v is None else f"{v:.6f}" if isinstance(v, float) else v for v in line]
            )
    return text.getvalue()


def as_latex(board: list[Column], comparisons: list[Comparison]) -> str:
    """A document that compiles alone: one booktabs table for each column, in the paper's style."""
    parts = [
        r"\documentclass{article}", r"\usepackage[T1]{fontenc}", r"\usepackage[utf8]{inputenc}",
        r"\usepackage{booktabs,graphicx}", r"\begin{document}",
    ]  # fmt: skip
    for column, comparison in zip(board, comparisons, strict=True):
        head = ["Methods", "Input (Size)", "Accuracy (\\%)", "95\\% interval", "Group"]
        if column.reported:
            head.append(f"{escape(reported_name(column))} (reported)")
        parts += [
            r"\begin{table}[t]",
            rf"\caption{{{escape(column.title)}. {escape(describe(column))}}}",
            r"\centering", r"\resizebox{\columnwidth}{!}{",
            rf"\begin{{tabular}}{{ll{'c' * (len(head) - 2)}}}", r"\toprule",
            " & ".join(head) + r" \\", r"\midrule",
        ]  # fmt: skip
        best = ranked(column)[0]
        for name in ranked(column):
            cell, result = column.cells[name], column.cells[name].results[0]
            low, high = comparison.intervals[name]
            shown = percent(cell.mean(), cell.std()).replace("±", r"$\pm$")
            line = [
                escape(row_title(result)),
                escape(result.card["representation"]) or "--",
                rf"\textbf{{{shown}}}" if name == best else shown,
                "--" if math.isnan(low) else f"{100 * low:.1f}--{100 * high:.1f}",
                " ".join(map(str, comparison.groups[name])),
            ]
            if column.reported:
                line.append(reported(column, result).replace("–", "--"))
            parts.append(" & ".join(line) + r" \\")
        parts += [r"\bottomrule", r"\end{tabular}}", r"\end{table}"]
    return "\n".join([*parts, r"\end{document}", ""])


_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
    "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "×": r"$\times$", "→": r"$\rightarrow$", "–": "--", "±": r"$\pm$", "²": r"$^2$",
    "³": r"$^3$", "δ": r"$\delta$",
}  # fmt: skip


def escape(text: str) -> str:
    """Text with what LaTeX would misread replaced."""
    return "".join(_LATEX.get(character, character) for character in text)


def row_title(result: Result) -> str:
    """As printed: the card's title and the variant."""
    title = result.card["title"]
    return f"{title} [{result.variant}]" if result.variant else title


def reported_name(column: Column) -> str:
    """What the paper's figures are on."""
    return "paper, " + column.reported.upper().replace(">", " → ")


def reported(column: Column, result: Result) -> str:
    """The paper's figure for this row and pair of data sets, in %."""
    figure = result.card["paper_scores"].get(column.reported)
    return "–" if figure is None else f"{figure:.1f}"


def percent(mean: float, std: float | None) -> str:
    """A share as "83.5" or "83.5 ± 0.4"."""
    return f"{100 * mean:.1f}" if std is None else f"{100 * mean:.1f} ± {100 * std:.1f}"


def engineering(count: float) -> str:
    """1_234_567 as "1.2 M"."""
    for unit, size in (("G", 1e9), ("M", 1e6), ("k", 1e3)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count:.0f}"


def crosses(column: Column) -> bool:
    """Whether training and test data have different classes."""
    first = next(iter(column.cells.values())).results[0]
    return set(first.train_data.class_names) != set(first.test_data.class_names)
