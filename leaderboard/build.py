"""``partialbench leaderboard``: a folder of records → tables, figures and a page."""

from __future__ import annotations

from pathlib import Path

from leaderboard import tables
from leaderboard.board import make_board
from leaderboard.check import problems
from leaderboard.comparison import compare
from partialbench.benchmark import results
from partialbench.dataset.shards import write_atomically
from partialbench.errors import InputError


def build_leaderboard(
    results_folder: Path | str, out: Path | str, check: bool = False
) -> list[Path]:
    """Writes leaderboard.md, .csv and .tex; returns what was written.

    Args:
        check: recompute every score from the stored predictions first.

    Raises:
        InputError: no records, or some that cannot be trusted: all that is wrong is listed, and
            nothing is written.
    """
    folder, out = Path(results_folder), Path(out)
    wrong = problems(folder, recompute=check)
    if wrong:
        raise InputError(
            f"{len(wrong)} thing(s) wrong with the records in {folder}:\n  " + "\n  ".join(wrong)
        )
    records = results.read_folder(folder)
    if not records:
        raise InputError(
            f"{folder} holds no records (*{results.SUFFIX}); make some with "
            f"'partialbench eval --results {folder}'"
        )
    board = make_board(records)
    comparisons = [compare(column, folder) for column in board.columns]
    contents = {
        "leaderboard.md": tables.as_markdown(board, comparisons),
        "leaderboard.csv": tables.as_csv(board, comparisons),
        "leaderboard.tex": tables.as_latex(board, comparisons),
    }
    out.mkdir(parents=True, exist_ok=True)
    for name, text in contents.items():
        write_atomically(out / name, text.encode())
    return [out / name for name in contents]
