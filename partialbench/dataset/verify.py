"""``partialbench verify``: prove that a data folder is what its manifest says.

Checked for every row: file digests, schema, row digests, finiteness, R ∈ SO(3), ranges, counts,
uniqueness; that the cloud lies inside the unit ball when brought back to the object frame; that it
projects into its image, and onto its own depth where that is stored (``depth_check``). For a sample
of rows, where the source is at hand: that the points, brought back, lie on the source's surface and
have its normals (``surface_check``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from partialbench.dataset import manifest as manifests
from partialbench.dataset import objects as tables
from partialbench.dataset.card import NAME as CARD
from partialbench.dataset.depth_check import image_problems
from partialbench.dataset.manifest import Manifest, ShardEntry
from partialbench.dataset.schema import DIGESTED, FIELDS
from partialbench.dataset.shards import (
    Columns,
    content_digest,
    file_sha256,
    open_shard,
    row_digests,
)
from partialbench.dataset.sources import Source
from partialbench.dataset.surface_check import SurfaceCheck
from partialbench.errors import InputError
from partialbench.geometry.rotations import is_rotation
from partialbench.geometry.symmetry import GROUPS

BALL_TOLERANCE = 1e-3
"""How far outside the unit ball a point may lie (object units)."""
UNIT_TOLERANCE = 1e-5
"""How far from 1 a normal's length may be, and how far beyond a right angle it may look away."""


@dataclass
class Report:
    """What ``verify`` found.

    Attributes:
        problems: one sentence each; empty means the folder is sound.
        rows: split → rows read.
        surface: largest and mean distance of sampled points to their source's surface, or None
            when no source was at hand.
        notes: what was not checked and why.
    """

    problems: list[str] = field(default_factory=list)
    rows: dict[str, int] = field(default_factory=dict)
    surface: dict[str, float] | None = None
    notes: list[str] = field(default_factory=list)

    @property
    def sound(self) -> bool:
        return not self.problems


def verify(
    folder: Path,
    source: Source | None = None,
    surface_rows: int = 64,
    on_progress: Callable[[int, int], None] | None = None,
    no_source: str = "no source given (use --source)",
) -> Report:
    """Check a data folder; never raises for damage inside it, only where there is no folder.

    Args:
        folder: made by ``partialbench render``.
        source: what it was made from, for the surface check.
        surface_rows: so many rows, evenly spread over each split, are checked against the source.
        on_progress: called with (shards done, shards in all).
        no_source: where there is none, why.
    """
    folder = Path(folder)
    manifest = manifests.load(folder)
    report = Report()
    if manifest.state != "complete":
        report.problems.append(
            f"the folder is unfinished (state {manifest.state!r}): run its render command again"
        )
    known = {entry.file for entry in manifest.shards}
    for path in sorted(folder.glob("*.h5")):
        if path.name not in known:
            report.problems.append(f"{path.name} is not in the manifest")
    report.problems += _papers_problems(folder, manifest)
    table = _table(folder, manifest, report)
    digests: dict[str, list[NDArray]] = {}
    seen: dict[str, set[tuple[bytes, int]]] = {}
    surface = SurfaceCheck()
    written = [entry for entry in manifest.shards if entry.rows]
    for n, entry in enumerate(written):
        columns = _read_and_check(folder, manifest, entry, table, report)
        if columns is not None:
            digests.setdefault(entry.split, []).append(columns["row_sha256"])
            report.rows[entry.split] = report.rows.get(entry.split, 0) + len(columns["label"])
            pairs = set(zip(columns["object_id"].tolist(), columns["view"].tolist(), strict=True))
            earlier = seen.setdefault(entry.split, set())
            if pairs & earlier or len(pairs) < len(columns["view"]):
                report.problems.append(f"{entry.file}: an (object, view) pair occurs twice")
            earlier |= pairs
            if source is not None:
                share = max(1, round(surface_rows * entry.rows / manifest.rows(entry.split)))
                surface.look(entry, columns, source, share)
        if on_progress:
            on_progress(n + 1, len(written))
    for split, recorded in manifest.digests.items():
        complete = report.rows.get(split) == manifest.rows(split)
        if complete and content_digest(digests.get(split, [])) != recorded:
            report.problems.append(f"split {split!r}: rows do not hash to the recorded digest")
    if source is None:
        report.notes.append(f"surface not checked: {no_source}")
    report.problems += surface.problems(manifest)
    report.notes += surface.notes(manifest)
    report.surface = surface.distances()
    return report


