"""The claims of the findings, each answered from records: two rows, how far apart, on which data.

    python -m leaderboard.claims docs/findings.md leaderboard/records

fills the document's block ``<!-- claims -->`` … ``<!-- end -->``. A claim names its rows here, so
that none is chosen by its answer; where a row has no record the answer is "not yet". It is "yes" or
"no" where the 95 % interval of the difference leaves zero out. Where one of the two rows has two
seeds or more the interval includes how trainings vary, and the answer is about the methods; else it
is over test objects alone, and about the two networks at hand.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from leaderboard.board import Cell, Column, make_board, own_columns
from leaderboard.comparison import share_correct
from leaderboard.words import difference
from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.records import results
from partialbench.benchmark.testing.uncertainty import contrast, difference_intervals
from partialbench.errors import InputError


@dataclass(frozen=True)
class Claim:
    """That one row is more accurate than another.

    Attributes:
        text: the claim, in a sentence.
        better, worse: the two rows.
        note: what the answer does not settle, or "".
    """

    text: str
    better: str
    worse: str
    note: str = ""


CLAIMS = (
    Claim("Pose labels help: the same network with and without its pose loss.",
          "papnet-steered", "papnet-steered [pose_weight=0.0]"),
    Claim("A model that learns poses classifies better than its twin, which has none to learn.",
          "papnet-steered", "papnet-steered-nopose",
          "The twin also reads less: what no turn changes of the descriptor."),
    Claim("The paper's PAPNet, on small volumes, beats the Spherical CNN.",
          "papnet [grid=16]", "spherical-cnn",
          "The strongest baseline of the paper is the Steerable CNN."),
    Claim("Rotation-invariant inputs beat coordinates turned at random.",
          "rri-pointnet2", "pointnet2-ssg"),
    Claim("A learned turn without pose labels helps (T-Net).", "tnet-pointnet2", "pointnet2-ssg"),
    Claim("A learned turn in several steps helps (IT-Net).", "itnet-pointnet2", "pointnet2-ssg"),
    Claim("A modern invariant model beats the older one.", "riconv2", "rri-pointnet2"),
    Claim("Surface normals help an invariant model.", "riconv2-normals", "riconv2"),
    Claim("A learned frame beats 24 principal axes.", "canonical-vn", "canonical-pca24"),
    Claim("Learning poses beats learning a frame without their labels.",
          "papnet-steered", "canonical-vn", "They differ in the descriptor too."),
)  # fmt: skip
"""In the order of the page."""
HEAD = ("", "claim", "answer", "points (95 % interval)", "seeds", "data, clouds seen", "rows")
NOT_YET = ("not yet", "–", "–", "–")


def answers(board: list[Column], folder: Path, claims: Sequence[Claim] = CLAIMS) -> list[str]:
    """The lines of a Markdown table: each claim on each data set that has both of its rows.

    Args:
        folder: of the records, with their predictions.
    """
    lines = [HEAD, ("---",) * len(HEAD)]
    for number, claim in enumerate(claims, 1):
        columns = _asked(board, claim)
        found = [_answer(column, claim, folder) for column in columns] or [NOT_YET]
        text = " ".join(filter(None, [claim.text, claim.note]))
        rows = f"`{claim.better}`, `{claim.worse}`"
        lines.append((str(number), text, *found[0], rows))
        lines += [("", "", *cells, "") for cells in found[1:]]
    return [f"| {' | '.join(cells)} |" for cells in lines]


def _asked(board: list[Column], claim: Claim) -> list[Column]:
    """Of each data set and protocol the column of most clouds that has both rows, and before it the
    one of most seeds, if that is another."""
    shared: dict[tuple[str, ...], list[Column]] = {}
    for column in own_columns(board):
        if claim.better in column.cells and claim.worse in column.cells:
            shared.setdefault(column.key[:7], []).append(column)  # all but the clouds seen

    def seeds(column: Column) -> int:
        return min(column.cells[row].seeds for row in (claim.better, claim.worse))

    chosen = []
    for columns in shared.values():
        longest = max(columns, key=_clouds)
        surest = max(columns, key=lambda column: (seeds(column), _clouds(column)))
        chosen += [surest, longest] if surest is not longest else [longest]
    return chosen


def _clouds(column: Column) -> int:
    return next(iter(column.cells.values())).results[0].clouds


def _answer(column: Column, claim: Claim, folder: Path) -> tuple[str, ...]:
    pair = column.cells[claim.better], column.cells[claim.worse]
    value, low, high, subject = _gap(pair, folder)
    told = "not told apart" if low <= 0 <= high else "yes" if value > 0 else "no"
    data = pair[0].results[0].train_data
    setting = "" if data.setting == "partial" else f", {data.setting}"
    return (
        f"{told} ({subject})",
        difference((value, low, high)),
        f"{pair[0].seeds} and {pair[1].seeds}",
        f"{data.id}{setting}, {milestones.name(_clouds(column))}",
    )


def _gap(pair: tuple[Cell, Cell], folder: Path) -> tuple[float, float, float, str]:
    """The difference, the bounds of its interval, and whom it speaks of.

    Raises:
        InputError: the two were not tested on the same clouds.
    """
    (ids, first), (other_ids, second) = (share_correct(cell.results, folder) for cell in pair)
    if not np.array_equal(ids, other_ids):
        raise InputError(
            f"{pair[0].results[0].row} and {pair[1].results[0].row} were not tested on the same "
            f"clouds; test both again"
        )
    values = np.stack([first, second], axis=1)
    if max(cell.seeds for cell in pair) > 1:
        means = [[r.scores["accuracy"] for r in cell.results] for cell in pair]
        found = contrast(values, ids, means, (1, -1))
        return found.value, found.low, found.high, "methods"
    low, high = difference_intervals(values, ids)
    return float(first.mean() - second.mean()), float(low[0, 1]), float(high[0, 1]), "two networks"


_BLOCK = re.compile(r"(<!-- claims -->\n)(.*?)(<!-- end -->)", re.S)


def fill(document: str, folder: Path) -> str:
    """The document with its block of claims made anew from the records in ``folder``.

    Raises:
        InputError: it has no such block, or several.
    """
    if len(_BLOCK.findall(document)) != 1:
        raise InputError("the document needs one block '<!-- claims -->' … '<!-- end -->'")
    table = "".join(
        f"{line}\n" for line in answers(make_board(results.read_folder(folder)), folder)
    )
    return _BLOCK.sub(lambda match: match[1] + table + match[3], document)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("document", type=Path, help="Markdown with the block, changed in place")
    parser.add_argument("records", type=Path, help="a folder of records")
    given = parser.parse_args()
    given.document.write_text(fill(given.document.read_text(), given.records))


if __name__ == "__main__":
    main()
