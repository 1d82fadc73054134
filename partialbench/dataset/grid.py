"""One grid over the same objects: rotation × what is seen × sensor × occluders.

    rotation = ["none", "z", "so3"]
    shown = ["complete", "one view"]
    sensor = ["ideal", "kinect-v1", "tof", "stereo-d415"]
    occluders = [0, 0.25, 0.5]

An axis that a file leaves out is as in ``Cell()``. Complete clouds are of no camera: they are made
once for each rotation, with neither sensor nor occluders. Every cell shows the same objects from
the same places, so that cells pair cloud by cloud.
"""

from __future__ import annotations

import itertools
import json
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from partialbench import registry
from partialbench.dataset import manifest as manifests
from partialbench.dataset.manifest import Manifest, differences
from partialbench.dataset.others import require_share
from partialbench.dataset.settings import SETTINGS
from partialbench.dataset.shards import make_folder, write_atomically
from partialbench.errors import InputError
from partialbench.registry import close_matches

NAME = "grid.json"
FORMAT = "partialbench-grid"
COMPLETE, ONE_VIEW = "complete", "one view"
ROTATIONS = ("none", "z", "so3")
SHOWN = (COMPLETE, ONE_VIEW)


@dataclass(frozen=True)
class Cell:
    """One combination of the axes' values."""

    rotation: str = "so3"
    shown: str = ONE_VIEW
    sensor: str = "ideal"
    occluders: float = 0.0

    @property
    def name(self) -> str:
        """As records and folders have it: "so3_one-view_kinect-v1_0.25"."""
        return "_".join(
            [self.rotation, self.shown.replace(" ", "-"), self.sensor.replace(":", "-x"),
             f"{self.occluders:g}"]
        )  # fmt: skip

    @property
    def setting(self) -> str:
        """The setting of its data."""
        wanted = self.shown == COMPLETE, self.rotation
        return next(n for n, s in SETTINGS.items() if (s.whole, s.turns) == wanted)


AXES: dict[str, tuple[Any, ...]] = {
    "rotation": ROTATIONS, "shown": SHOWN, "sensor": (), "occluders": (),
}  # fmt: skip
"""Axis → the values it may have; () for those that the renderer knows."""


