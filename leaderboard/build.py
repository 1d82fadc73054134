"""``partialbench leaderboard``: a folder of records → tables, a page and, on request, figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from leaderboard.board import make_board
from leaderboard.check import against_data, problems
from leaderboard.comparison import compare
from leaderboard.output import write_board
from leaderboard.page import clouds, html
from leaderboard.page.content import Found
from leaderboard.tables import curves, damages, given, grid, latex, not_yet, viewpoints
from leaderboard.tables import text as tables
from leaderboard.tables.agreement import rank_agreement
from leaderboard.tables.layouts import layouts
from leaderboard.tables.poses import pose_layouts
from leaderboard.tables.settings import as_layout, losses, setting_families
from leaderboard.tables.transductive import transductive_layouts
from leaderboard.tables.transfer import transfer_layouts
from leaderboard.tables.tuning import tuning_layouts
from partialbench.benchmark.records import declared, results, testsets
from partialbench.errors import InputError

PAGE = "leaderboard.html"


def build_leaderboard(
    results_folder: Path | str,
    out: Path | str,
    check: bool = False,
    data: Sequence[Path | str] = (),
    with_figures: bool = False,
    on_progress: Callable[[int, int], None] | None = None,
    look_in: Sequence[Path | str] = (),
) -> list[Path]:
    """Writes what ``board_files`` makes; returns the paths, the page's first.

    Files of an earlier board that this one lacks are removed from ``out``.

    Raises:
        InputError: see there; nothing is written.
    """
    return write_board(
        Path(out), board_files(results_folder, check, data, with_figures, on_progress, look_in)
    )


def board_files(
    results_folder: Path | str,
    check: bool = False,
    data: Sequence[Path | str] = (),
    with_figures: bool = False,
    on_progress: Callable[[int, int], None] | None = None,
    look_in: Sequence[Path | str] = (),
) -> dict[str, bytes]:
    """leaderboard.html, .md, .csv and .tex, more .csv and, if asked, figures/, by name.

    The same records (and data) give the same bytes.

    Args:
        check: recompute every score from the stored predictions first, and hold cards against the
            registry and test sets against the given data.
        data: data folders the records were tested on: the page shows clouds on which the models
            disagree from those whose digest fits. They become part of the page; whoever passes it
            on needs the right to.
        with_figures: figures/*.svg and *.png too.
        on_progress: called with (steps done, steps in all).
        look_in: folders whose subfolders may be data the records were tested on, looked through
            after those beside the records. Of data that are found so the cameras are used, and
            clouds shown only where the data are built in.

    Raises:
        InputError: no records, or some that cannot be trusted: all that is wrong is listed.
    """
    folder = Path(results_folder)
    _require_none(problems(folder, recompute=check), folder)
    test_sets = [clouds.open_test_split(Path(each)) for each in data]
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
    named = {each.digest for each in test_sets}
    tested = {column.key[5] for column in board}
    at_hand = clouds.data_at_hand(folder, tested - named, look_in)
    shown = [*test_sets, *filter(clouds.may_be_shown, at_hand)]
    cameras = [each for each in (*test_sets, *at_hand) if each.has_poses]
    steps = _Steps(on_progress, 2 * len(board) + 5)
    comparisons = []
    for column in board:
        comparisons.append(compare(column, folder))
        steps.next()
    settings = [(family, losses(family, folder)) for family in setting_families(board)]
    steps.next()
    families = curves.find_families(board, records, folder)
    steps.next()
    given_poses = given.find_given_poses(board, records, folder)
    steps.next()
    galleries = []
    for column in board:
        galleries.append(clouds.disagreements(column, folder, shown))
        steps.next()
    views = viewpoints.find_curves(board, folder, cameras)
    steps.next()
    campaigns = declared.read_folder(folder)
    asked = [not_yet.asked_rows(column, campaigns) for column in board]
    laid_out = [
        *layouts(board, comparisons),
        *(as_layout(family, lost) for family, lost in settings),
        *pose_layouts(board, folder),
        *map(given.as_layout, given_poses),
        *transfer_layouts(board, folder),
        *map(damages.as_layout, damages.find_damages(board, records, folder)),
        *grid.grid_layouts(grid.find_grids(records, folder)),
        *transductive_layouts(records),
        *rank_agreement(board),
        *map(curves.as_layout, families),
        *tuning_layouts(folder, records, board),
        *not_yet.progress(board, campaigns),
    ]
    found = Found(
        board, comparisons, settings, families, given_poses, views, asked, laid_out, galleries,
        shown,
    )  # fmt: skip
    contents = {
        PAGE: html.as_html(found, folder).encode(),
        "leaderboard.md": tables.as_markdown(board, comparisons, laid_out, asked).encode(),
        "leaderboard.csv": tables.as_csv(board, comparisons).encode(),
        "differences.csv": tables.differences_as_csv(board, comparisons).encode(),
        "curves.csv": tables.curves_as_csv(families, given_poses).encode(),
        "viewpoints.csv": viewpoints.as_csv(views).encode(),
        "leaderboard.tex": latex.as_latex(board, comparisons, laid_out).encode(),
    }
    if campaigns:
        contents["not_yet.csv"] = not_yet.as_csv(board, campaigns).encode()
    if with_figures:
        from leaderboard.figures import draw as figures  # Matplotlib takes its time to load

        contents |= figures.files(board, comparisons, families, given_poses, folder)
    steps.next()
    return contents


class _Steps:
    """Counts what is done and tells it."""

    def __init__(self, tell: Callable[[int, int], None] | None, total: int) -> None:
        self._tell, self._done, self._total = tell, 0, total

    def next(self) -> None:
        self._done += 1
        if self._tell is not None:
            self._tell(self._done, self._total)


def _require_none(wrong: list[str], folder: Path) -> None:
    if wrong:
        raise InputError(
            f"{len(wrong)} thing(s) wrong with the records in {folder}:\n  " + "\n  ".join(wrong)
        )
