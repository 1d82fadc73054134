"""PS15 without any download: simulated rooms, read by the ScanNet and Scan2CAD source."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from renderers.rooms.generate import GENERATION, generate_rooms
from renderers.sources.scannet.filters import Rules
from renderers.sources.scannet.source import ScanNetInstances

DEFAULT_ROOMS = 50


class SimulatedRooms(ScanNetInstances):
    """A `ScanNetInstances` over rooms that it makes first, where they are not there yet.

    Args:
        rooms: how many; fewer than six have no test room.
        seed: of the rooms.
        folder: where they are kept; default: ``partialbench`` in the user's cache folder.
        sensor: as ``generate_rooms`` takes it.
        workers: processes that make and list them.
        on_progress: called with (rooms made, rooms in all).
        viewpoints, rules, on_scene: as for `ScanNetInstances`.

    Raises:
        As ``generate_rooms``.
    """

    def __init__(
        self,
        rooms: int = DEFAULT_ROOMS,
        seed: int = 0,
        folder: Path | None = None,
        sensor: str = "kinect-v1",
        workers: int = 1,
        viewpoints: str = "uniform",
        rules: Rules | Mapping[str, float] | None = None,
        on_progress: Callable[[int, int], None] | None = None,
        on_scene: Callable[[int, int], None] | None = None,
    ) -> None:
        if folder is None:
            name = f"rooms-{GENERATION}-{sensor.replace(':', '-')}-seed{seed}-{rooms}"
            folder = cache_folder() / name
        made = generate_rooms(folder, rooms, seed, workers, sensor, on_progress)
        super().__init__(
            made.scannet,
            made.scan2cad,
            viewpoints,
            made.split_file,
            rules=Rules.of(rules),
            workers=workers,
            on_scene=on_scene,
            name="rooms",
        )
        self.made = {"rooms": rooms, "seed": seed, "sensor": sensor, "generation": GENERATION}

    def describe(self) -> dict[str, Any]:
        """The rooms' own settings and those of the reader."""
        described = super().describe()
        # What is listed follows from the settings.
        del described["listing_sha256"]
        return {**described, "split": "second of five cycles", **self.made}


def cache_folder() -> Path:
    """``$XDG_CACHE_HOME/partialbench`` or ``~/.cache/partialbench``."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "partialbench"