def load(path: Path) -> list[Cell]:
    """The cells of a grid file, in the order of its axes.

    Raises:
        InputError: no such file, not TOML, an unknown axis or value, or no value.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not a readable grid file: {error}") from error
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path} is not TOML: {error}") from error
    return cells_of(content, str(path))


def cells_of(content: Mapping[str, Any], where: str) -> list[Cell]:
    """See ``load``; ``where`` is named in errors."""
    for axis in content:
        if axis not in AXES:
            raise InputError(f"{where}: a grid has no axis {axis!r}{close_matches(axis, AXES)}")
    values = {axis: _values(content, axis, where) for axis in AXES}
    found: dict[Cell, None] = {}
    for rotation, shown, sensor, occluders in itertools.product(*values.values()):
        if shown == COMPLETE:
            sensor, occluders = "ideal", 0.0
        found[Cell(rotation, shown, sensor, float(occluders))] = None
    return list(found)


def _values(content: Mapping[str, Any], axis: str, where: str) -> list[Any]:
    values = content.get(axis, [getattr(Cell(), axis)])
    values = values if isinstance(values, list) else [values]
    kind = (int, float) if axis == "occluders" else str
    for value in values:
        if isinstance(value, bool) or not isinstance(value, kind):
            raise InputError(f"{where}: {axis} holds {value!r}; expected e.g. {AXES[axis] or 0.25}")
        if AXES[axis] and value not in AXES[axis]:
            raise InputError(
                f"{where}: {axis} has no value {value!r}; expected {', '.join(AXES[axis])}"
            )
        try:  # all of them before the first cell is rendered
            if axis == "sensor":
                registry.load(registry.MAKE_SENSOR)(value)
            elif axis == "occluders":
                require_share(float(value))
                if parse(Cell(occluders=float(value)).name).occluders != value:
                    raise InputError(
                        f"a share of occluders is named by six digits at most, got {value!r}"
                    )
        except InputError as error:
            raise InputError(f"{where}: {error}") from error
    if not values:
        raise InputError(f"{where}: {axis} has no value; leave it out or give one")
    return values


def require_no_sensors(cells: Iterable[Cell]) -> None:
    """Raises ``InputError`` for a sensor before scanned objects: a scan has the noise of its own
    scanner in every view, and of another scan the objects are others."""
    for cell in cells:
        if cell.sensor != Cell.sensor:
            raise InputError(
                f"the grid has the sensor {cell.sensor!r}, but a sensor is of rendered meshes: "
                f"scans and simulated rooms have the noise of their own scanner in every cell; "
                f"leave the axis out"
            )


def write(folder: Path, cells: list[Cell]) -> None:
    """Lists the cells of a folder, each a data folder in it by its name.

    A grid may grow: what cells were rendered must be among the new ones.

    Raises:
        InputError: the folder has cells of another grid.
    """
    make_folder(folder)
    content = {"format": FORMAT, "cells": [asdict(cell) for cell in cells]}
    before = read(folder) if (folder / NAME).is_file() else []
    for cell in before:
        if cell not in cells and (folder / cell.name).exists():
            raise InputError(
                f"{folder} holds another grid: it has the cell {cell.name}, which the file does "
                f"not ask for; choose another folder"
            )
    write_atomically(folder / NAME, (json.dumps(content, indent=1) + "\n").encode())


def read(folder: Path) -> list[Cell]:
    """The cells of a folder that ``render --grid`` made.

    Raises:
        InputError: no such folder, or not one of a grid.
    """
    path = folder / NAME
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] != FORMAT:
            raise ValueError(f"format {content['format']!r}")
        cells = [Cell(**cell) for cell in content["cells"]]
        for cell in cells:
            if parse(cell.name) != cell:
                raise ValueError(f"{cell} is no cell")
            float(cell.sensor.partition(":")[2] or 1)
        return cells
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{folder} is no grid of 'partialbench render --grid': {path.name}: {error}"
        ) from error


def folders(path: Path) -> list[Path]:
    """The data folders of a grid's cells, or that of one cell.

    Args:
        path: a folder that ``render --grid`` made, or one of a cell in it.

    Raises:
        InputError: neither.
    """
    inside = not (path / NAME).is_file() and (path.parent / NAME).is_file()
    if inside and path.name in [cell.name for cell in read(path.parent)]:
        return [path]
    return [path / cell.name for cell in read(path)]


def require_cells(grid: Path, names: Iterable[str]) -> None:
    """Holds cells against their names, and the whole grid's folders against each other.

    A table of a grid pairs clouds by the names of their objects, which other objects may have too.

    Args:
        grid: the folder that ``render --grid`` made.
        names: of the cells that are to be tested on.

    Raises:
        InputError: a cell is no data folder; it shows something else than its name says; or cells
            of the grid have not the same objects, seen from the same places in the same way.
    """
    wanted = list(names)
    first: dict[str, tuple[str, dict[str, Any]]] = {}
    for cell in read(grid):
        folder = grid / cell.name
        if cell.name not in wanted and not (folder / manifests.NAME).is_file():
            continue
        manifest = manifests.load(folder)
        _require_named(manifest, cell, folder)
        for part, made in (("objects", _objects(manifest)), (cell.shown, _seen(manifest))):
            before, other = first.setdefault(part, (cell.name, made))
            for key, there, here in differences(other, made):
                raise InputError(
                    f"the cells of {grid} do not pair cloud by cloud: {key} of {before} is "
                    f"{there!r}, of {cell.name} {here!r}; render the grid into a new folder"
                )


def _require_named(manifest: Manifest, cell: Cell, folder: Path) -> None:
    name, _, strength = cell.sensor.partition(":")
    sensor = "" if name == "ideal" else f"{name}:{float(strength or 1):g}"  # as a manifest has it
    for what, held, named in (
        ("setting", manifest.configuration["setting"], cell.setting),
        ("sensor", manifest.sensor, sensor),
        ("occluders", manifest.occluders, cell.occluders),
    ):
        if held != named:
            raise InputError(
                f"{folder} is not the cell that its name says: {what} is {held!r}, expected "
                f"{named!r}; render the grid into a new folder"
            )


def _objects(manifest: Manifest) -> dict[str, Any]:
    """Which objects a data folder shows, and from where."""
    made = manifest.configuration
    return {
        "dataset_id": manifest.dataset_id, "class_names": manifest.class_names,
        **{key: made.get(key) for key in ("source", "views", "seed", "objects_per_class")},
    }  # fmt: skip


def _seen(manifest: Manifest) -> dict[str, Any]:
    """How a data folder's objects are seen, but for the axes, for what is kept beside the points
    and for what traced the same rays."""
    others = ("sensor", "occluders", "pool", "keep_depth", "normals", "variant")
    made = manifest.configuration["occluder"]
    return {f"occluder.{key}": made[key] for key in made.keys() - set(others)}


def parse(name: str) -> Cell:
    """The cell that ``Cell.name`` named.

    Raises:
        InputError: no such name.
    """
    parts = name.split("_")
    try:
        rotation, shown, sensor, occluders = parts
        cell = Cell(rotation, shown.replace("-", " "), sensor.replace("-x", ":"), float(occluders))
    except ValueError as error:
        raise InputError(f"{name!r} is no cell of a grid") from error
    if cell.name != name or rotation not in ROTATIONS or cell.shown not in SHOWN:
        raise InputError(f"{name!r} is no cell of a grid")
    return cell
