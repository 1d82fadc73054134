"""Command line of the realism measurement; see the package's docstring."""

from __future__ import annotations

import logging
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from numpy.typing import NDArray

from benchmarks.realism import occupancy as occupancies
from benchmarks.realism.clouds import Clouds, parametric, real
from benchmarks.realism.pointnet import predict, train
from partialbench.dataset.categories import MODELNET40
from partialbench.dataset.seeding import generator

app = typer.Typer(add_completion=False, help="How real the parametric families are.")

REAL = Annotated[
    Path, typer.Option("--real", help="HDF5 file of complete aligned ModelNet40 clouds.")
]
CACHE = Annotated[Path, typer.Option(help="Folder in which sampled parametric clouds are kept.")]
PER_CLASS = Annotated[int, typer.Option(help="Parametric objects a class.")]
OUT = Annotated[Path, typer.Option(help="Folder to write to.")]


class Kind(StrEnum):
    """Where clouds come from."""

    PARAMETRIC = "parametric"
    REAL = "real"


@app.command()
def occupancy(real_file: REAL, out: OUT, cache: CACHE, per_class: PER_CLASS = 200) -> None:
    """Draw mean occupancy of real train clouds beside parametric ones, one picture a class."""
    kept, made = real(real_file, "train"), parametric(cache, range(per_class))
    overlaps = occupancies.draw(kept, made, out)
    typer.echo("overlap of projections, and in space after turns of 0, 90, 180, 270° about z")
    for name, value in sorted(overlaps.items(), key=lambda item: item[1]):
        label = MODELNET40.index(name)
        turned = occupancies.overlaps_by_yaw(
            kept.points[kept.labels == label], made.points[made.labels == label]
        )
        typer.echo(f"{value:.2f}  {' '.join(f'{v:.2f}' for v in turned)}  {name}")


@app.command()
def classify(
    real_file: REAL,
    cache: CACHE,
    train_on: Annotated[Kind, typer.Option("--train")] = Kind.PARAMETRIC,
    test_on: Annotated[Kind, typer.Option("--test")] = Kind.REAL,
    final: Annotated[
        bool, typer.Option(help="Test on the real test split, which tuning must not read.")
    ] = False,
    per_class: PER_CLASS = 200,
    epochs: int = 15,
    seed: int = 0,
    out: Annotated[Path | None, typer.Option(help="Write the confusion matrix here (csv).")] = None,
) -> None:
    """Train a PointNet on one kind of cloud and test it on the other, or on the same.

    Trained and tested on one kind it sees different objects of it: how hard the classes are.
    """
    if final and test_on is not Kind.REAL:
        raise typer.BadParameter("--final is about real clouds: give --test real")
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    torch.set_num_threads(1)
    kept = real(real_file, "train")
    if train_on is test_on is Kind.REAL and not final:
        kept, held_out = kept.divided(0.8, generator(seed, "realism", "held out"))
    else:
        held_out = real(real_file, "test") if final else kept
    if train_on is Kind.REAL:
        training = kept.at_most(per_class)
    else:
        training = parametric(cache, range(per_class))
    if test_on is Kind.REAL:
        test = held_out
    else:
        start = per_class if train_on is Kind.PARAMETRIC else 0
        test = parametric(cache, range(start, start + per_class))
    confusion = confusion_matrix(test, predict(train(training, epochs, seed), test))
    typer.echo(f"trained on {len(training.labels)} {train_on} clouds, tested on "
               f"{len(test.labels)} {test_on} ones")  # fmt: skip
    typer.echo(report(confusion))
    if out is not None:
        table = [",".join(["true", *MODELNET40])]
        for name, counts in zip(MODELNET40, confusion, strict=True):
            table.append(",".join([name, *map(str, counts)]))
        out.write_text("\n".join(table) + "\n")


def confusion_matrix(test: Clouds, predicted: NDArray[np.int64]) -> NDArray[np.int64]:
    """(40,40) counts, row = true label, column = predicted one."""
    counts = np.zeros((len(MODELNET40), len(MODELNET40)), np.int64)
    np.add.at(counts, (test.labels, predicted), 1)
    return counts


def report(confusion: NDArray[np.int64]) -> str:
    """Accuracies, then each class's recall, precision and the classes it is most taken for."""
    totals, hits = confusion.sum(axis=1), confusion.diagonal()
    present = np.flatnonzero(totals)
    recall = hits / np.maximum(totals, 1)
    precision = hits / np.maximum(confusion.sum(axis=0), 1)
    lines = [f"accuracy {hits.sum() / totals.sum():.3f}, "
             f"mean recall {recall[present].mean():.3f} over {len(present)} classes"]  # fmt: skip
    for label in present[np.argsort(recall[present])]:
        others = confusion[label] / totals[label]
        others[label] = 0
        taken = ", ".join(f"{MODELNET40[j]} {others[j]:.0%}" for j in np.argsort(-others)[:4]
                          if others[j] >= 0.02)  # fmt: skip
        lines.append(f"{MODELNET40[label]:12s} recall {recall[label]:4.0%}  precision "
                     f"{precision[label]:4.0%}  taken for {taken or 'nothing else'}")  # fmt: skip
    return "\n".join(lines)


if __name__ == "__main__":
    app()
