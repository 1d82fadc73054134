"""The verbs that make, check and show data; ``partialbench.cli`` joins them to the others."""

from __future__ import annotations

import json
import os
from collections import Counter
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from partialbench import arguments
from partialbench.cli.verbs import Verbs
from partialbench.console import Json, continued_by, given, print_result, stderr
from partialbench.dataset.settings import SETTINGS
from partialbench.errors import InputError, PartialbenchError

commands = Verbs("Data")


class DataSet(StrEnum):
    pm40 = "pm40"
    ps15 = "ps15"


Setting = StrEnum("Setting", {name: name for name in SETTINGS})  # type: ignore[misc]


@commands.command(
    panels={
        "What is seen": "setting views resolution camera sensor occluders grid min_visible radius "
        "gamma variant",
        "What is stored": "points keep_depth normals rows_per_shard",
        "Which objects": "objects_per_class counts split aligned up",
        "Scans and rooms (ps15)": "scannet scan2cad rooms viewpoints split_file label_map labels "
        "rule",
        "How it runs": "workers scheduler allow_failures retry_failed",
    },
    epilog="Examples: `partialbench render pm40 --out data/pm40` · "
    "`partialbench render pm40 --source ModelNet40.zip --out data/pm40` · "
    "`partialbench render ps15 --scannet scans/ --scan2cad full_annotations.json --out data/ps15`",
)
def render(
    data_set: Annotated[DataSet, typer.Argument(help="which data set to make")],
    out: Annotated[Path, typer.Option(help="the data folder to make or to continue")],
    source: Annotated[
        str | None,
        typer.Option(
            help="a source by name, or a path: ModelNet40 tree or zip, folder of meshes, "
            "clouds (HDF5 or folder)",
            show_default="the built-in shapes; ps15: simulated rooms",
        ),
    ] = None,
    setting: Annotated[
        Setting,
        typer.Option(
            help="partial views, the same turned about z or aligned, or complete clouds rotated, "
            "turned about z or aligned"
        ),
    ] = Setting("partial"),
    views: Annotated[
        int | None, typer.Option(help="viewpoints per training object", show_default="10")
    ] = None,
    objects_per_class: Annotated[
        int | None,
        typer.Option(help="at most so many of each class in each split", show_default="all"),
    ] = None,
    counts: Annotated[
        str | None,
        typer.Option(
            help="built-in shapes: objects per class, TRAIN,TEST or 'modelnet40'",
            show_default="100,20",
        ),
    ] = None,
    points: Annotated[int, typer.Option(help="points stored per cloud")] = 2048,
    resolution: Annotated[
        int | None, typer.Option(help="depth image side in pixels", show_default="256")
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(
            help="FX,FY,CX,CY,WIDTH,HEIGHT in pixels: one fixed camera that may cut objects",
            show_default="a crop fitted to each",
        ),
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option(
            help="ideal; depth noise of kinect-v1 or tof; or active stereo, rendered: stereo-d415, "
            "stereo-kinect-v1; with :STRENGTH",
            show_default="ideal; rooms are scanned with kinect-v1",
        ),
    ] = None,
    occluders: Annotated[
        float,
        typer.Option(
            help="put other objects of the source before each (ps15: furniture of its scan), to "
            "hide about this share of what is seen of it: 0 to 0.9"
        ),
    ] = 0.0,
    grid: Annotated[
        Path | None,
        typer.Option(
            help="a TOML file of rotation, shown, sensor, occluders (docs/grid.md): a data folder "
            "in --out for each combination, of the test split"
        ),
    ] = None,
    keep_depth: Annotated[bool, typer.Option(help="store the depth images too")] = False,
    normals: Annotated[bool, typer.Option(help="store the points' surface normals too")] = False,
    min_visible: Annotated[
        int | None,
        typer.Option(
            help="turn views away that show fewer distinct points", show_default="16; ps15: 128"
        ),
    ] = None,
    radius: Annotated[
        float | None, typer.Option(help="hidden point removal: radius of the spherical flip")
    ] = None,
    gamma: Annotated[
        float | None,
        typer.Option(
            help="the same as 10^gamma · the largest distance", show_default="1.5; scans: 2.5"
        ),
    ] = None,
    aligned: Annotated[
        bool, typer.Option(help="the shapes are of the aligned release (recorded in the data)")
    ] = False,
    up: Annotated[
        str | None,
        typer.Option(
            help="the files' up axis, z or y", show_default="z; modelnet40_ply_hdf5_2048: y"
        ),
    ] = None,
    scannet: Annotated[Path | None, typer.Option(help="folder of ScanNet scans")] = None,
    scan2cad: Annotated[Path | None, typer.Option(help="full_annotations.json")] = None,
    rooms: Annotated[
        int | None, typer.Option(help="how many rooms to simulate", show_default="50")
    ] = None,
    viewpoints: Annotated[
        str | None,
        typer.Option(
            help="uniform (the paper's) or standing (a person with a camera)",
            show_default="uniform",
        ),
    ] = None,
    split_file: Annotated[
        list[Path] | None,
        typer.Option(
            help='scannetv2_train.txt (repeat for …_val.txt), or JSON {"train": [scene, …], '
            '"test": […]}'
        ),
    ] = None,
    label_map: Annotated[
        Path | None, typer.Option(help="scannetv2-labels.combined.tsv, if not with the scans")
    ] = None,
    labels: Annotated[
        str | None,
        typer.Option(
            help="numbers in labels files: nyu40, scannet", show_default="as the scan says"
        ),
    ] = None,
    rule: Annotated[
        list[str] | None,
        typer.Option(help="a threshold, NAME=VALUE (repeatable); docs/ps15.md has the names"),
    ] = None,
    split: Annotated[
        list[str] | None, typer.Option(help="only this split (repeatable)", show_default="all")
    ] = None,
    seed: Annotated[int, typer.Option(help="of every random draw")] = 0,
    workers: Annotated[
        int, typer.Option(help="processes side by side", show_default="0: one a core")
    ] = 0,
    scheduler: Annotated[
        str | None, typer.Option(help="run on the Dask cluster at this address (tcp://…)")
    ] = None,
    variant: Annotated[
        str | None,
        typer.Option(help="of Mitsuba: llvm_ad_rgb, …", show_default="the fastest that works here"),
    ] = None,
    rows_per_shard: Annotated[int, typer.Option(help="rows per file")] = 1000,
    allow_failures: Annotated[
        bool, typer.Option(help="exit 0 even if some inputs were broken")
    ] = False,
    retry_failed: Annotated[
        bool, typer.Option(help="make the shards anew in which an input failed, once it is mended")
    ] = False,
    as_json: Json = False,
) -> None:
    """Turn shapes into pose-labelled partial clouds. Run again, it continues where it stopped."""
    from partialbench.dataset import grid as grids
    from partialbench.dataset.executors import process_pool
    from partialbench.dataset.render import plan_render, run_plan
    from partialbench.dataset.render_grid import plan_grid
    from partialbench.progress import build_bar, counting_bar

    workers = workers or os.cpu_count() or 1
    if grid is not None and (setting.value != "partial" or sensor or occluders):
        raise InputError(
            "--grid has --setting, --sensor and --occluders as its axes: give them in its file"
        )
    options: dict[str, Any] = dict(
        source=source,
        source_options=given(
            aligned=aligned or None, up=up, counts=counts and arguments.counts(counts),
            scannet=scannet, scan2cad=scan2cad, rooms=rooms, viewpoints=viewpoints,
            split_file=split_file or None, label_map=label_map, labels=labels,
            rules=arguments.pairs(rule) or None,
        ),
        occluder_options=given(
            resolution=resolution, camera=camera and arguments.camera(camera), variant=variant,
            occluders=occluders or None, keep_depth=keep_depth or None, radius=radius, gamma=gamma,
        ),
        views=views, objects_per_class=objects_per_class, points=points, min_visible=min_visible,
        normals=normals, seed=seed, rows_per_shard=rows_per_shard, workers=workers,
        on_room=counting_bar(stderr, "simulate rooms"), on_scene=counting_bar(stderr, "read scans"),
        **given(splits=split or None),
    )  # fmt: skip
    with continued_by("the same command"):
        if grid is None:
            name = data_set.value
            plans = [plan_render(name, out, setting=setting.value, sensor=sensor, **options)]
        else:
            cells = grids.load(grid)
            plans = [*plan_grid(data_set.value, out, cells, **options).values()]
            grids.write(out, cells)
    broken: list[tuple[Path, Any]] = []
    told: list[dict[str, Any]] = []
    for plan in plans:
        with continued_by("the same command"), build_bar(stderr) as on_progress:
            manifest = run_plan(
                plan, workers=workers, scheduler=scheduler, on_progress=on_progress,
                # One worker too is a process of its own: a crash in it ends no run.
                make_executor=partial(process_pool, workers), retry_failed=retry_failed,
                on_listing=None if told else say_source,
            )  # fmt: skip
        told.append(_told(plan.out, manifest))
        if not as_json:
            print(_in_words(plan.out, manifest))
        if any(f["kind"] == "failed" for f in manifest.failures):
            broken.append((plan.out, manifest))
    if as_json:
        print(json.dumps(told[0] if grid is None else told, indent=1))
    if broken and not allow_failures:
        folder, manifest = broken[0]
        failed = sum(f["kind"] == "failed" for f in manifest.failures)
        raise PartialbenchError(
            f"{failed} input(s) could not be used; {folder / 'failures.jsonl'} has the "
            f"reasons. The rest is complete: accept that with --allow-failures, or mend them and "
            f"{_then(manifest)}"
        )


