"""Makes the weights that come with a release: packs a finished training's, and tests them.

    python -m partialbench.benchmark.pack_weights RUN --on 'held-out built-in shapes=DATA' \\
        --on 'real ModelNet40 shapes, one side=OTHER' --page docs/weights.md

The first test must be of the folder that was trained on. What is tested is what ``predict`` says,
with the weights as they were packed; the card beside them has every figure.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer

from partialbench import user_code
from partialbench.benchmark.predict import VOTES, Answer, Classifier
from partialbench.benchmark.protocol.split import balanced_subset
from partialbench.benchmark.records import weights
from partialbench.benchmark.records.results import describe_data
from partialbench.benchmark.testing.evaluate import run_model
from partialbench.benchmark.testing.uncertainty import share_intervals
from partialbench.benchmark.training import checkpoint, packed
from partialbench.benchmark.training.find import find_checkpoint
from partialbench.dataset import manifest as manifests
from partialbench.dataset.descriptions import terms
from partialbench.dataset.loader import ShardDataset
from partialbench.dataset.shards import make_folder, write_atomically
from partialbench.errors import InputError, PartialbenchError

COMPARED = 512
"""Clouds on which the packed weights are held against those they were made from."""
MOST_DIFFERENCE = 0.02
"""Of any class's probability, that 16 bits may make; weights that differ more are refused."""
MOST_BYTES = 8_000_000
"""Of all that comes with a release."""


def pack(
    run: Path | str,
    tests: Mapping[str, Path | str],
    out: Path | str = weights.FOLDER,
    *,
    most_clouds: int | None = None,
    device: str = "cpu",
) -> dict[str, Any]:
    """Packs a finished training's weights under its model's name; returns the card.

    Args:
        run: checkpoint or folder, as ``find_checkpoint`` takes it.
        tests: words for what is tested on → data folder, whose test split is asked. The first is
            the folder that was trained on.
        out: folder to write into.
        most_clouds: of a test, taken evenly from the classes; None for all.

    Raises:
        InputError: no finished training of a registered model without changes (outside of a
            release: of its options), another data folder than it was trained on, or weights that 16
            bits change by more than ``MOST_DIFFERENCE``.
    """
    path, out = find_checkpoint(run), Path(out)
    content = checkpoint.load(path)
    checkpoint.require_finished(content, path, "be packed")
    name = content["model"]
    # Trained in another way than its card has it, a model is still that model.
    changed = content["variant" if out.resolve() == weights.FOLDER else "options"]
    if user_code.is_own(name) or changed:
        raise InputError(
            f"{path} is of {name} {content['variant']}".rstrip()
            + ": what comes with a release are registered models, as their cards have them, and "
            "what is kept elsewhere are models whose options their cards have"
        )
    if not tests:
        raise InputError("nothing to test on: the first test is the folder that was trained on")
    licence = terms(content["train_data"]["id"])
    if out.resolve() == weights.FOLDER and licence != "MIT":
        raise InputError(
            f"{path} was trained on {content['train_data']['id']}, for which {licence} hold: such "
            f"weights do not come with a release; give another --out to keep them for yourself"
        )
    _require_its_own(content, Path(next(iter(tests.values()))))
    files, card = packed.packed_files(content, name)
    again = {**content, "state": packed.widened(packed.rounded(content))}
    classifier = Classifier(path, device)
    card["rounding"] = _difference(classifier, again, Path(next(iter(tests.values()))))
    classifier.model = checkpoint.build_model(again).to(classifier.device)
    card["tests"] = [
        {"source": words, **_tested(classifier, Path(folder), most_clouds)}
        for words, folder in tests.items()
    ]
    card["card_sha256"] = weights.card_digest(card)
    make_folder(out)
    for file, data in {**files, f"{name}.json": weights.text(card)}.items():
        write_atomically(out / file, data)
    packed.load(out / f"{name}{weights.SUFFIX}")  # as whoever installs them will
    return card


def _require_its_own(content: Mapping[str, Any], folder: Path) -> None:
    """The first test's folder is the one that was trained on: digests tell."""
    found = manifests.load(folder).digests.get("train")
    if found != content["train_data"]["digest"]:
        raise InputError(
            f"{folder} is not what these weights were trained on (train split {str(found)[:12]}, "
            f"expected {content['train_data']['digest'][:12]}); give that folder first"
        )


