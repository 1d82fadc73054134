"""The command line: verbs only. Each parses, calls one public function and prints its result.

stdout carries the result, stderr the log and the progress bar. Exit status: 0 done, 1 failed,
2 wrong usage, 130 interrupted (what was finished is kept).
"""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import sys
from collections import Counter
from concurrent.futures import Executor
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.logging import RichHandler
from rich.table import Table

from partialbench import __version__, arguments, registry
from partialbench.errors import PartialbenchError

app = typer.Typer(
    name="partialbench",
    help="Pose-labelled single-view partial point clouds, and a benchmark of classifiers on them.",
    epilog="Start with: partialbench quickstart",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)
stdout = Console(highlight=False, soft_wrap=True)
stderr = Console(stderr=True, highlight=False)


class DataSet(StrEnum):
    pm40 = "pm40"
    ps15 = "ps15"


class Setting(StrEnum):
    partial = "partial"
    rotated = "rotated"
    aligned = "aligned"


class Preset(StrEnum):
    smoke = "smoke"
    mini = "mini"
    paper = "paper"


Json = Annotated[bool, typer.Option("--json", help="print the result as JSON")]


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="print the version")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="log more")] = False,
) -> None:
    if version:
        print(__version__)
        raise typer.Exit
    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING,
        format="%(message)s",
        handlers=[RichHandler(console=stderr, show_path=False)],
        force=True,
    )


@app.command(
    epilog="Examples: `partialbench render pm40 --out data/pm40` · "
    "`partialbench render pm40 --source ModelNet40.zip --out data/pm40` · "
    "`partialbench render ps15 --scannet scans/ --scan2cad full_annotations.json --out data/ps15`"
)
def render(
    data_set: Annotated[DataSet, typer.Argument(help="which data set to make")],
    out: Annotated[Path, typer.Option(help="the data folder to make or to continue")],
    source: Annotated[
        str | None,
        typer.Option(
            help="a source by name, or a path: ModelNet40 tree or zip, folder of meshes, "
            "clouds (HDF5 or folder); default: the built-in one"
        ),
    ] = None,
    setting: Annotated[
        Setting, typer.Option(help="partial views, or complete clouds")
    ] = Setting.partial,
    views: Annotated[int | None, typer.Option(help="viewpoints per training object [10]")] = None,
    objects_per_class: Annotated[
        int | None, typer.Option(help="at most so many of each class in each split")
    ] = None,
    counts: Annotated[
        str | None,
        typer.Option(help="built-in shapes: objects per class, TRAIN,TEST or 'modelnet40'"),
    ] = None,
    points: Annotated[int, typer.Option(help="points stored per cloud")] = 2048,
    resolution: Annotated[int | None, typer.Option(help="depth image side in pixels [256]")] = None,
    camera: Annotated[
        str | None,
        typer.Option(
            help="FX,FY,CX,CY,WIDTH,HEIGHT in pixels: one fixed camera that may cut "
            "objects, instead of a crop fitted to each"
        ),
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option(
            help="depth noise: ideal, kinect-v1 or tof, with :STRENGTH [ideal; rooms are "
            "scanned with kinect-v1]"
        ),
    ] = None,
    keep_depth: Annotated[bool, typer.Option(help="store the depth images too")] = False,
    radius: Annotated[
        float | None, typer.Option(help="hidden point removal: radius of the spherical flip")
    ] = None,
    gamma: Annotated[
        float | None, typer.Option(help="the same as 10^gamma · the largest distance [1.75]")
    ] = None,
    aligned: Annotated[
        bool, typer.Option(help="the meshes are of the aligned release (recorded in the data)")
    ] = False,
    up: Annotated[str | None, typer.Option(help="mesh folders: the up axis, z or y")] = None,
    scannet: Annotated[Path | None, typer.Option(help="ps15: folder of ScanNet scans")] = None,
    scan2cad: Annotated[Path | None, typer.Option(help="ps15: full_annotations.json")] = None,
    rooms: Annotated[int | None, typer.Option(help="ps15: how many rooms to simulate")] = None,
    viewpoints: Annotated[
        str | None, typer.Option(help="ps15: standing (a person with a camera) or uniform")
    ] = None,
    split_file: Annotated[
        Path | None, typer.Option(help='ps15: JSON {"train": [scene, …], "test": […]}')
    ] = None,
    split: Annotated[
        list[str] | None, typer.Option(help="only this split (repeat for more); default: all")
    ] = None,
    seed: Annotated[int, typer.Option(help="of every random draw")] = 0,
    workers: Annotated[int, typer.Option(help="processes; 0: one per core")] = 0,
    scheduler: Annotated[
        str | None, typer.Option(help="run on the Dask cluster at this address (tcp://…)")
    ] = None,
    variant: Annotated[
        str | None, typer.Option(help="Mitsuba variant [auto: the fastest that works here]")
    ] = None,
    rows_per_shard: Annotated[int, typer.Option(help="rows per file")] = 1000,
    allow_failures: Annotated[
        bool, typer.Option(help="exit 0 even if some inputs were broken")
    ] = False,
    as_json: Json = False,
) -> None:
    """Turn shapes into pose-labelled partial clouds. Run again, it continues where it stopped."""
    from partialbench.dataset.card import paper_rows
    from partialbench.dataset.render import plan_render
    from partialbench.progress import counting_bar

    workers = workers or os.cpu_count() or 1
    listed = counting_bar(stderr, "simulate rooms")
    plan = plan_render(
        data_set.value,
        out,
        source=source,
        source_options=_given(
            aligned=aligned or None, up=up, counts=counts and arguments.counts(counts),
            scannet=scannet, scan2cad=scan2cad, rooms=rooms, viewpoints=viewpoints,
            split_file=split_file,
        ),
        occluder_options=_given(
            resolution=resolution, camera=camera and arguments.camera(camera), variant=variant,
            keep_depth=keep_depth or None, radius=radius, gamma=gamma,
        ),
        sensor=sensor,
        workers=workers,
        on_room=listed,
        setting=setting.value,
        views=views,
        splits=tuple(split) if split else None,
        objects_per_class=objects_per_class,
        points=points,
        seed=seed,
        rows_per_shard=rows_per_shard,
    )  # fmt: skip
    manifest = _build(plan, workers, scheduler)
    kinds = Counter(f["kind"] for f in manifest.failures)
    rows = {split: manifest.rows(split) for split in manifest.splits()}
    _result(
        {"folder": str(out), "dataset_id": manifest.dataset_id, "rows": rows,
         "failed": kinds["failed"], "rejected": kinds["rejected"], "digests": manifest.digests},
        as_json,
        f"{manifest.dataset_id} in {out}: "
        + ", ".join(
            f"{n:,} {split} rows (the paper: {paper_rows(manifest, split):,})"
            for split, n in rows.items()
        )
        + (f"; {kinds['rejected']} turned away by a rule" if kinds["rejected"] else ""),
    )  # fmt: skip
    if kinds["failed"] and not allow_failures:
        raise PartialbenchError(
            f"{kinds['failed']} input(s) could not be used; {out / 'failures.jsonl'} has the "
            f"reasons. The rest is complete; accept that with --allow-failures"
        )


