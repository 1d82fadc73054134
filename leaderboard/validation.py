"""Two trained weights on the validation split of their training, told apart by a paired test.

    python -m leaderboard.validation RUN_A RUN_B --data DIR [--options-b refine=4 votes=8]
    python -m leaderboard.validation RUN RUN --data DIR --points-b 512 --options-b votes=2

What is chosen by a trial is chosen here: on training objects that neither has seen, never on the
test split, which is not opened; on every validation cloud, where the figure of a trial itself is
of as many as the protocol tests at most. A run is its folder or a checkpoint; the same weights may
be given twice, with options that act at test alone, or with more points of each cloud. Speaks of
the networks at hand; give several seeds'.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from partialbench.benchmark.clouds import Clouds
from partialbench.benchmark.predict import find_checkpoint
from partialbench.benchmark.protocol import protocol as protocols
from partialbench.benchmark.protocol.split import split_by_object
from partialbench.benchmark.testing import evaluate
from partialbench.benchmark.testing.uncertainty import bootstrap_intervals, paired_p_value
from partialbench.benchmark.training import checkpoint
from partialbench.dataset.loader import ShardDataset
from partialbench.errors import InputError
from partialbench.options import plain


class Paired(NamedTuple):
    """Accuracies of two, by how much b exceeds a, with its 95 % interval over objects, and p."""

    a: float
    b: float
    gain: float
    low: float
    high: float
    p_value: float


def compare(
    a: Sequence[tuple[Path, Mapping[str, Any]]],
    b: Sequence[tuple[Path, Mapping[str, Any]]],
    train_set: Clouds,
    of_b: Clouds | None = None,
) -> Paired:
    """Compares the mean of some trainings with that of others, cloud by cloud.

    Args:
        a, b: runs and options to build each with beside its own; as many of each, one a seed.
        train_set: what they were trained on.
        of_b: the same with another number of points a cloud, for b.

    Raises:
        InputError: a run that was trained on other data or another split, or not finished.
    """
    if len(a) != len(b):
        raise InputError(f"as many runs of each are compared, got {len(a)} and {len(b)}")
    right, rows = [], None
    seen = [train_set] * len(a) + [of_b or train_set] * len(b)
    for (path, options), clouds in zip((*a, *b), seen, strict=True):
        answered, of_run = _right(path, options, clouds)
        if rows is not None and not np.array_equal(rows, of_run):
            raise InputError(f"{path} validates on other clouds than the runs before it")
        rows = of_run
        right.append(answered)
    assert rows is not None
    one, other = (np.mean(part, axis=0) for part in (right[: len(a)], right[len(a) :]))
    object_ids = train_set.object_ids[rows]
    ((low, high),) = bootstrap_intervals((other - one)[:, None], object_ids)
    p_value = paired_p_value(other, one, object_ids)
    gain = float((other - one).mean())
    return Paired(float(one.mean()), float(other.mean()), gain, float(low), float(high), p_value)


def _right(
    path: Path, options: Mapping[str, Any], train_set: Clouds
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Of the validation rows, whether a run answers rightly, and which they are."""
    file = find_checkpoint(path)
    content = checkpoint.load(file)
    checkpoint.require_finished(content, file, "be compared")
    if content["train_data"]["digest"] != train_set.digest:
        raise InputError(f"{file} was trained on other data than {train_set.dataset_id} here")
    protocol = protocols.from_dict(content["protocol"])
    _, rows = split_by_object(
        train_set.object_ids, train_set.labels, train_set.class_names,
        protocol.validation_fraction, protocol.split_seed, train_set.source_digests,
    )  # fmt: skip
    if not len(rows):
        raise InputError(f"the protocol of {file} keeps no object back to validate on")
    model = checkpoint.build_model(
        {**content, "options": {**content["options"], **options}}, content["model"]
    )
    found = evaluate.predict_rows(model, train_set, rows, train_set.class_names)
    return found.predicted == train_set.labels[rows], rows


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("a", help="run folders, the baseline's, with commas between seeds")
    parser.add_argument("b", help="as many of what was tried")
    parser.add_argument("--data", type=Path, required=True, help="the data folder trained on")
    parser.add_argument("--points", type=int, default=256)
    parser.add_argument("--points-b", type=int, help="as many for both by default")
    parser.add_argument("--options-b", nargs="*", default=[], help="at test alone: votes=8")
    given = parser.parse_args()
    changed = {name: plain(value) for name, _, value in (o.partition("=") for o in given.options_b)}
    found = compare(
        [(Path(each), {}) for each in given.a.split(",")],
        [(Path(each), changed) for each in given.b.split(",")],
        ShardDataset(given.data, "train", given.points),
        given.points_b and ShardDataset(given.data, "train", given.points_b),
    )
    sys.stdout.write(
        f"{100 * found.a:.1f} % against {100 * found.b:.1f} %: {100 * found.gain:+.1f} "
        f"({100 * found.low:+.1f} – {100 * found.high:+.1f}), p = {found.p_value:.4f}\n"
    )


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(f"error: {error}")