def _told(folder: Path, manifest: Any) -> dict[str, Any]:
    """What a finished folder holds, for ``--json``; what was noticed of its objects, on stderr."""
    from partialbench.dataset.objects import notice_lines

    for line in notice_lines(folder):
        stderr.print(f"note: {line}", markup=False, soft_wrap=True)
    kinds = Counter(f["kind"] for f in manifest.failures)
    return {
        "folder": str(folder), "dataset_id": manifest.dataset_id,
        "rows": {split: manifest.rows(split) for split in manifest.splits()},
        "failed": kinds["failed"], "rejected": kinds["rejected"], "digests": manifest.digests,
    }  # fmt: skip


def _in_words(folder: Path, manifest: Any) -> str:
    from partialbench.dataset.card import paper_rows

    rejected = sum(f["kind"] == "rejected" for f in manifest.failures)
    return (
        f"{manifest.dataset_id} in {folder}: "
        + ", ".join(
            f"{manifest.rows(split):,} {split} rows"
            + (f" (the paper: {paper:,})" if (paper := paper_rows(manifest, split)) else "")
            for split in manifest.splits()
        )
        + (f"; {rejected} turned away by a rule" if rejected else "")
    )


def _then(manifest: Any) -> str:
    """What to do once the inputs that failed are mended."""
    unlisted = sum(f["kind"] == "failed" for f in manifest.listing_failures)
    # What listing could not read is another listing once it is mended, and so another data set.
    new = f"render into a new folder, as {unlisted} of them could not be listed"
    return new if unlisted else "run the same command with --retry-failed"