def _build(plan: Any, workers: int, scheduler: str | None) -> Any:
    """Run a plan with a progress bar on stderr."""
    from partialbench.dataset.build import build
    from partialbench.dataset.executors import dask_cluster, process_pool
    from partialbench.progress import build_bar

    if scheduler:
        cluster = dask_cluster(scheduler)
        workers = cluster.workers
        cluster.shutdown()

    def make_executor() -> Executor:
        return dask_cluster(scheduler) if scheduler else process_pool(workers)

    with build_bar(stderr) as on_progress:
        return build(plan, make_executor, workers, on_progress)


@app.command(epilog="Example: `partialbench verify data/pm40 --source ModelNet40.zip`")
def verify(
    folder: Annotated[Path, typer.Argument(help="a data folder")],
    source: Annotated[
        str | None, typer.Option(help="what it was made from, to check points against surfaces")
    ] = None,
    scannet: Annotated[Path | None, typer.Option(help="ps15: the same, its scans")] = None,
    scan2cad: Annotated[Path | None, typer.Option(help="ps15: and their annotations")] = None,
    as_json: Json = False,
) -> None:
    """Check digests, schema, values, poses, and that points lie on the source's surface."""
    from partialbench.dataset.render import source_of
    from partialbench.dataset.verify import verify as check

    options = _given(scannet=scannet, scan2cad=scan2cad)
    report = check(folder, source_of(folder, "scannet" if options else source, options))
    facts = [f"{n:,} {split} rows" for split, n in report.rows.items()]
    if report.surface:
        facts.append(f"points within {report.surface['max']:.1e} of the surface")
    summary = ", ".join(facts)
    for note in report.notes:
        stderr.print(f"note: {note}")
    _result(
        {"folder": str(folder), "sound": report.sound, "problems": report.problems,
         "rows": report.rows, "surface": report.surface},
        as_json,
        "\n".join([*(f"problem: {p}" for p in report.problems),
                   f"{folder} is {'sound' if report.sound else 'NOT sound'}: {summary}"]),
    )  # fmt: skip
    if not report.sound:
        raise typer.Exit(1)


