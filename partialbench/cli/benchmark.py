"""The verbs that train, test and tune models, and classify with them."""

from __future__ import annotations

import dataclasses
import json
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich import box
from rich.table import Column, Table

from partialbench import arguments, registry
from partialbench.benchmark import preflight
from partialbench.cli.verbs import Verbs
from partialbench.console import Json, continued_by, print_result, stderr, stdout
from partialbench.errors import InputError, PartialbenchError

if TYPE_CHECKING:
    from partialbench.benchmark.predict import Answer

commands = Verbs("Models")

HOW_MUCH = (
    "smoke: a minute; board: the table's, one recipe for all; paper: its scale, published recipes"
)
WEIGHTS = (
    "what eval wrote (the file, its run's folder, a folder of results with one run), or the name "
    "of a model that comes with weights"
)
CLOUDS = "clouds to train to: 100k, or several: 25k,100k (repeatable)"


class Preset(StrEnum):
    smoke = "smoke"
    board = "board"
    paper = "paper"


class Log(StrEnum):
    csv = "csv"
    tensorboard = "tensorboard"


@commands.command()
def models(as_json: Json = False) -> None:
    """List the models that `eval --model` knows, and those that come with weights."""
    from partialbench.benchmark.records import weights

    cards, packed = registry.cards(), weights.names()
    if as_json:
        data = [
            {**registry.card_data(one), "weights": one.name in packed} for one in cards.values()
        ]
        print(json.dumps(data, indent=1))
        return
    # A name is typed again: it is never cut. In a file a line stays a line.
    table = Table(
        *(Column(name, no_wrap=name == "name" or not stdout.is_terminal)
          for name in ("name", "title", "input", "parameters (40)", "claims", "weights")),
        box=box.HEAVY_HEAD if stdout.is_terminal else None,
    )  # fmt: skip
    for card in cards.values():
        count = card.parameters.get(40)
        claims = ", ".join(sorted(card.invariances)) or "–"
        table.add_row(card.name, card.title, card.representation,
                      f"{count:,}" if count else "", claims,
                      "yes" if card.name in packed else "")  # fmt: skip
    if not stdout.is_terminal:
        stdout.width = 500
    stdout.print(table)


