"""Damaged clouds: what comes back is what the file says, or an error in words; never a part."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest

from partialbench.dataset.cloud_files import read_oriented
from partialbench.errors import InputError
from tests.dataset.cloud_writers import COUNTED, TEXTS

WRITERS = {**TEXTS, **COUNTED}


def cloud(rng: np.random.Generator) -> np.ndarray:
    return rng.normal(size=(int(rng.integers(17, 60)), 3)) * 10.0 ** rng.integers(-3, 4)


def outcome(content: bytes, name: str) -> np.ndarray | None:
    """The points, or None for an error of ours; all else fails the test."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            points, normals = read_oriented(content, name)
        except InputError as error:
            told = str(error)
            points, normals = None, None
    if points is None:
        assert told.startswith(f"{name}: ")
        return None
    assert points.dtype == np.float64
    assert points.ndim == 2
    assert points.shape[1] == 3
    assert len(points)
    assert np.isfinite(points).all()
    assert normals is None or normals.shape == points.shape
    return points


def damage(content: bytes, rng: np.random.Generator) -> bytes:
    data = bytearray(content)
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(0, max(1, len(data))))
        size = int(rng.integers(1, 12))
        match int(rng.integers(0, 6)):
            case 0:
                data[at : at + 1] = bytes([int(rng.integers(0, 256))])
            case 1:
                del data[at : at + size]
            case 2:
                data[at:at] = bytes(rng.integers(0, 256, size).astype(np.uint8))
            case 3:
                data[at:at] = rng.choice([b"\n", b" ", b",", b";", b"0", b"nan ", b"\t", b"1e999"])
            case 4:
                data[at:at] = data[at : at + size]
            case _:
                head = data.find(b"\n", min(at, 200))
                data[head + 1 : head + 1] = data[max(0, head - 30) : head + 1]
    return bytes(data)


def rows_said(content: bytes, name: str) -> int | None:
    """How many points the file's own header says, read here in another way."""
    if name.endswith(".ply"):
        found = re.search(rb"element\s+vertex\s+(\d+)", content)
    elif name.endswith(".pcd"):
        found = re.search(rb"(?im)^points\s+(\d+)", content)
    else:
        return None
    return int(found[1]) if found else None


def try_damaged(rng: np.random.Generator, rounds: int) -> dict[str, int]:
    counts = {"read": 0, "refused": 0}
    for _ in range(rounds):
        for name, write in WRITERS.items():
            content = damage(write(cloud(rng)), rng)
            points = outcome(content, name)
            counts["refused" if points is None else "read"] += 1
            said = rows_said(content, name)
            if points is not None and said is not None and not name.endswith(".pcd"):
                assert len(points) == said, name
            if points is not None and said is not None:  # a PCD leaves out what was not measured
                assert len(points) <= said, name
            if points is not None and name in TEXTS:
                _hold_against_words(content, points, name)
    return counts


def _hold_against_words(content: bytes, points: np.ndarray, name: str) -> None:
    """Every coordinate read is a word of the text, and no line of three numbers is lost."""
    encodings = {"utf16.txt": "utf-16", "utf16be.txt": "utf-16-be"}
    text = content.decode(encodings.get(name, "latin-1"), "replace")
    words = set()
    for word in re.split(r"[\s,;#]+", text):
        try:
            words.add(float(word.lstrip("\ufeffï»¿")))
        except ValueError:
            continue
    assert set(points.ravel().tolist()) <= words, name
    number = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?"
    whole = re.compile(rf"{number}(?:[ \t]*[ \t,;][ \t]*{number}){{2,}}[ \t,;]*", re.I)
    lines = [
        line for line in re.split(r"[\r\n]", text) if whole.fullmatch(line.strip("\ufeffï»¿ \t"))
    ]
    assert len(points) == len(lines), name


def try_cut(rng: np.random.Generator, rounds: int) -> int:
    """Files with a count, cut or with something behind them: whole or refused."""
    tried = 0
    for _ in range(rounds):
        for name, write in COUNTED.items():
            points = cloud(rng)
            content = write(points)
            for changed in (
                content[: int(rng.integers(0, len(content)))],
                content + bytes(rng.integers(1, 256, int(rng.integers(1, 80))).astype(np.uint8)),
            ):
                got = outcome(changed, name)
                tried += 1
                # In text the very last number may be cut short: no reader can tell.
                known = len(points) - (name in ("ascii.ply", "mac.ply", "ascii.pcd"))
                if got is not None:
                    assert len(got) == len(points), name
                    np.testing.assert_array_equal(got[:known], points[:known], err_msg=name)
    return tried


def test_damaged_clouds_are_read_as_they_are_or_refused(rng: np.random.Generator) -> None:
    counts = try_damaged(rng, 4)
    assert min(counts.values()) > 10  # both happen, else nothing was tried


def test_a_part_of_a_file_is_never_a_cloud(rng: np.random.Generator) -> None:
    assert try_cut(rng, 4) == 4 * 2 * len(COUNTED)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_thousands_of_damaged_clouds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    try_damaged(rng, 100)
    try_cut(rng, 50)
