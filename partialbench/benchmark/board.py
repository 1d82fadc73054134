"""``leaderboard``: the tables of a folder of records, from Python."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from partialbench import extras, given, registry
from partialbench.errors import InputError

if TYPE_CHECKING:
    import pandas

TABLE, SHOWN = "leaderboard.csv", (
    "model", "variant", "test_data", "preset", "train_clouds_seen", "seeds", "accuracy",
    "accuracy_std", "interval_low", "interval_high", "pose_top1", "parameters",
)  # fmt: skip
"""The file of all rows, and which of its columns a notebook shows."""


class Board:
    """The tables, figures and page of some records.

    Attributes:
        files: name → content of everything ``save`` writes: "leaderboard.md", "leaderboard.csv",
            "leaderboard.html", "figures/….svg" …
    """

    def __init__(self, files: Mapping[str, bytes]) -> None:
        self.files = dict(files)

    def to_pandas(self) -> pandas.DataFrame:
        """Every row of every table with all its columns (docs/leaderboard.md says what each is)."""
        reader = extras.load("pandas")
        return reader.read_csv(io.BytesIO(self.files[TABLE]), keep_default_na=True)

    def save(self, out: Path | str) -> list[Path]:
        """Writes all files into a folder, in place of an earlier board; returns their paths."""
        folder = given.path(out, "the board's folder")
        written: list[Path] = registry.load(registry.WRITE_BOARD)(folder, self.files)
        return written

    def __repr__(self) -> str:
        rows = self.files[TABLE].count(b"\n") - 1
        return f"<Board of {rows} row{'' if rows == 1 else 's'}>"

    def _repr_html_(self) -> str:
        """What a notebook shows: the rows, best first in each table."""
        table = self.to_pandas()
        shown = table[[name for name in SHOWN if name in table]].dropna(axis=1, how="all")
        order = [name for name in ("test_data", "preset") if name in shown]
        ascending = [True] * len(order) + [False]
        ranked = shown.sort_values([*order, "accuracy"], ascending=ascending)
        return str(ranked.to_html(index=False, na_rep="–", float_format=lambda x: f"{x:.3f}"))


def leaderboard(
    results: Path | str,
    *,
    check: bool = False,
    data: Path | str | Sequence[Path | str] = (),
    figures: bool = False,
    on_progress: Callable[[int, int], None] | None = None,
    look_in: Path | str | Sequence[Path | str] = (),
) -> Board:
    """The tables of a folder of records: what ``partialbench leaderboard`` writes.

    Args:
        results: the folder that ``evaluate`` wrote its records to.
        check: recompute every score from the stored predictions first.
        data: data folders the records were tested on, for the clouds of the page's gallery.
        figures: as SVG and PNG too.
        on_progress: called with (steps done, steps in all).
        look_in: folders whose subfolders may be data the records were tested on: their cameras are
            used, and clouds shown where the data are built in. Those beside the records are found.

    Raises:
        InputError: no records, or some that cannot be trusted.

    ::

        board = partialbench.leaderboard("results")
        board.to_pandas().sort_values("accuracy")
        board.save("board")                             # tables and the one-file page
    """
    if not isinstance(results, str | Path):
        raise InputError(
            f"expected the folder of the records (evaluate's results=), got a "
            f"{type(results).__name__}: a table is made from the stored predictions"
        )
    check, figures = given.truth(check, "check"), given.truth(figures, "figures")
    given.function(on_progress, "on_progress", " with (done, all)")
    make = registry.load(registry.BOARD_FILES)
    tested = [given.path(one, "a data folder") for one in given.several(data, "data")]
    places = [given.path(one, "a folder") for one in given.several(look_in, "look_in")]
    folder = given.path(results, "the folder of the results")
    return Board(make(folder, check, tested, figures, on_progress, places))
