"""Progress on stderr: a bar in a terminal, a line now and then where there is none."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

if TYPE_CHECKING:
    from partialbench.dataset.build import Progress as BuildProgress

LINE_EVERY = 60.0
"""Seconds between the lines of a bar without a terminal."""


class Bar(Progress):
    """A bar of one task. Without a terminal, as in a batch job's log, lines with the same columns.

    A line is written where something is done and the last one is ``LINE_EVERY`` seconds old, and
    when all is done.
    """

    def __init__(self, *columns: ProgressColumn, console: Console, silent: bool = False) -> None:
        draws = console.is_terminal or console.is_jupyter
        super().__init__(*columns, console=console, disable=silent or not draws)
        self._words = [column for column in columns if not isinstance(column, BarColumn)]
        self._writes_lines = not silent and not draws
        self._last_line = time.monotonic()

    def update(self, task_id: TaskID, **changes: Any) -> None:
        task = self.tasks[task_id]
        was_finished = task.finished
        super().update(task_id, **changes)
        due = time.monotonic() - self._last_line >= LINE_EVERY
        if self._writes_lines and not was_finished and (due or task.finished):
            self._last_line = time.monotonic()
            words = filter(None, (str(column(task)) for column in self._words))
            self.console.print(*words, markup=False, highlight=False, soft_wrap=True)

    def stop(self) -> None:
        if not self.disable:  # Rich would end with an empty line
            super().stop()


def counting_bar(console: Console, what: str) -> Callable[[int, int], None]:
    """A bar that shows itself when first told (done, total) and leaves when all is done."""
    bar = Bar(
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
    """A bar over objects with views per second and time left; yields what ``build`` calls.

    It shows itself with the first object: before, a source that simulates has a bar of its own.
    """
    columns = (
        TextColumn("render"), BarColumn(), MofNCompleteColumn(), TextColumn("objects"),
        TextColumn("{task.fields[rate]}"), TimeElapsedColumn(), TextColumn("left"),
        TimeRemainingColumn(), TextColumn("{task.fields[trouble]}"),
    )  # fmt: skip
    bar = Bar(*columns, console=console)
    task = bar.add_task("render", total=None, start=False, rate="", trouble="")
    try:

        def update(now: BuildProgress) -> None:
            if not bar.tasks[0].started:
                bar.start_task(task)
                bar.start()
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
    finally:
        bar.stop()


def training_bar(console: Console, silent: bool) -> Bar:
    """A bar over steps; its task has a field "loss", in words."""
    return Bar(
        TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(),
        TextColumn("steps"), TextColumn("{task.fields[loss]}"), TextColumn("left"),
        TimeRemainingColumn(), console=console, silent=silent,
    )  # fmt: skip
