"""Small scans with known truth."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.scannet.scenes import BIN, CHAIR, TABLE, Thing, write_annotations, write_scene


@pytest.fixture
def things() -> list[Thing]:
    """Two chairs, a table and a bin, apart from each other."""
    return [
        Thing("chair", CHAIR, (0.5, 0.55, 0.9), (-1.5, -1.2), yaw=0.7),
        Thing("chair", CHAIR, (0.5, 0.5, 0.8), (1.4, 1.1), yaw=-2.1),
        Thing("table", TABLE, (0.8, 1.4, 0.7), (0.2, -0.4), yaw=0.2, sym="__SYM_ROTATE_UP_2"),
        Thing("trash can", BIN, (0.3, 0.3, 0.4), (-2.0, 1.5)),
    ]


@pytest.fixture
def scannet(tmp_path: Path, things: list[Thing]) -> Path:
    """A ScanNet folder of one scene without segmentation, with full_annotations.json."""
    write_annotations(tmp_path, [write_scene(tmp_path, "scene0001_00", things)])
    return tmp_path