def _papers_problems(folder: Path, manifest: Manifest) -> list[str]:
    """What is wrong with what lies beside the shards, and with what the manifest should have."""
    problems = []
    if not manifest.shards:
        problems.append(f"{manifests.NAME} lists no shards")
    if manifest.state == "complete":
        for split in manifest.splits():
            if split not in manifest.digests:
                problems.append(f"{manifests.NAME} has no content digest of the split {split!r}")
        for split in manifest.digests.keys() - set(manifest.splits()):
            problems.append(f"{manifests.NAME} has a digest of {split!r}, a split without shards")
    path = folder / manifests.FAILURES
    if not path.is_file():
        problems.append(f"{manifests.FAILURES} is missing")
    elif path.read_bytes() != manifest.failures_text().encode():
        problems.append(f"{manifests.FAILURES} does not say what {manifests.NAME} recorded")
    if manifest.state == "complete" and not manifest.card_sha256 and manifest.format_version > 1:
        problems.append(f"{manifests.NAME} has no digest of {CARD}")
    if manifest.card_sha256:
        path = folder / CARD
        if not path.is_file():
            problems.append(f"{CARD} is missing")
        elif file_sha256(path) != manifest.card_sha256:
            problems.append(f"{CARD} is not as it was written: damaged or edited")
    return problems


def _table(folder: Path, manifest: Manifest, report: Report) -> dict[str, str]:
    """objects.jsonl by shard, in format 2; what is wrong with the whole of it is reported."""
    if manifest.format_version == 1:
        return {}
    if not (folder / tables.NAME).is_file():
        report.problems.append(f"{tables.NAME} is missing; run the render command again")
        return {}
    try:
        table = tables.load(folder)
    except InputError as error:
        report.problems.append(str(error))
        return {}
    for shard in table.keys() - {entry.file for entry in manifest.shards if entry.rows}:
        report.problems.append(f"{tables.NAME} lists objects of {shard!r}, the manifest has none")
    return table


def _table_problems(
    folder: Path, columns: Columns, entry: ShardEntry, table: dict[str, str]
) -> list[str]:
    """What is wrong with a shard's lines in objects.jsonl."""
    text = table.get(entry.file, "")
    if tables.text_digest(text) != entry.objects_sha256:
        return [
            f"its objects in {tables.NAME} are not those the manifest recorded: missing, damaged "
            f"or edited"
        ]
    try:
        lines = tables.parse(text, folder / tables.NAME)
    except InputError as error:
        return [str(error)]
    problems = []
    if {line.object_id.encode() for line in lines} != set(columns["object_id"].tolist()):
        problems.append(f"its objects are not those that {tables.NAME} lists")
    if any(line.split != entry.split for line in lines):
        problems.append(f"{tables.NAME} lists objects of it in another split")
    return problems


def _read_and_check(
    folder: Path, manifest: Manifest, entry: ShardEntry, table: dict[str, str], report: Report
) -> Columns | None:
    """The shard's columns when its bytes and schema are as recorded, else None."""
    path = folder / entry.file

    def problem(text: str) -> None:
        report.problems.append(f"{entry.file}: {text}")

    if not path.is_file():
        problem("missing; run the render command again, only it is made anew")
        return None
    intact = file_sha256(path) == entry.sha256
    if not intact:
        problem(
            "its bytes do not hash to the SHA-256 in the manifest: damaged or edited; delete it "
            "and run the render command again, only it is made anew"
        )
    if path.stat().st_size != entry.bytes:
        problem(f"has {path.stat().st_size} bytes, the manifest says {entry.bytes}")
    try:
        with open_shard(path) as file:
            # Before anything is read: a field may be said to be larger than any memory.
            if schema := _schema_problems(file, manifest, entry):
                for text in schema:
                    problem(text)
                return None
            columns = {
                f.name: file[f.name][()] for f in FIELDS if f.name in file and f.name != "depth"
            }
            if "depth" in file:
                report.problems += [
                    f"{entry.file}: {p}" for p in image_problems(file["depth"], columns)
                ]
            if "configuration_digest" not in file.attrs:
                problem("does not say which configuration it was made with")
                return None
            recorded = file.attrs["configuration_digest"]
            place = str(file.attrs.get("split", "")), int(file.attrs.get("index", -1))
            listed = set(file["objects/object_id"][()]) if "objects" in file else None
            version = file.attrs["format_version"]
    except (
        InputError,
        OSError,
        KeyError,
        RuntimeError,
        TypeError,
        ValueError,
        MemoryError,
    ) as error:
        problem(f"not readable: {error}")
        return None
    if recorded != manifest.configuration_digest:
        problem("made with another configuration than the manifest's")
    if place != (entry.split, entry.index):
        problem(f"was made as {place}, the manifest has it as {(entry.split, entry.index)}")
    if version != manifest.format_version:
        problem(f"has format {version}, the manifest says {manifest.format_version}")
    elif manifest.format_version == 1:
        if listed != set(columns["object_id"].tolist()):
            problem("its objects are not those of its rows")
    else:
        for text in _table_problems(folder, columns, entry, table):
            problem(text)
    distinct = len(set(columns["object_id"].tolist()))
    if distinct > entry.objects:
        problem(f"has rows of {distinct} objects, the manifest says {entry.objects}")
    wrong = np.flatnonzero((row_digests(columns) != columns["row_sha256"]).any(axis=1))
    if len(wrong):
        problem(f"{len(wrong)} row(s) do not match their digest, the first is row {wrong[0]}")
    for text in _value_problems(columns, manifest):
        problem(text)
    return columns


