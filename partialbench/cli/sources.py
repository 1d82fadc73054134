"""The verbs that write the built-in shapes out, and bring published arrays in."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Annotated

import typer

from partialbench import arguments, registry
from partialbench.cli.data import DataSet, say_source
from partialbench.cli.verbs import Verbs
from partialbench.console import Json, given, print_result
from partialbench.errors import PartialbenchError

commands = Verbs("Data")


@commands.command(epilog="Example: `partialbench shapes --out cad --counts 5,2 --formats off,glb`")
def shapes(
    out: Annotated[Path, typer.Option(help="folder to write the tree into")],
    counts: Annotated[str, typer.Option(help="per class: TRAIN,TEST or 'modelnet40'")] = "10,5",
    formats: Annotated[str, typer.Option(help="off, obj, glb; comma-separated")] = "off",
    classes: Annotated[
        str | None, typer.Option(help="only these, comma-separated", show_default="all forty")
    ] = None,
    seed: Annotated[int, typer.Option(help="another seed, other shapes")] = 0,
    as_json: Json = False,
) -> None:
    """Export the built-in CAD shapes in ModelNet40's tree layout."""
    written = registry.load(registry.SHAPE_EXPORT)(
        out,
        arguments.counts(counts),
        formats.split(","),
        classes.split(",") if classes else None,
        seed,
    )
    print_result({"out": str(out), "files": written}, as_json, f"{written:,} files in {out}")


@commands.command(
    name="import", epilog="Example: `partialbench import papnet release/ --out data/pm40`"
)
def import_release(
    release: Annotated[str, typer.Argument(help="whose layout: papnet, scanobjectnn")],
    folder: Annotated[Path, typer.Argument(help="holds the arrays as published")],
    out: Annotated[Path, typer.Option(help="the data folder to make")],
    data_set: Annotated[
        DataSet | None, typer.Option(help="papnet: which of the two the arrays hold")
    ] = None,
    allow_failures: Annotated[bool, typer.Option(help="exit 0 even if some rows are lost")] = False,
    as_json: Json = False,
) -> None:
    """Turn published arrays into a data folder: papnet (the paper's authors') or scanobjectnn."""
    if release not in registry.RELEASES:
        raise PartialbenchError(
            f"no release layout {release!r}{registry.close_matches(release, registry.RELEASES)}"
        )
    told = given(data_set=data_set and data_set.value)
    entry = registry.load(registry.RELEASES[release])
    if told and "data_set" not in inspect.signature(entry).parameters:
        raise PartialbenchError(f"--data-set does not apply to {release}: it is one data set")
    manifest = entry(folder, out, **told)
    if manifest.listing:
        say_source(manifest.listing)
    rows = {split: manifest.rows(split) for split in manifest.splits()}
    failed = sum(f["kind"] == "failed" for f in manifest.failures)
    print_result({"folder": str(out), "rows": rows, "failed": failed}, as_json,
            f"{out}: " + ", ".join(f"{n:,} {split} rows" for split, n in rows.items()))  # fmt: skip
    if failed and not allow_failures:
        raise PartialbenchError(
            f"{failed} row(s) were lost; {out / 'failures.jsonl'} has the reasons. Accept that "
            f"with --allow-failures"
        )
