"""Progress bars on stderr."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from partialbench.dataset.build import Progress as BuildProgress


@contextlib.contextmanager
def build_bar(console: Console) -> Iterator[Callable[[BuildProgress], None]]:
    """A bar over objects with views per second and time left; yields what ``build`` calls."""
    columns = (
        TextColumn("render"), BarColumn(), MofNCompleteColumn(), TextColumn("objects"),
        TextColumn("{task.fields[rate]}"), TimeElapsedColumn(), TextColumn("left"),
        TimeRemainingColumn(), TextColumn("{task.fields[trouble]}"),
    )  # fmt: skip
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("render", total=None, rate="", trouble="")

        def update(now: BuildProgress) -> None:
            seconds = bar.tasks[0].elapsed or 0.0
            made = now.rows - now.resumed_rows
            bar.update(
                task,
                total=now.total_objects,
                completed=now.done_objects,
                rate=f"{made / seconds:.0f} views/s" if seconds > 0.5 else "",
                trouble=f"{now.failed} failed" if now.failed else "",
            )

        yield update
