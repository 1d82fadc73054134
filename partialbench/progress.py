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


def counting_bar(console: Console, what: str) -> Callable[[int, int], None]:
    """A bar that shows itself when first told (done, total) and leaves when all is done."""
    bar = Progress(
        TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        TextColumn("left"), TimeRemainingColumn(), console=console,
    )  # fmt: skip
    task = bar.add_task(what, total=None)

    def update(done: int, total: int) -> None:
        bar.start()
        bar.update(task, completed=done, total=total)
        if done >= total:
            bar.stop()

    return update


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
