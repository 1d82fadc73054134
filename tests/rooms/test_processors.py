"""A room is the same bytes on every processor."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

_ROOM = """
import hashlib, sys, tempfile
from pathlib import Path
from renderers.rooms import generate
for sensor in sys.argv[1:]:
    with tempfile.TemporaryDirectory() as folder:
        generate._make_room((Path(folder), 1, 0, sensor))
        whole = hashlib.sha256()
        for path in sorted((Path(folder) / generate.room_id(1)).iterdir()):
            whole.update(path.name.encode() + path.read_bytes())
    print(whole.hexdigest())
"""

IDEAL = "3be9b8808da7915a0eaef01842a783b73c57d4c2f962075232ba1b451bdb1ee3"
"""Room 1 of seed 0 through the ideal sensor, generation 4: from an AMD EPYC, and the same from an
emulated Intel Sandy Bridge, which has neither FMA nor AVX2 and other reciprocals."""

OLD_PROCESSOR = {
    "NPY_DISABLE_CPU_FEATURES": "AVX2 FMA3",
    "OPENBLAS_CORETYPE": "Prescott",
    "MKL_CBWR": "COMPATIBLE",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-AVX512F,-AVX2_Usable,-FMA_Usable",
}


def digests(*sensors: str, **environment: str) -> list[str]:
    return subprocess.run(
        [sys.executable, "-c", _ROOM, *sensors], capture_output=True, check=True, text=True,
        env={**os.environ, **environment},
    ).stdout.split()  # fmt: skip


def test_a_room_has_the_recorded_digest():
    pytest.importorskip("open3d", exc_type=ImportError)
    assert digests("ideal") == [IDEAL]


@pytest.mark.slow
def test_a_room_does_not_follow_the_libraries_kernels():
    pytest.importorskip("open3d", exc_type=ImportError)
    assert digests("ideal", "kinect-v1", **OLD_PROCESSOR) == digests("ideal", "kinect-v1")
