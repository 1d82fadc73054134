"""Rooms by the dozen: folder in, ScanNet and Scan2CAD out, the same bytes for any workers."""

from __future__ import annotations

import fcntl
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from partialbench.dataset.executors import map_in_order
from partialbench.dataset.manifest import json_digest
from partialbench.dataset.seeding import generator
from partialbench.dataset.shards import write_atomically
from partialbench.errors import ConfigurationMismatchError, InputError, PartialbenchError
from renderers.rooms.layout import ROOM_TYPES, furnish
from renderers.rooms.scan import import_open3d, scan
from renderers.rooms.trajectory import walk
from renderers.rooms.write import write_label_map, write_scene
from renderers.sensors import Sensor, make_sensor
from renderers.shapes.family import GENERATION as SHAPES_GENERATION
from renderers.sources.scannet.frames import LABEL_MAP

GENERATION = 4
"""Number of the rooms' edition: raise it when any scan changes."""
ANNOTATIONS, TRUTH, SPLIT = "full_annotations.json", "truth.json", "split.json"
_STAMP, _OWN = "rooms.json", "room.json"
CYCLE = len(ROOM_TYPES)
TEST_CYCLE = 1
"""Of every five cycles through the room types, the one with this number is for testing: ten rooms
have both splits."""


@dataclass(frozen=True)
class RoomsFolder:
    """Where the generated files are, ready for ``ScanNetInstances``.

    Attributes:
        scannet, scan2cad, split_file: its arguments of these names.
        truth_file: the true classes and poses, which the loader does not read.
    """

    scannet: Path
    scan2cad: Path
    split_file: Path
    truth_file: Path


def generate_rooms(
    out: Path,
    num_rooms: int = 50,
    seed: int = 0,
    workers: int = 1,
    sensor: str = "kinect-v1",
    on_progress: Callable[[int, int], None] | None = None,
) -> RoomsFolder:
    """Simulate, scan and annotate rooms; continues a folder that was interrupted.

    Rooms go through the five types in turn, so five rooms have all 15 classes. Rooms are split by
    whole cycles of five: the second of every five cycles is for testing.

    Args:
        out: new, empty, or made by this function with the same seed and sensor.
        num_rooms: at least 1; more can be added later, the first ones stay as they are.
        seed: of everything.
        workers: processes.
        sensor: as ``renderers.sensors.make_sensor`` takes it.
        on_progress: called with (rooms done, rooms in all), also for those that were there.

    Raises:
        InputError: num_rooms or workers below 1, an unknown sensor, a folder with other things.
        ConfigurationMismatchError: the folder was made with another seed, sensor or edition.
        PartialbenchError: Open3D does not import, or the folder cannot be used or is full.
    """
    if num_rooms < 1 or workers < 1:
        raise InputError(f"num_rooms and workers must be at least 1, got {num_rooms}, {workers}")
    _metric_sensor(sensor)
    import_open3d()
    out = Path(out)
    configuration = {
        "seed": seed, "sensor": sensor, "generation": GENERATION, "shapes": SHAPES_GENERATION
    }  # fmt: skip
    try:
        _stamp(out, configuration)
        (out / "scans").mkdir(exist_ok=True)
        with open(out / ".lock", "w") as lock:
            # A second run into the same folder waits, and then finds the rooms made.
            fcntl.flock(lock, fcntl.LOCK_EX)
            jobs = [(out / "scans", index, seed, sensor) for index in range(num_rooms)]
            _make_missing(jobs, workers, on_progress or (lambda done, total: None))
            return _collect(out, num_rooms)
    except OSError as error:
        raise PartialbenchError(
            f"cannot keep simulated rooms in {out}: {error.strerror or error}. Rooms that were "
            f"finished stay; mend that folder, or set XDG_CACHE_HOME to one with 12 MB a room free"
        ) from error


def _make_missing(
    jobs: list[tuple[Path, int, int, str]], workers: int, on_progress: Callable[[int, int], None]
) -> None:
    missing = [job for job in jobs if not (job[0] / room_id(job[1])).is_dir()]
    done = len(jobs) - len(missing)
    on_progress(done, len(jobs))
    for _ in map_in_order(_make_room, missing, workers):
        done += 1
        on_progress(done, len(jobs))


def _collect(out: Path, num_rooms: int) -> RoomsFolder:
    """Write the files about all rooms."""
    scans = out / "scans"
    rooms = [json.loads((scans / room_id(i) / _OWN).read_bytes()) for i in range(num_rooms)]
    result = RoomsFolder(out, out / ANNOTATIONS, out / SPLIT, out / TRUTH)
    _write(result.scan2cad, [room["annotation"] for room in rooms])
    _write(result.truth_file, [piece for room in rooms for piece in room["truth"]])
    splits: dict[str, list[str]] = {"train": [], "test": []}
    for index in range(num_rooms):
        splits[split_of(index)].append(room_id(index))
    _write(result.split_file, splits)
    write_label_map(out / LABEL_MAP)
    return result


def room_id(index: int) -> str:
    """The scene id of a room: "room0007_00"."""
    return f"room{index:04d}_00"


def split_of(index: int) -> str:
    """ "test" for the second of every five cycles through the room types, else "train"."""
    return "test" if index // CYCLE % 5 == TEST_CYCLE else "train"


def _make_room(job: tuple[Path, int, int, str]) -> None:
    """One room's folder; it is there whole or not at all."""
    scans, index, seed, sensor_name = job
    scene_id = room_id(index)
    room = furnish(index, seed)
    frames = walk(room, generator(seed, "rooms", "walk", index))
    sensor = _metric_sensor(sensor_name)
    made = scan(room, frames, sensor, generator(seed, "rooms", "sensor", index))
    temporary = scans / f".{scene_id}" / scene_id
    shutil.rmtree(temporary.parent, ignore_errors=True)
    temporary.mkdir(parents=True)
    rng = generator(seed, "rooms", "frame", index)
    annotation, truth = write_scene(temporary, room, made, rng)
    _write(temporary / _OWN, {"annotation": annotation, "truth": truth})
    temporary.rename(scans / scene_id)
    temporary.parent.rmdir()


def _metric_sensor(name: str) -> Sensor:
    """A sensor whose unit is the metre; the ideal one has no unit."""
    return make_sensor(name) if name == "ideal" else make_sensor(name, metres_per_unit=1.0)


def _stamp(out: Path, configuration: dict[str, Any]) -> None:
    path = out / _STAMP
    if path.is_file():
        found = json.loads(path.read_bytes())
        if json_digest(found) != json_digest(configuration):
            raise ConfigurationMismatchError(
                f"{out} holds rooms made with {found}, asked for {configuration}; choose another "
                f"folder"
            )
        return
    if out.is_dir() and any(out.iterdir()):
        raise InputError(f"{out} is not empty and holds no simulated rooms; choose a new folder")
    out.mkdir(parents=True, exist_ok=True)
    _write(path, configuration)


def _write(path: Path, data: Any) -> None:
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    write_atomically(path, text.encode())