def _difference(classifier: Classifier, again: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """See ``records.weights.Rounding``."""
    data = ShardDataset(folder, "test", again["num_points"])
    rows = balanced_subset(np.arange(len(data)), data.labels, COMPARED)
    models = (classifier.model, checkpoint.build_model(again).to(classifier.device))
    exact, packed_ = (
        torch.cat([
            answer.class_logits.double().softmax(1).cpu()
            for _, answer in run_model(one, data, rows, len(classifier.class_names),
                                       classifier.device)
        ])
        for one in models
    )  # fmt: skip
    most = float((exact - packed_).abs().max())
    if not most <= MOST_DIFFERENCE:
        raise InputError(
            f"16 bits change a probability by {most:.3f}, more than {MOST_DIFFERENCE}: these "
            f"weights cannot be packed"
        )
    same = float((exact.argmax(1) == packed_.argmax(1)).double().mean())
    return {"clouds": len(rows), "same_answers": same, "largest_difference": most}


def _tested(classifier: Classifier, folder: Path, most_clouds: int | None) -> dict[str, Any]:
    """See ``records.weights.Test``."""
    stored = manifests.load(folder).configuration["points"]
    data = ShardDataset(folder, "test", stored)
    known = np.isin(np.array(data.class_names)[data.labels], classifier.class_names)
    rows = balanced_subset(np.flatnonzero(known), data.labels, most_clouds)
    if not len(rows):
        raise InputError(f"{folder} shares no class with {classifier.name}: nothing to test on")
    right = np.zeros(len(rows))
    for i, row in enumerate(rows):
        distinct = data.points([row])[0][: data.n_visible[row]]
        answer = classifier.predict(distinct)
        assert isinstance(answer, Answer)
        right[i] = answer.class_name == data.class_names[data.labels[row]]
    objects = data.object_ids[rows]
    (interval,) = share_intervals(right[:, None], objects)
    return {
        "data": {**asdict(describe_data(data, rows)), "class_names": None},  # its digest tells
        "answered": len(rows),
        "left_out": int((~known).sum()),
        "objects": len(np.unique(objects)),
        "classes": len(np.unique(data.labels[rows])),
        "votes": VOTES,
        "accuracy": float(right.mean()),
        "interval": interval.tolist() if np.isfinite(interval).all() else None,
    }


def main(
    run: Annotated[Path, typer.Argument(help="a finished training: its checkpoint or folder")],
    on: Annotated[
        list[str],
        typer.Option(help="WORDS=FOLDER to test on; the first is the folder it was trained on"),
    ],
    out: Annotated[Path, typer.Option(help="where the files go")] = weights.FOLDER,
    most_clouds: Annotated[int | None, typer.Option(help="of a test, at most")] = None,
    page: Annotated[
        Path | None, typer.Option(help="a page of docs whose table of weights is made anew")
    ] = None,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda")] = "cpu",
) -> None:
    """Pack a finished training's weights into 16 bits, and test them."""
    tests = {}
    for one in on:
        words, equals, folder = one.rpartition("=")
        if not equals or not words:
            raise typer.BadParameter(f"--on takes WORDS=FOLDER, got {one!r}")
        tests[words] = Path(folder)
    card = pack(run, tests, out, most_clouds=most_clouds, device=device)
    if page is not None:
        packed_ = {path.stem: weights.read_card(path) for path in out.glob(f"*{weights.SUFFIX}")}
        text = page.read_text()
        before, after = text.partition(weights.MARK)[0], text.partition(weights.END)[2]
        if not after:
            raise InputError(f"{page} has no {weights.MARK} … {weights.END} to write between")
        write_atomically(page, (before + weights.block(packed_) + after).encode())
    typer.echo(weights.as_markdown({card["identity"]["model"]: card}), nl=False)
    rounding = card["rounding"]
    typer.echo(
        f"16 bits: {rounding['same_answers']:.2%} of {rounding['clouds']} answers are the same, "
        f"no probability differs by more than {rounding['largest_difference']:.4f}"
    )
    total = sum(path.stat().st_size for path in out.iterdir() if path.is_file())
    typer.echo(f"{total:,} of {MOST_BYTES:,} bytes in {out}")
    if total > MOST_BYTES:
        raise typer.Exit(1)


if __name__ == "__main__":
    try:
        typer.run(main)
    except PartialbenchError as error:
        raise SystemExit(f"error: {error}") from error
