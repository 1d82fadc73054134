"""``partialbench leaderboard``: a folder of records → tables, figures and a page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from leaderboard import curves, damages, figures, gallery, given, latex, page, tables
from leaderboard.agreement import rank_agreement
from leaderboard.board import make_board
from leaderboard.check import against_data, problems
from leaderboard.comparison import compare
from leaderboard.layouts import layouts
from leaderboard.output import write_board
from leaderboard.poses import pose_layouts
from leaderboard.settings import setting_layouts
from leaderboard.transductive import transductive_layouts
from leaderboard.tuning import tuning_layouts
from partialbench.benchmark.records import results, testsets
from partialbench.errors import InputError


def build_leaderboard(
    results_folder: Path | str,
    out: Path | str,
    check: bool = False,
    data: Sequence[Path | str] = (),
) -> list[Path]:
    """Writes leaderboard.md, .csv, .tex and .html, two more .csv and figures/*.svg and *.png.

    The same records (and data) give the same bytes. Files of an earlier board that this one lacks
    are removed from ``out``.

    Args:
        check: recompute every score from the stored predictions first, and hold cards against the
            registry and test sets against the given data.
        data: data folders the records were tested on: the page shows clouds on which the models
            disagree from those whose digest fits. They become part of the page; whoever passes it
            on needs the right to.

    Returns:
        the paths.

    Raises:
        InputError: no records, or some that cannot be trusted: all that is wrong is listed, and
            nothing is written.
    """
    folder, out = Path(results_folder), Path(out)
    _require_none(problems(folder, recompute=check), folder)
    test_sets = [gallery.open_test_split(Path(each)) for each in data]
    if check:
        whole = [(each.digest, testsets.of(each, np.arange(len(each)))) for each in test_sets]
        _require_none(against_data(folder, whole), folder)
    records = results.read_folder(folder)
    if not records:
        raise InputError(
            f"{folder} holds no records (*{results.SUFFIX}); make some with "
            f"'partialbench eval --results {folder}'"
        )
    board = make_board(records)
    if not board:
        raise InputError(
            f"{folder} holds only tests under other conditions than trained on (fewer points, "
            f"another sensor, a given pose, damage), which need their model's own test beside "
            f"them, with --data, or models whose answers depend on a test cloud's batch-mates"
        )
    comparisons = [compare(column, folder) for column in board]
    families = curves.find_families(board, records, folder)
    given_poses = given.find_given_poses(board, records, folder)
    drawn = figures.draw_all(board, comparisons, families, given_poses, folder)
    svgs = {
        name: (caption, figures.to_bytes(figure, "svg"))
        for name, (caption, figure) in drawn.items()
    }
    galleries = [gallery.disagreements(column, folder, test_sets) for column in board]
    laid_out = [
        *layouts(board, comparisons),
        *setting_layouts(board, folder),
        *pose_layouts(board, folder),
        *map(given.as_layout, given_poses),
        *map(damages.as_layout, damages.find_damages(board, records, folder)),
        *transductive_layouts(records),
        *rank_agreement(board),
        *map(curves.as_layout, families),
        *tuning_layouts(folder, records, board),
    ]
    contents = {
        "leaderboard.md": tables.as_markdown(board, comparisons, laid_out).encode(),
        "leaderboard.csv": tables.as_csv(board, comparisons).encode(),
        "differences.csv": tables.differences_as_csv(board, comparisons).encode(),
        "curves.csv": tables.curves_as_csv(families, given_poses).encode(),
        "leaderboard.tex": latex.as_latex(board, comparisons, laid_out).encode(),
        "leaderboard.html": page.as_html(board, comparisons, laid_out, svgs, galleries).encode(),
    }
    for name, (_, figure) in drawn.items():
        contents[f"figures/{name}.svg"] = svgs[name][1]
        contents[f"figures/{name}.png"] = figures.to_bytes(figure, "png")
    return write_board(out, contents)


def _require_none(wrong: list[str], folder: Path) -> None:
    if wrong:
        raise InputError(
            f"{len(wrong)} thing(s) wrong with the records in {folder}:\n  " + "\n  ".join(wrong)
        )