@app.command(epilog="Example: `partialbench show data/pm40 --out page.html`")
def show(
    folder: Annotated[Path, typer.Argument(help="a data folder")],
    out: Annotated[Path, typer.Option(help=".png for a picture, .html to turn by hand")] = Path(
        "samples.png"
    ),
    split: Annotated[str, typer.Option(help="which split")] = "train",
    samples: Annotated[int, typer.Option(help="how many clouds")] = 24,
    seed: Annotated[int, typer.Option(help="which ones")] = 0,
) -> None:
    """Draw a page of samples: cloud by depth, canonical axes, visible fraction."""
    from partialbench.dataset.show import show as draw

    print(draw(folder, out, split, samples, seed))


@app.command()
def models(as_json: Json = False) -> None:
    """List the models that `eval --model` knows."""
    cards = registry.cards()
    if as_json:
        from partialbench.registry import card_data

        print(json.dumps([card_data(card) for card in cards.values()], indent=1))
        return
    table = Table("name", "title", "input", "parameters (40)", "claims", "reference")
    for card in cards.values():
        count = card.parameters.get(40)
        claims = ", ".join(sorted(card.invariances)) or "–"
        table.add_row(card.name, card.title, card.representation,
                      f"{count:,}" if count else "", claims, card.reference)  # fmt: skip
    stdout.print(table)


@app.command(
    name="eval",
    epilog="Examples: `partialbench eval --model pointnet --data data/pm40` · "
    "`partialbench eval --model my_model:make --data data/pm40 --preset smoke`",
)
def evaluate(
    model: Annotated[
        str, typer.Option(help="a name from 'partialbench models', or your module:factory")
    ],
    data: Annotated[Path, typer.Option(help="data folder to train and test on")],
    test_data: Annotated[
        Path | None, typer.Option(help="another data folder to test on as well")
    ] = None,
    checkpoint: Annotated[
        Path | None, typer.Option(help="test these weights instead of training")
    ] = None,
    preset: Annotated[
        Preset, typer.Option(help="how much: a minute, real use, the paper's scale")
    ] = Preset.mini,
    seeds: Annotated[int, typer.Option(help="how many trainings, one record each")] = 1,
    first_seed: Annotated[int, typer.Option(help="count seeds from here")] = 0,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda, cuda:1")] = "auto",
    precision: Annotated[str, typer.Option(help="of training: 32-true, bf16-mixed")] = "32-true",
    results: Annotated[Path, typer.Option(help="where records go")] = Path("results"),
    resume: Annotated[bool, typer.Option(help="continue interrupted trainings")] = False,
    protocol: Annotated[
        list[str] | None, typer.Option(help="change a protocol field: epochs=2, num_points=256")
    ] = None,
    recipe: Annotated[list[str] | None, typer.Option(help="change the recipe: lr=0.01")] = None,
    option: Annotated[list[str] | None, typer.Option(help="for the model: k=5")] = None,
    as_json: Json = False,
) -> None:
    """Train a model under the protocol and test it; one record per seed and test set."""
    from partialbench.benchmark.run import run_eval

    done = run_eval(
        model, data, test_data, checkpoint, preset.value, seeds, device, results, resume,
        first_seed=first_seed, precision=precision, recipe=arguments.pairs(recipe),
        options=arguments.pairs(option), **arguments.pairs(protocol),
    )  # fmt: skip
    if as_json:
        print(json.dumps([dataclasses.asdict(result) for result in done], indent=1))
        return
    for result in done:
        tested = f"{result.test_data.id} ({result.test_data.setting})"
        accuracy = result.scores["accuracy"]
        print(f"{result.row}, seed {result.seed}, on {tested}: accuracy {accuracy:.1%}")
    print(f"records in {results}; 'partialbench leaderboard --results {results}' makes the table")


