"""A grid rendered: a data folder for each cell, of one source that is listed once."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from os import PathLike
from pathlib import Path
from typing import Any

from partialbench import given, registry
from partialbench.dataset import grid as grids
from partialbench.dataset.build import BuildPlan, Progress
from partialbench.dataset.grid import Cell
from partialbench.dataset.manifest import Manifest
from partialbench.dataset.render import Asked, open_source, plan_of, run_plan
from partialbench.dataset.settings import SETTINGS, require_camera_frame
from partialbench.errors import InputError

AXES = ("setting", "sensor")
"""Options of ``plan_render`` that are axes of a grid; of the occluder's, ``occluders``."""


def plan_grid(
    data_set: str,
    out: Path,
    cells: Sequence[Cell],
    *,
    source: str | None = None,
    source_options: dict[str, Any] | None = None,
    occluder_options: dict[str, Any] | None = None,
    workers: int = 1,
    on_room: Callable[[int, int], None] | None = None,
    on_scene: Callable[[int, int], None] | None = None,
    **options: Any,
) -> dict[str, BuildPlan]:
    """The plan of each cell: all that can be wrong of any is said before one is rendered.

    Args:
        cells: of a grid, see ``grid.load``.
        options: as ``plan_render`` takes them, but for ``AXES``; ``splits`` is by default the test
            split. To complete clouds none of ``occluder_options`` applies.

    Returns:
        name of a cell → its plan, in the order of the cells.

    Raises:
        InputError: see ``plan_render``; or what the source cannot take in some cell.
    """
    known = inspect.signature(Asked).parameters
    seen = given.mapping(occluder_options, "occluder_options")
    for name in (*options, *seen):
        if name in (*AXES, "occluders"):
            raise InputError(f"{name} is an axis of a grid: give it there")
        if name in options and name not in known:
            raise InputError(
                f"a grid has no option {name!r}{registry.close_matches(name, sorted(known))}"
            )
    if data_set == "ps15":
        grids.require_no_sensors(cells)
    asked = [_asked(cell, seen, cells, options) for cell in cells]
    opened = open_source(data_set, source, source_options, asked[0], workers, on_room, on_scene)
    plans = {}
    for cell, one in zip(cells, asked, strict=True):
        try:
            plans[cell.name] = plan_of(opened, one, Path(out) / cell.name)
        except InputError as error:
            raise InputError(f"cell {cell.name} of the grid: {error}") from error
    return plans


def _asked(
    cell: Cell, seen: Mapping[str, Any], cells: Sequence[Cell], options: Mapping[str, Any]
) -> Asked:
    require_camera_frame(cell.setting, seen.get("keep_depth", False), options.get("normals", False))
    whole = SETTINGS[cell.setting].whole
    if whole and any(not SETTINGS[other.setting].whole for other in cells):
        seen = {}  # they are for the cells of one view
    return Asked(
        **{"splits": ("test",), **options},
        setting=cell.setting,
        sensor=None if cell.sensor == Cell.sensor else cell.sensor,
        occluder_options={**seen, **({"occluders": cell.occluders} if cell.occluders else {})},
    )


def render_grid(
    source: str | PathLike[str] | None,
    out: Path | str,
    grid: str | PathLike[str] | Mapping[str, Any],
    *,
    data_set: str = "pm40",
    workers: int = 1,
    scheduler: str | None = None,
    make_executor: Callable[[], Executor] | None = None,
    on_listing: Callable[[str], None] | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    retry_failed: bool = False,
    **options: Any,
) -> dict[str, Manifest]:
    """Make the data folders of a grid, or continue them: ``partialbench render --grid``.

    Args:
        source: as ``render_dataset`` takes it, and ``data_set``, ``workers``, ``scheduler``,
            ``make_executor``, ``on_listing``, ``on_progress`` and ``retry_failed`` too.
        out: the folder of the grid; each cell is a data folder in it.
        grid: a TOML file, or its content: {"rotation": ["z", "so3"], "occluders": [0, 0.5]}.
        options: see ``plan_grid``.

    Returns:
        name of a cell → the manifest of its folder.

    Raises:
        InputError: see ``plan_grid``; nothing is made then.
        PartialbenchError: a folder holds other data, is in use, or cannot be written.

    ::

        made = partialbench.render_grid(None, "data/grid", {"sensor": ["ideal", "tof"]}, points=512)
        [manifest.rows("test") for manifest in made.values()]
    """
    cells = (
        grids.cells_of(grid, "the grid")
        if isinstance(grid, Mapping)
        else grids.load(given.path(grid, "the grid"))
    )
    out = given.path(out, "the folder")
    place = None if source is None else str(given.path(source, "the source"))
    workers = given.whole_number(workers, "workers", 1)
    plans = plan_grid(data_set, out, cells, source=place, workers=workers, **options)
    grids.write(out, cells)
    made: dict[str, Manifest] = {}
    for name, plan in plans.items():
        made[name] = run_plan(
            plan, workers=workers, scheduler=scheduler, make_executor=make_executor,
            on_listing=None if made else on_listing, on_progress=on_progress,
            retry_failed=retry_failed,
        )  # fmt: skip
    return made
