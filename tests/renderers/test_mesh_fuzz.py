"""Damaged mesh files: each is refused with an ``InputError`` or read as what it says.

What a damaged file says is judged without the readers:

- by a second reader that shares no code with them (``plain_readers``): the two surfaces must be
  one, in bounding box, vector area and, where all polygons are flat, area and centroid. Polygons
  are summed by Newell's formula, which needs no cutting into triangles;
- by what was done to it: a file that was cut off, or lost or won a line, must be refused or give
  the surface it had, in every format that has counts; blanks and comments change nothing.

OBJ has no counts: a lost face is a smaller object, and no reader can tell. Numbers may also turn
into other numbers in every format; the surface is then another, and must be the one that is
written. No outcome but these passes: not a traceback, not a part of an object.
"""

from __future__ import annotations

import re
import warnings
from pathlib import PurePosixPath

import numpy as np
import pytest

from partialbench.errors import InputError
from renderers.sources.mesh import read_mesh
from tests.renderers.mesh_dialects import DIALECTS
from tests.renderers.plain_readers import PLAIN, Polygon

FORMATS = sorted(PLAIN)
QUICK, MANY = 120, 6000


def moments(polygons: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, bool]:
    """Vector area (3,), area and first moments (4,), and whether all polygons are flat."""
    vector, scalar, flat = np.zeros(3), np.zeros(4), True
    for corners in polygons:
        spokes = corners - corners[0]
        crosses = np.cross(spokes[1:-1], spokes[2:]) / 2
        normal = crosses.sum(axis=0)
        area = np.linalg.norm(normal)
        vector += normal
        size = np.abs(spokes).max()
        if area > 1e-9 * size**2:
            signed = crosses @ normal / area
            centres = (corners[0] + corners[1:-1] + corners[2:]) / 3
            scalar += [area, *(signed @ centres)]
            flat &= bool(np.abs(spokes @ normal / area).max() < 1e-5 * size)
        elif len(corners) > 3:
            flat = False
    return vector, scalar, flat


def require_same(found: np.ndarray, polygons: list[Polygon], what: str) -> None:
    """Triangles (F,3,3) and polygons are one surface."""
    plain = [np.array(polygon, float) for polygon in polygons]
    points = np.concatenate(plain)
    assert np.isfinite(points).all(), what
    scale = float(np.abs(points).max()) or 1.0
    box = np.array([points.min(axis=0), points.max(axis=0)])
    corners = found.reshape(-1, 3)
    got = np.array([corners.min(axis=0), corners.max(axis=0)])
    # Ear clipping leaves out a corner that is the tip of a spike without area.
    if any(len(polygon) > 3 for polygon in plain):
        assert (got[0] >= box[0] - 1e-7 * scale).all(), what
        assert (got[1] <= box[1] + 1e-7 * scale).all(), what
    else:
        np.testing.assert_allclose(got, box, atol=1e-7 * scale, err_msg=what)
    if scale > 1e90:
        return
    vector, scalar, flat = moments([corner / scale for corner in plain])
    vector_found, scalar_found, _ = moments(list(found / scale))
    np.testing.assert_allclose(vector_found, vector, atol=1e-6, err_msg=what)
    if flat:
        np.testing.assert_allclose(scalar_found, scalar, atol=1e-5, err_msg=what)