@app.command(
    epilog="Examples: `partialbench predict --checkpoint results/runs/…/checkpoint.pt mug.ply` · "
    "`partialbench predict --checkpoint C depth.png --intrinsics 525,525,319.5,239.5 "
    "--depth-scale 0.001`"
)
def predict(
    file: Annotated[
        Path,
        typer.Argument(help="one object: a cloud (.ply .xyz .npy) or a depth image (.png .npy)"),
    ],
    checkpoint: Annotated[Path, typer.Option(help="written by eval")],
    intrinsics: Annotated[
        str | None, typer.Option(help="FX,FY,CX,CY in pixels, for a depth image")
    ] = None,
    depth_scale: Annotated[float, typer.Option(help="units of a depth value")] = 1.0,
    device: Annotated[str, typer.Option(help="cpu, cuda")] = "cpu",
    as_json: Json = False,
) -> None:
    """Classify a capture of your own: class, confidence, and pose where the model has one."""
    from partialbench.benchmark.predict import predict as classify

    K = None if intrinsics is None else arguments.numbers(intrinsics, 4, "--intrinsics")
    answer = classify(checkpoint, file, K, depth_scale, device)
    data = {
        "file": str(file), "class": answer.top[0][0], "confidence": answer.top[0][1],
        "top": answer.top, "points_given": answer.points_given,
        "poses": [{"R_camera_object": R.tolist(), "probability": p} for R, p in answer.poses],
    }  # fmt: skip
    lines = [f"{name:14} {share:6.1%}" for name, share in answer.top]
    if answer.poses:
        lines.append(f"pose (R_camera_object, {answer.poses[0][1]:.1%}):")
        lines += ["  " + " ".join(f"{x:+.3f}" for x in row) for row in answer.poses[0][0]]
    _result(data, as_json, "\n".join(lines))


@app.command(epilog="Example: `partialbench leaderboard --results results --out board`")
def leaderboard(
    results: Annotated[Path, typer.Option(help="folder of records")] = Path("results"),
    out: Annotated[Path, typer.Option(help="where tables go")] = Path("leaderboard_out"),
) -> None:
    """Make the tables anew from the records."""
    for path in registry.load(registry.LEADERBOARD)(results, out):
        print(path)


@app.command(epilog="Example: `partialbench shapes --out cad --counts 5,2 --formats off,glb`")
def shapes(
    out: Annotated[Path, typer.Option(help="folder to write the tree into")],
    counts: Annotated[str, typer.Option(help="per class: TRAIN,TEST or 'modelnet40'")] = "10,5",
    formats: Annotated[str, typer.Option(help="off, obj, glb; comma-separated")] = "off",
    classes: Annotated[str | None, typer.Option(help="only these, comma-separated")] = None,
    seed: Annotated[int, typer.Option(help="another seed, other shapes")] = 0,
) -> None:
    """Export the built-in CAD shapes in ModelNet40's tree layout."""
    written = registry.load(registry.SHAPE_EXPORT)(
        out,
        arguments.counts(counts),
        formats.split(","),
        classes.split(",") if classes else None,
        seed,
    )
    print(f"{written:,} files in {out}")


@app.command(name="import", epilog="Example: `partialbench import papnet release/ --out data/pm40`")
def import_release(
    release: Annotated[str, typer.Argument(help="whose layout: papnet")],
    folder: Annotated[Path, typer.Argument(help="holds train_points.npy and the others")],
    out: Annotated[Path, typer.Option(help="the data folder to make")],
    as_json: Json = False,
) -> None:
    """Turn the arrays the paper's authors released into a data folder."""
    if release not in registry.RELEASES:
        raise PartialbenchError(
            f"no release layout {release!r}{registry.close_matches(release, registry.RELEASES)}"
        )
    manifest = registry.load(registry.RELEASES[release])(folder, out)
    rows = {split: manifest.rows(split) for split in manifest.splits()}
    _result({"folder": str(out), "rows": rows}, as_json,
            f"{out}: " + ", ".join(f"{n:,} {split} rows" for split, n in rows.items()))  # fmt: skip


@app.command()
def quickstart(
    out: Annotated[Path, typer.Option(help="where everything goes")] = Path("quickstart"),
    model: Annotated[str, typer.Option(help="which model to train")] = "pointnet",
    workers: Annotated[int, typer.Option(help="processes; 0: one per core")] = 0,
) -> None:
    """The whole job, small: render built-in shapes, train, test, table, gallery. Minutes."""
    from partialbench.quickstart import quickstart as run

    print(run(out, model, workers or os.cpu_count() or 1, stderr))


def _given(**options: Any) -> dict[str, Any]:
    """The options a user gave: those that are not None."""
    return {name: value for name, value in options.items() if value is not None}


def _result(data: dict[str, Any], as_json: bool, text: str) -> None:
    print(json.dumps(data, indent=1) if as_json else text)


def main() -> None:
    """Entry point: turns expected errors into one line on stderr and exit status 1."""
    # A user's own model lives in the folder they stand in.
    sys.path.insert(0, os.getcwd())
    try:
        app()
    except PartialbenchError as error:
        stderr.print(f"[bold red]error:[/] {_escaped(str(error))}")
        sys.exit(1)
    except KeyboardInterrupt:
        stderr.print("interrupted; what was finished is kept, the same command continues it")
        sys.exit(130)


def _escaped(text: str) -> str:
    from rich.markup import escape

    return escape(text)
