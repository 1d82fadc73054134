"""``partialbench leaderboard``: a folder of records → tables, figures and a page."""

from __future__ import annotations

from pathlib import Path

from leaderboard import tables
from partialbench.benchmark import results
from partialbench.dataset.shards import write_atomically
from partialbench.errors import InputError


def build_leaderboard(results_folder: Path | str, out: Path | str) -> list[Path]:
    """Writes leaderboard.md and leaderboard.csv; returns what was written.

    Raises:
        InputError: no records, or one that cannot be trusted (see ``results.read_folder``).
    """
    records = results.read_folder(Path(results_folder))
    if not records:
        raise InputError(
            f"{results_folder} holds no records (*{results.SUFFIX}); make some with "
            f"'partialbench eval --results {results_folder}'"
        )
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    board = tables.make_board(records)
    contents = {
        "leaderboard.md": tables.as_markdown(board),
        "leaderboard.csv": tables.as_csv(board),
    }
    for name, text in contents.items():
        write_atomically(out / name, text.encode())
    return [out / name for name in contents]