def mutate(content: bytes, rng: np.random.Generator, others: list[bytes]) -> tuple[bytes, str]:
    """A damaged copy and what was done to it."""
    n = len(content)
    at = int(rng.integers(n))
    size = int(rng.integers(1, 1 + min(40, n - at)))
    lines = re.split(rb"(?<=[\n\r])", content)
    line = int(rng.integers(len(lines)))
    kind = str(rng.choice(
        ["flip", "bit", "cut", "drop", "repeat", "insert", "lose line", "win line", "swap lines",
         "number", "digit", "splice"]
    ))  # fmt: skip
    if kind == "flip":
        return content[:at] + bytes([rng.integers(256)]) + content[at + 1 :], kind
    if kind == "bit":
        return content[:at] + bytes([content[at] ^ 1 << rng.integers(8)]) + content[at + 1 :], kind
    if kind == "cut":
        return content[:at], kind
    if kind == "drop":
        return content[:at] + content[at + size :], kind
    if kind == "repeat":
        return content[: at + size] + content[at:], kind
    if kind == "insert":
        junk = [
            b" ",
            b"\n",
            b"0",
            b"-",
            b"1 ",
            b".",
            b"\0",
            b"#",
            b"e9",
            b"nan ",
            b"\\",
            b"/",
            b"_",
        ]
        return content[:at] + junk[rng.integers(len(junk))] + content[at:], kind
    if kind == "lose line":
        return b"".join(lines[:line] + lines[line + 1 :]), kind
    if kind == "win line":
        return b"".join(lines[:line] + lines[line : line + 1] + lines[line:]), kind
    if kind == "swap lines":
        other = int(rng.integers(len(lines)))
        lines[line], lines[other] = lines[other], lines[line]
        return b"".join(lines), kind
    if kind == "splice":
        other = others[rng.integers(len(others))]
        return content[:at] + other[int(rng.integers(len(other))) :], kind
    numbers = list(re.finditer(rb"-?\d+(\.\d+)?", content))
    found = numbers[rng.integers(len(numbers))] if numbers else None
    if found is None:
        return content[:at], "cut"
    new = str(rng.integers(-2, 20)).encode()
    if kind == "digit":
        k = int(rng.integers(found.start(), found.end()))
        return content[:k] + str(rng.integers(10)).encode() + content[k + 1 :], kind
    return content[: found.start()] + new + content[found.end() :], kind


def triangles_of(content: bytes, suffix: str) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # none reaches a user
        mesh = read_mesh(content, suffix, name="damaged")
    return np.asarray(mesh.vertices)[np.asarray(mesh.faces)]


def fuzz(suffix: str, rounds: int, seed: int) -> dict[str, int]:
    """How many mutations were refused, read as they were, and read as another surface."""
    rng = np.random.default_rng([seed, FORMATS.index(suffix)])
    seeds = [c for name, c in DIALECTS.items() if PurePosixPath(name).suffix == suffix]
    whole = [triangles_of(content, suffix) for content in seeds]
    outcome = {"refused": 0, "same": 0, "another": 0}
    for _ in range(rounds):
        k = int(rng.integers(len(seeds)))
        damaged, kind = mutate(seeds[k], rng, seeds)
        while rng.random() < 0.2:
            damaged, further = mutate(damaged or b" ", rng, seeds)
            kind += " and " + further
        what = f"{kind} of {suffix}: {damaged!r}"
        try:
            found = triangles_of(damaged, suffix)
        except InputError:
            outcome["refused"] += 1
            continue
        try:
            polygons = PLAIN[suffix](damaged)
        except Exception as error:
            raise AssertionError(
                f"read, but not by the plain reader ({error!r}): {what}"
            ) from error
        require_same(found, polygons, what)
        same = found.shape == whole[k].shape and np.allclose(found, whole[k], atol=1e-6)
        outcome["same" if same else "another"] += 1
        counted = suffix != ".obj" and kind in ("cut", "lose line", "win line")
        # Of the last number a digit may be lost: a file need not end with a line end.
        counted &= kind != "cut" or len(seeds[k][len(damaged) - 1 :].split()) > 1
        assert same or not counted, what
    return outcome


def test_the_plain_readers_read_every_dialect() -> None:
    for name, content in DIALECTS.items():
        suffix = PurePosixPath(name).suffix
        require_same(triangles_of(content, suffix), PLAIN[suffix](content), name)


@pytest.mark.parametrize("suffix", FORMATS)
def test_damaged_files_are_refused_or_read_as_they_are(suffix: str) -> None:
    outcome = fuzz(suffix, QUICK, seed=0)
    # It is no test where nothing, or everything, is refused.
    assert outcome["refused"] > QUICK // 4
    assert outcome["same"] + outcome["another"] > 0


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("suffix", FORMATS)
def test_thousands_of_damaged_files(suffix: str) -> None:
    print(suffix, fuzz(suffix, MANY, seed=1))
