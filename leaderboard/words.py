"""How the board's numbers and names are printed, in every table alike."""

from __future__ import annotations

import math
import re

from leaderboard.board import Cell, Column, budget_title
from leaderboard.tables.plain import visible
from partialbench.benchmark.records.origin import clouds_before
from partialbench.benchmark.records.results import Result
from partialbench.benchmark.variant import with_changes


def row_title(result: Result) -> str:
    """As printed: the card's title and the variant."""
    return visible(with_changes(result.card["title"], result.variant))


def model_input(result: Result) -> str:
    """What the network saw in this run: the card's "pc (1024×3)" with the run's own sizes.

    Cards give the published sizes; the protocol sets the number of points, and the options ``grid``
    and ``image`` the edge of a volume or of depth images.
    """
    text = result.card["representation"] or "–"
    text = text.replace("1024", str(result.protocol["num_points"]))
    edge = result.options.get("grid", result.options.get("image"))
    return text if edge is None else re.sub(r"\d+(?=[²³])", str(edge), text)


def reported_name(column: Column) -> str:
    """What the paper's figures are on, and whether the column's data are other ones."""
    other = "" if column.on_paper_data else ", other data"
    return "paper, " + column.reported.upper().replace(">", " → ") + other


def reported_head(column: Column) -> str:
    """The head of a column of the paper's figures: "paper, PM40 (reported, other data)"."""
    other = "" if column.on_paper_data else ", other data"
    return f"paper, {column.reported.upper().replace('>', ' → ')} (reported{other})"


def networks(cell: Cell) -> str:
    """The number of seeds; of one, that the row speaks of a network and not of a method."""
    return str(cell.seeds) if cell.seeds > 1 else "1 (one network)"


def paper_score(column: Column, result: Result) -> float | None:
    """The paper's figure for this row and pair of data sets, in %.

    None where it has none: a row whose model or recipe was changed is not what the paper reports.
    """
    return None if result.variant else result.card["paper_scores"].get(column.reported)


def reported(column: Column, result: Result) -> str:
    """The same as printed."""
    figure = paper_score(column, result)
    return "–" if figure is None else f"{figure:.1f}"


def percent(mean: float, std: float | None) -> str:
    """A share as "83.5" or "83.5 ± 0.4"."""
    return f"{100 * mean:.1f}" if std is None else f"{100 * mean:.1f} ± {100 * std:.1f}"


def interval(low: float, high: float) -> str:
    """The bounds of a share as "81.2 – 85.0", "–" where there is nothing to resample."""
    return "–" if math.isnan(low) else f"{100 * low:.1f} – {100 * high:.1f}"


def difference(found: tuple[float, float, float]) -> str:
    """A difference of shares and its interval as "3.1 (1.4 – 4.8)"."""
    mean, low, high = found
    return f"{100 * mean:.1f}" + ("" if math.isnan(low) else f" ({interval(low, high)})")


def engineering(count: float) -> str:
    """1_234_567 as "1.2 M"."""
    for unit, size in (("G", 1e9), ("M", 1e6), ("k", 1e3)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count:.0f}"


def budget(result: Result) -> str:
    """What its training was given: clouds seen, repeats counted, and minutes on its hardware.

    A training that began from weights of another names that one's clouds too.
    """
    training = result.training
    text = f"{engineering(training['clouds_seen'])} in {training['seconds'] / 60:.0f} min"
    before = clouds_before(training.get("start"))
    return f"{text}, after {engineering(before)}" if before else text


def describe(column: Column) -> str:
    """What every row of the column was trained and tested on, in one sentence."""
    first = next(iter(column.cells.values())).results[0]
    train, test = first.train_data, first.test_data
    return (
        f"Trained on {train.clouds:,} clouds of {train.objects:,} objects ({train.id}, "
        f"{train.digest[:12]}), tested on {first.scores['clouds']:,} clouds of "
        f"{first.scores['objects']:,} objects ({test.id}, {test.digest[:12]}), "
        f"{first.protocol['num_points']:,} points a cloud; protocol "
        f"{budget_title(first)} ({first.protocol_digest[:12]})."
    )


_DATA = {
    "pm40": "ModelNet40's meshes, as a depth camera sees them",
    "pm40-parametric": "built-in shapes of ModelNet40's classes, as a depth camera sees them",
    "pm40-clouds": "ModelNet40's complete clouds, hidden points removed",
    "ps15": "objects scanned in rooms (ScanNet, Scan2CAD), hidden points removed",
    "ps15-standing": "objects scanned in rooms, seen from where a person can stand",
    "ps15-rooms": "objects of simulated scanned rooms, hidden points removed",
}


def data_words(column: Column) -> str:
    """What the column's data are, "" for data that are not the project's own."""
    names = dict.fromkeys((column.key[0], column.key[3]))
    told = [f"{name}: {_DATA[name]}" for name in names if name in _DATA]
    return f"{'; '.join(told)}." if told else ""


def crosses(column: Column) -> bool:
    """Whether training and test data have different classes."""
    first = next(iter(column.cells.values())).results[0]
    return set(first.train_data.class_names) != set(first.test_data.class_names)


def duplicates(column: Column) -> int:
    """Test clouds of the column whose object was made from a training object's bytes."""
    return next(iter(column.cells.values())).results[0].scores["duplicates"]


def without_duplicates(cell: Cell) -> str:
    """Accuracy without those clouds, "–" where none remains."""
    if cell.results[0].scores["accuracy_without_duplicates"] is None:
        return "–"
    return percent(
        cell.mean("accuracy_without_duplicates"), cell.std("accuracy_without_duplicates")
    )