def say_source(listing: str) -> None:
    stderr.print(f"source: {listing}", markup=False, soft_wrap=True)


@commands.command(epilog="Example: `partialbench verify data/pm40 --source ModelNet40.zip`")
def verify(
    folder: Annotated[Path, typer.Argument(help="a data folder, or an export of one")],
    source: Annotated[
        str | None,
        typer.Option(
            help="what it was made from, to check points against surfaces",
            show_default="the built-in shapes, where it was made from them",
        ),
    ] = None,
    scannet: Annotated[Path | None, typer.Option(help="ps15: the same, its scans")] = None,
    scan2cad: Annotated[Path | None, typer.Option(help="ps15: and their annotations")] = None,
    as_json: Json = False,
) -> None:
    """Check digests, schema, values, poses, and that points lie on the source's surface."""
    from partialbench.dataset.export import check_export, is_export
    from partialbench.dataset.render import source_of
    from partialbench.dataset.verify import verify as check

    if is_export(folder):
        problems = check_export(folder)
        words = [*(f"problem: {p}" for p in problems),
                 f"{folder} is {'NOT sound' if problems else 'sound'}: an export"]  # fmt: skip
        print_result({"folder": str(folder), "sound": not problems, "problems": problems},
                     as_json, "\n".join(words))  # fmt: skip
        if problems:
            raise typer.Exit(1)
        return
    options = given(scannet=scannet, scan2cad=scan2cad)
    opened, missing = source_of(folder, "scannet" if options else source, options)
    report = check(folder, opened, no_source=missing)
    facts = [f"{n:,} {split} rows" for split, n in report.rows.items()]
    if report.surface:
        facts.append(f"points within {report.surface['max']:.1e} of the surface")
    summary = ", ".join(facts)
    for note in report.notes:
        stderr.print(f"note: {note}", markup=False, soft_wrap=True)
    print_result(
        {"folder": str(folder), "sound": report.sound, "problems": report.problems,
         "rows": report.rows, "surface": report.surface},
        as_json,
        "\n".join([*(f"problem: {p}" for p in report.problems),
                   f"{folder} is {'sound' if report.sound else 'NOT sound'}: {summary}"]),
    )  # fmt: skip
    if not report.sound:
        raise typer.Exit(1)


@commands.command(epilog="Example: `partialbench show data/pm40 --out page.html`")
def show(
    folder: Annotated[Path, typer.Argument(help="a data folder")],
    out: Annotated[Path, typer.Option(help=".png for a picture, .html to turn by hand")] = Path(
        "samples.png"
    ),
    split: Annotated[str, typer.Option(help="which split")] = "train",
    samples: Annotated[int, typer.Option(help="how many clouds")] = 24,
    seed: Annotated[int, typer.Option(help="which ones")] = 0,
    as_json: Json = False,
) -> None:
    """Draw a page of samples: cloud by depth, canonical axes, visible fraction."""
    from partialbench.dataset.show import show as draw

    page = draw(folder, out, split, samples, seed)
    print_result({"page": str(page)}, as_json, str(page))
