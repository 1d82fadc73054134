"""The verbs for others: data in the formats of other libraries, and what works on a machine."""

from __future__ import annotations

import dataclasses
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from partialbench.cli.verbs import Verbs
from partialbench.console import Json, continued_by, print_result, stderr
from partialbench.errors import PartialbenchError

commands = Verbs("For others")


class Target(StrEnum):
    parquet = "parquet"
    webdataset = "webdataset"
    bop = "bop"


@commands.command(
    epilog="Examples: `partialbench export data/pm40 --to parquet --out pm40-parquet` · "
    "`partialbench export data/mine --to bop --source meshes/ --out mine-bop`"
)
def export(
    folder: Annotated[Path, typer.Argument(help="a data folder")],
    to: Annotated[Target, typer.Option(help="parquet, webdataset (tar files) or bop")],
    out: Annotated[Path, typer.Option(help="folder to write into, or to continue")],
    source: Annotated[
        str | None, typer.Option(help="bop: what the data were made from, for the models")
    ] = None,
    as_json: Json = False,
) -> None:
    """Write a data folder for other libraries. Run again, it continues where it stopped."""
    from partialbench.dataset.export import export as write
    from partialbench.progress import counting_bar

    bar = counting_bar(stderr, f"export to {to.value}")
    with continued_by("the same command"):
        done = write(folder, to.value, out, source=source, on_progress=bar)
    rows = sum(one.rows for one in done)
    size = sum(one.bytes for one in done)
    print_result(
        {"out": str(out), "rows": rows, "parts": [dataclasses.asdict(one) for one in done]},
        as_json,
        f"{rows:,} rows in {len(done):,} parts, {size / 2**20:,.1f} MiB, in {out}; "
        f"'partialbench verify {out}' checks them",
    )


@commands.command(epilog="Example: `partialbench doctor`")
def doctor(as_json: Json = False) -> None:
    """Tell what works on this machine, and for what does not how to have it."""
    from partialbench.doctor import examine

    findings = examine()
    signs = {True: "yes", False: "no "}
    print_result(
        {"findings": [dataclasses.asdict(one) for one in findings]},
        as_json,
        "\n".join(f"{signs[one.works]}  {one.what:26} {one.details}".rstrip() for one in findings),
    )
    if not all(one.works for one in findings if one.needed):
        raise PartialbenchError("what every command needs does not work here; see above")