@commands.command(
    name="eval",
    panels={
        "Training": "preset clouds seeds first_seed recipe option protocol precision log "
        "checkpoint_every restart",
        "Testing": "test_data test_points test_pose test_damage test_grid",
    },
    epilog="Examples: `partialbench eval --model pointnet --data data/pm40` · "
    "`partialbench eval --model pointnet --data data/pm40 --clouds 400k` (goes on from the 100k) · "
    "`partialbench eval --model my_model:make --data data/pm40 --preset smoke` · "
    "`partialbench eval --model pointnet --data data/mine --start-from "
    "results/runs/…/checkpoint.pt --recipe lr=0.0003`",
)
def evaluate(
    model: Annotated[
        str, typer.Option(help="a name from 'partialbench models', or your module:factory")
    ],
    data: Annotated[Path | None, typer.Option(help="data folder to train and test on")] = None,
    checkpoint: Annotated[
        str | None, typer.Option(help=f"test weights instead of training: {WEIGHTS}")
    ] = None,
    start_from: Annotated[
        str | None, typer.Option(help="fine-tune: begin from weights, named as for --checkpoint")
    ] = None,
    preset: Annotated[Preset, typer.Option(help=HOW_MUCH)] = Preset.board,
    clouds: Annotated[
        list[str] | None, typer.Option(help=CLOUDS, show_default="those of the preset")
    ] = None,
    seeds: Annotated[int, typer.Option(help="how many trainings, one record each")] = 1,
    first_seed: Annotated[int, typer.Option(help="count seeds from here")] = 0,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda, cuda:1")] = "auto",
    precision: Annotated[str, typer.Option(help="of training: 32-true, bf16-mixed")] = "32-true",
    results: Annotated[Path, typer.Option(help="where records go")] = Path("results"),
    restart: Annotated[
        bool,
        typer.Option(help="train from the seed again; without it, what was begun is gone on with"),
    ] = False,
    log: Annotated[
        Log, typer.Option(help="csv, written at the end; or event files for TensorBoard too")
    ] = Log.csv,
    checkpoint_every: Annotated[
        int | None,
        typer.Option(help="save every so many steps too", show_default="every few minutes alone"),
    ] = None,
    protocol: Annotated[
        list[str] | None, typer.Option(help="change a protocol field: num_points=512 (repeatable)")
    ] = None,
    test_data: Annotated[
        Path | None, typer.Option(help="another data folder to test on as well")
    ] = None,
    test_points: Annotated[
        list[int] | None, typer.Option(help="test on clouds of so many points too (repeatable)")
    ] = None,
    test_pose: Annotated[
        list[str] | None,
        typer.Option(
            help="test with the pose given too: 0 for the true one, 15 for that with noise of ±15° "
            "on every Euler angle, class:0 for the true one under each class's own symmetry, "
            "random (repeatable)"
        ),
    ] = None,
    test_grid: Annotated[
        Path | None,
        typer.Option(help="test on every cell of a folder of render --grid too, or on one cell"),
    ] = None,
    test_damage: Annotated[
        list[str] | None,
        typer.Option(
            help="test on damaged clouds too: jitter:3, a name alone for its five strengths, or "
            "all (repeatable; docs/damage.md has the names)"
        ),
    ] = None,
    recipe: Annotated[
        list[str] | None, typer.Option(help="change the recipe: lr=0.01 (repeatable)")
    ] = None,
    option: Annotated[
        list[str] | None,
        typer.Option(
            help="for the model: k=5 (repeatable); with --checkpoint too, if its weights fit"
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Train a model under the protocol and test it; one record per milestone, seed and test set.

    Run again, it goes on: with an interrupted training, or to a later milestone.
    """
    preflight.check(
        model, data=[folder for folder in (data, test_data) if folder is not None], results=results,
        checkpoints=[path for path in (checkpoint, start_from) if path is not None],
        device=device, precision=precision,
    )  # fmt: skip
    from partialbench.benchmark.evaluation import evaluate as run
    from partialbench.benchmark.protocol import milestones

    with continued_by("the same command"):
        done = run(
            model, data, results=results, test_data=test_data, checkpoint_file=checkpoint,
            preset=preset.value, seeds=seeds, device=device, clouds=_clouds(clouds),
            restart=restart, first_seed=first_seed, start_from=start_from, precision=precision,
            log_to=log.value, checkpoint_every=checkpoint_every, test_points=test_points or (),
            test_poses=test_pose or (), test_damages=test_damage or (), test_grid=test_grid,
            recipe=arguments.pairs(recipe),
            options=arguments.texts(option), protocol=arguments.pairs(protocol),
        )  # fmt: skip
    if as_json:
        print(json.dumps([dataclasses.asdict(result) for result in done], indent=1))
        return
    for result in done:
        what = [result.test_data.setting, *map(" ".join, result.conditions.items())]
        tested = f"{result.test_data.id} ({', '.join(what)})"
        accuracy = result.scores["accuracy"]
        seen = milestones.name(result.training["clouds"])
        print(
            f"{result.row}, {seen} clouds, seed {result.seed}, on {tested}: accuracy {accuracy:.1%}"
        )
    if done:  # among several processes only the first has results
        print(
            f"records in {results}; 'partialbench leaderboard --results {results}' makes the table"
        )


def _clouds(given: list[str] | None) -> tuple[int, ...] | None:
    from partialbench.benchmark.protocol import milestones

    return milestones.parse_several(given) if given else None


@commands.command(
    panels={"Each trial": "preset clouds start_from seed protocol option precision"},
    epilog="Example: `partialbench tune --model dgcnn --data data/pm40 --try lr=0.001 "
    "--try lr=0.002 --try lr=0.004 --clouds 50k`",
)
def tune(
    model: Annotated[
        str, typer.Option(help="a name from 'partialbench models', or your module:factory")
    ],
    data: Annotated[Path, typer.Option(help="data folder; its test split is not opened")],
    tries: Annotated[
        list[str],
        typer.Option("--try", help="a recipe: lr=0.01, or lr=0.01,batch_size=16 (repeatable)"),
    ],
    preset: Annotated[Preset, typer.Option(help=HOW_MUCH)] = Preset.board,
    clouds: Annotated[
        str | None, typer.Option(help="clouds of a trial: 50k", show_default="those of the preset")
    ] = None,
    start_from: Annotated[
        str | None, typer.Option(help=f"each trial begins from weights: {WEIGHTS}")
    ] = None,
    seed: Annotated[int, typer.Option(help="of every trial")] = 0,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda, cuda:1")] = "auto",
    precision: Annotated[str, typer.Option(help="of training: 32-true, bf16-mixed")] = "32-true",
    results: Annotated[Path, typer.Option(help="where tuning.csv goes")] = Path("results"),
    protocol: Annotated[
        list[str] | None, typer.Option(help="change a protocol field: num_points=512 (repeatable)")
    ] = None,
    option: Annotated[
        list[str] | None, typer.Option(help="for the model: k=5 (repeatable)")
    ] = None,
    as_json: Json = False,
) -> None:
    """Compare recipes on the validation split; run again, it continues."""
    preflight.check(
        model, data=[data], results=results, device=device, precision=precision,
        checkpoints=[] if start_from is None else [start_from],
    )  # fmt: skip
    from partialbench.benchmark.records.trials import FILE
    from partialbench.benchmark.tune import tune as compare

    recipes = [arguments.pairs(arguments.parts(one)) for one in tries]
    with continued_by("the same command"):
        trials = compare(
            model, data, recipes, preset.value, seed, device, results, clouds=clouds,
            start_from=start_from, precision=precision, options=arguments.texts(option),
            protocol=arguments.pairs(protocol),
        )  # fmt: skip
    lines = [
        "diverged  " + t.recipe if t.validation_accuracy is None
        else f"{t.validation_accuracy:6.1%}  {t.recipe}"
        for t in trials
    ]  # fmt: skip
    print_result(
        {"model": model, "trials": [dataclasses.asdict(t) for t in trials]},
        as_json,
        "\n".join(["validation accuracy, best first:", *lines, f"recorded in {results / FILE}"]),
    )


@commands.command(
    epilog="Examples: `partialbench predict mug.ply` · "
    "`partialbench predict captures/ --checkpoint results --json` · "
    "`partialbench predict depth.png --intrinsics 525,525,319.5,239.5 --depth-scale 0.001`"
)
def predict(
    file: Annotated[
        Path,
        typer.Argument(
            help="one object: a cloud (.ply .pcd .xyz …) or a depth image (.png .npy); or a folder "
            "of them"
        ),
    ],
    checkpoint: Annotated[
        str,
        typer.Option(help=f"weights: {WEIGHTS}"),
    ] = "papnet-steered",
    model: Annotated[
        str | None,
        typer.Option(help="your module:factory, for weights of a model of your own"),
    ] = None,
    intrinsics: Annotated[
        str | None, typer.Option(help="FX,FY,CX,CY in pixels, for a depth image")
    ] = None,
    depth_scale: Annotated[
        float, typer.Option(help="units of a depth value: 0.001 for millimetres")
    ] = 1.0,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda, cuda:1")] = "auto",
    votes: Annotated[
        int, typer.Option(help="a dense capture is cut into up to so many clouds that vote")
    ] = 8,
    as_json: Json = False,
) -> None:
    """Classify captures of your own: class, confidence, and pose where the model has one."""
    K = None if intrinsics is None else arguments.numbers(intrinsics, 4, "--intrinsics")
    preflight.check_device(device)
    if model is not None:
        preflight.check_model(model)
    if not file.exists():
        raise InputError(f"no file at {file}")
    from partialbench.benchmark.training.find import find_checkpoint

    find_checkpoint(checkpoint)  # before torch is loaded
    from partialbench.benchmark.predict import Classifier, captures

    classifier = Classifier(checkpoint, device, model)
    stderr.print(f"note: {classifier.about}", markup=False, soft_wrap=True)
    if not file.is_dir():
        answer = classifier(file, K, depth_scale, votes)
        print_result(_answer_data(file, answer), as_json, "\n".join(_answer_lines(answer)))
        return
    failed = 0
    for one in captures(file):
        found: Answer | PartialbenchError
        try:
            found = classifier(one, K, depth_scale, votes)
        except PartialbenchError as error:
            failed, found = failed + 1, error
        if as_json:
            print(json.dumps(_answer_data(one, found)), flush=True)
        elif isinstance(found, PartialbenchError):
            stderr.print(f"error: {found}", markup=False, soft_wrap=not stderr.is_terminal)
        else:
            print(f"{one}: {found.class_name} {found.confidence:.1%}", flush=True)
    if failed:
        stderr.print(f"{failed} could not be classified")
        raise typer.Exit(1)


def _answer_data(file: Path, answer: Answer | PartialbenchError) -> dict[str, Any]:
    if isinstance(answer, PartialbenchError):
        return {"file": str(file), "error": str(answer)}
    return {
        "file": str(file), "class": answer.class_name, "confidence": answer.confidence,
        "top": answer.top, "points_given": answer.points_given, "points_used": answer.points_used,
        "poses": [{"R_camera_object": R.tolist(), "probability": p} for R, p in answer.poses],
    }  # fmt: skip


def _answer_lines(answer: Answer) -> list[str]:
    lines = [f"{name:14} {share:6.1%}" for name, share in answer.top]
    if answer.poses:
        lines.append(f"pose (R_camera_object, {answer.poses[0][1]:.1%}):")
        lines += ["  " + " ".join(f"{x:+.3f}" for x in row) for row in answer.poses[0][0]]
    return lines
