"""Five rooms, one of each type, made once for all tests."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def rooms(tmp_path_factory):
    """A ``RoomsFolder`` of five rooms; skipped where Open3D does not import."""
    pytest.importorskip("open3d", exc_type=ImportError)
    from renderers.rooms.generate import generate_rooms

    folder: Path = tmp_path_factory.mktemp("rooms") / "five"
    return generate_rooms(folder, 5, seed=0)