def _schema_problems(file: h5py.File, manifest: Manifest, entry: ShardEntry) -> list[str]:
    known = {f.name for f in FIELDS} | ({"objects"} if manifest.format_version == 1 else set())
    problems = [f"holds {name!r}, which is no field of a row" for name in sorted(set(file) - known)]
    for f in FIELDS:
        if f.name not in file:
            if not f.optional:
                problems.append(f"lacks the field {f.name!r}")
            continue
        field = file.get(f.name)
        if not isinstance(field, h5py.Dataset):
            problems.append(f"{f.name!r} is no array of numbers")
            continue
        shape, dtype = field.shape, field.dtype
        sizes = {"P": manifest.configuration["points"]}
        expected = tuple(sizes.get(s, s) if isinstance(s, str) else s for s in f.shape)
        fits = len(shape) == 1 + len(expected) and all(
            isinstance(e, str) or e == s for e, s in zip(expected, shape[1:], strict=False)
        )
        if not fits or shape[0] != entry.rows:
            problems.append(f"{f.name!r} is {shape}, expected {(entry.rows, *expected)}")
        if dtype != f.dtype:
            problems.append(f"{f.name!r} has dtype {dtype}, expected {f.dtype}")
    return problems


def _is_text(name: bytes) -> bool:
    try:
        name.decode()
    except UnicodeDecodeError:
        return False
    return True


def _value_problems(columns: Columns, manifest: Manifest) -> list[str]:
    problems: list[str] = []

    def require(good: ArrayLike, what: str) -> None:
        bad = np.flatnonzero(~np.asarray(good))
        if len(bad):
            problems.append(f"{what} in {len(bad)} row(s), the first is row {bad[0]}")

    rows = len(columns["label"])
    finite = np.ones(rows, bool)
    for name in DIGESTED:
        if columns[name].dtype.kind == "f":
            finite &= np.isfinite(columns[name]).reshape(rows, -1).all(axis=1)
    require(finite, "values are not finite")
    R, t = columns["R_camera_object"], columns["t_camera_object"]
    require(is_rotation(R), "R_camera_object is not a rotation")
    labels = columns["label"]
    require((labels >= 0) & (labels < len(manifest.class_names)), "label is out of range")
    fraction = columns["visible_fraction"]
    require((fraction >= 0) & (fraction <= 1), "visible_fraction is outside [0, 1]")
    occluded = columns.get("occluded_fraction", np.zeros(rows))
    require((occluded >= 0) & (occluded <= 1), "occluded_fraction is outside [0, 1]")
    require([_is_text(name) for name in columns["object_id"].tolist()], "object_id is no UTF-8")
    known = {name.encode() for name in GROUPS}
    require(np.array([s in known for s in columns["symmetry"]]), "symmetry is no known group")
    minimum = manifest.configuration.get("min_visible", 1)
    require(columns["n_visible"] >= minimum, f"n_visible is below the folder's {minimum}")
    if problems:
        return problems
    points = columns["points"].astype(np.float64)
    if "normals" in columns:
        normals = columns["normals"].astype(np.float64)
        length = np.linalg.norm(normals, axis=2)
        unit = (np.abs(length - 1) <= UNIT_TOLERANCE).all(axis=1)  # False for NaN as well
        require(unit, "normals are no unit vectors")
        facing = (normals * points).sum(axis=2) / np.linalg.norm(points, axis=2)
        require((facing <= UNIT_TOLERANCE).all(axis=1), "normals look away from the camera")
    canonical = (points - t[:, None]) @ R
    radius = np.linalg.norm(canonical, axis=2).max(axis=1)
    # A noisy sensor's flying pixels may lie anywhere along their ray.
    limit = np.inf if manifest.sensor else 1 + BALL_TOLERANCE
    require(radius <= limit, "points lie outside the unit ball in the object frame")
    K = columns["K"]
    imaged = K[:, 0, 0] > 0
    if imaged.any():
        require(~imaged | (points[..., 2].min(axis=1) > 0), "points lie behind the camera")
        size = manifest.configuration["occluder"].get("resolution")
        if size and not problems:
            pixels = points[..., :2] / points[..., 2:] * K[:, None, [0, 1], [0, 1]]
            pixels = (pixels + K[:, None, [0, 1], 2])[imaged]
            margin = 0.01 * size
            inside = ((pixels > -margin) & (pixels < size + margin)).all(axis=(1, 2))
            require(inside, "points project outside the image")
    return problems
