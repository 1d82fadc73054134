"""Building a data folder: objects → rows (anywhere) → shards in order (here) → manifest.

The same command gives the same bytes for any number of workers and after any interruption: rows
are keyed, not sequenced; they are written in listing order; a finished shard is never touched.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from partialbench.dataset import croissant
from partialbench.dataset import manifest as manifests
from partialbench.dataset import objects as tables
from partialbench.dataset.card import NAME as CARD
from partialbench.dataset.card import write_card
from partialbench.dataset.executors import process_pool
from partialbench.dataset.in_order import run_in_order
from partialbench.dataset.lock import FILES as LOCK_FILES
from partialbench.dataset.lock import sole_user
from partialbench.dataset.manifest import Manifest, ShardEntry
from partialbench.dataset.names import printable
from partialbench.dataset.rows import Job, ObjectRows, pickled
from partialbench.dataset.settings import SETTINGS, require_camera_frame
from partialbench.dataset.shards import (
    TEMPORARY_SUFFIX,
    PackedImages,
    concatenate,
    content_digest,
    read_columns,
    shard_bytes,
    write_atomically,
)
from partialbench.dataset.sources import ObjectRef
from partialbench.errors import InputError, PartialbenchError


@dataclass(frozen=True)
class BuildPlan:
    """What to build.

    Attributes:
        job: source, occluder and everything that decides the rows.
        out: the data folder.
        splits: which splits of the source, in this order.
        objects_per_class: split → at most so many objects of a class, the first in listing order;
            None for all.
        rows_per_shard: a shard is closed at the object that reaches it.
    """

    job: Job
    out: Path
    splits: tuple[str, ...]
    objects_per_class: dict[str, int] | None = None
    rows_per_shard: int = 1000

    def __post_init__(self) -> None:
        if self.job.setting not in SETTINGS:
            raise InputError(f"setting {self.job.setting!r} is not one of {', '.join(SETTINGS)}")
        occluder = self.job.occluder
        require_camera_frame(
            self.job.setting,
            getattr(occluder, "keep_depth", False), getattr(occluder, "normals", False),
        )  # fmt: skip
        for name, value in (
            ("points", self.job.points),
            ("rows_per_shard", self.rows_per_shard),
            ("min_visible", self.job.min_visible),
            *((f"views of {s!r}", self.job.views.get(s, 0)) for s in self.splits),
        ):
            if value < 1:
                raise InputError(f"{name} must be at least 1, got {value}")

    def configuration(self) -> dict[str, Any]:
        """What decides the bytes of the folder, as JSON data."""
        poses: dict[str, str] = {}
        if SETTINGS[self.job.setting].whole and hasattr(self.job.source, "poses"):
            turns = SETTINGS[self.job.setting].turns
            poses = {"poses": "sampled" if turns == "so3" else "canonical"}
        return {
            "source": self.job.source.describe(),
            "source_frame": self.job.source.frame,
            "occluder": self.job.occluder.describe(),
            "setting": self.job.setting,
            "views": {s: self.job.views[s] for s in self.splits},
            "points": self.job.points,
            "min_visible": self.job.min_visible,
            "seed": self.job.seed,
            "objects_per_class": self.objects_per_class,
            "rows_per_shard": self.rows_per_shard,
            # In these settings a source's own poses are not asked for; folders of releases that
            # did ask are not continued.
            **poses,
            # Rows without a known pose have the identity; this says that it is none.
            **({"pose": "none"} if getattr(self.job.source, "pose", "") == "none" else {}),
        }

    def slices(self) -> Iterator[tuple[str, int, list[ObjectRef]]]:
        """(split, index, objects) of every shard, in order."""
        for split in self.splits:
            refs = self.job.source.objects(split)
            if self.objects_per_class is not None:
                refs = first_per_class(refs, self.objects_per_class[split])
            _require_unique(refs)
            size = max(1, self.rows_per_shard // self.job.views[split])
            for index, start in enumerate(range(0, len(refs), size)):
                yield split, index, refs[start : start + size]


@dataclass
class Progress:
    """How far a build is. Rows of shards finished by an earlier run count as ``resumed_rows``."""

    total_objects: int
    done_objects: int = 0
    rows: int = 0
    resumed_rows: int = 0
    failed: int = 0
    rejected: int = 0

    def count(self, rows: int, failures: list[dict[str, Any]], objects: int = 1) -> None:
        """Add what became of ``objects`` more objects."""
        self.done_objects += objects
        self.rows += rows
        self.failed += sum(f["kind"] == "failed" for f in failures)
        self.rejected += sum(f["kind"] == "rejected" for f in failures)


def build(
    plan: BuildPlan,
    make_executor: Callable[[], Executor] | None = None,
    workers: int = 1,
    on_progress: Callable[[Progress], None] | None = None,
    retry_failed: bool = False,
) -> Manifest:
    """Make the folder, or continue it where it stopped.

    Args:
        plan: what to build.
        make_executor: opens the executor to run on (default: a pool of ``workers`` processes). It
            is called again if a worker dies, so that one crashing object cannot end the run.
        workers: how many tasks the executor runs at once.
        on_progress: called after every object.
        retry_failed: make anew the shards in which an object failed, once its input is mended; what
            a rule turned away stays as it is.

    Returns:
        The manifest of the complete folder. What gave no row is in ``manifest.failures``.

    Raises:
        ConfigurationMismatchError: the folder holds other data; nothing is touched.
        InputError: the source lists no object, or no object at all gave a row.
        PartialbenchError: the folder is in use, or cannot be written.
        KeyboardInterrupt: after the workers were stopped; the folder can be continued.
    """
    slices = list(plan.slices())
    if not slices:
        raise InputError(f"the source lists no objects in {', '.join(plan.splits)}")
    wanted = Manifest(
        plan.job.dataset_id,
        plan.configuration(),
        list(plan.job.source.class_names),
        listing_failures=[
            {"kind": "failed" if r.failed else "rejected", "split": r.split, "details": r.details,
             "object_id": r.object_id, "location": printable(r.location), "reason": r.reason}
            for r in plan.job.source.rejected
        ],
        listing=getattr(plan.job.source, "listing", ""),
        versions=manifests.versions(),
    )  # fmt: skip
    with sole_user(plan.out):
        manifest = _begin_or_continue(plan.out, wanted, retry_failed)
        if manifest.state == "complete":
            return manifest
        _build_missing(plan, manifest, slices, make_executor, workers, on_progress)
        _finish(plan.out, manifest)
    return manifest


def first_per_class(refs: list[ObjectRef], count: int) -> list[ObjectRef]:
    """At most ``count`` objects of each label, the first in listing order."""
    if count < 1:
        raise InputError(f"objects per class must be at least 1, got {count}")
    taken: dict[int, int] = {}
    kept = []
    for ref in refs:
        taken[ref.label] = taken.get(ref.label, 0) + 1
        if taken[ref.label] <= count:
            kept.append(ref)
    return kept


def _require_unique(refs: list[ObjectRef]) -> None:
    seen: dict[str, str] = {}
    for ref in refs:
        if ref.object_id in seen:
            raise InputError(
                f"two objects of split {ref.split!r} are both called {ref.object_id!r}: "
                f"{seen[ref.object_id]} and {ref.location}; rename one"
            )
        seen[ref.object_id] = ref.location


def _begin_or_continue(out: Path, wanted: Manifest, retry_failed: bool) -> Manifest:
    if (out / manifests.NAME).exists():
        existing = manifests.load(out)
        manifests.require_same(existing, wanted, out)
        # A killed run may have left a temporary file; under its final name nothing is ever partial.
        for leftover in out.glob(f".*{TEMPORARY_SUFFIX}"):
            leftover.unlink()
        table = _readable_table(out)
        kept = [
            entry
            for entry in existing.shards
            if (not entry.rows or (_is_whole(out, entry) and _listed(entry, table)))
            and not (retry_failed and any(f["kind"] == "failed" for f in entry.failures))
        ]
        papers = all((out / name).is_file() for name in (CARD, croissant.NAME, manifests.FAILURES))
        # A shard was deleted, cut short or is wanted anew, or what lies beside them was deleted.
        if len(kept) < len(existing.shards) or (existing.state == "complete" and not papers):
            existing.shards, existing.state, existing.digests = kept, "building", {}
            existing.card_sha256 = ""
            existing.listing, existing.listing_failures = wanted.listing, wanted.listing_failures
            # Before a file is replaced: the manifest never vouches for bytes it has not seen.
            existing.save(out)
        return existing
    # A run that could not write its first manifest leaves a list of failures, and a lock.
    # (The table of objects is written later, beside the first shard.)
    own = (*LOCK_FILES, manifests.FAILURES)
    foreign = sorted(p.name for p in out.iterdir() if p.name not in own)
    if foreign and not all(name.endswith(TEMPORARY_SUFFIX) for name in foreign):
        raise PartialbenchError(
            f"{out} is not empty and not a data folder (it has {', '.join(foreign[:5])}); "
            f"choose an empty or new folder"
        )
    wanted.save(out)
    return wanted


def _is_whole(out: Path, entry: ShardEntry) -> bool:
    """Whether a shard's file is there in its whole length; more is for ``verify`` to tell."""
    path = out / entry.file
    return path.is_file() and path.stat().st_size == entry.bytes


def _readable_table(out: Path) -> dict[str, str]:
    try:
        return tables.load(out)
    except InputError:
        return {}  # damaged: what it listed is made anew, as where it is absent


def _listed(entry: ShardEntry, table: dict[str, str]) -> bool:
    """Whether a shard's objects are in the table as the manifest recorded them."""
    return tables.text_digest(table.get(entry.file, "")) == entry.objects_sha256


def _build_missing(
    plan: BuildPlan,
    manifest: Manifest,
    slices: list[tuple[str, int, list[ObjectRef]]],
    make_executor: Callable[[], Executor] | None,
    workers: int,
    on_progress: Callable[[Progress], None] | None,
) -> None:
    done = {(entry.split, entry.index) for entry in manifest.shards}
    progress = Progress(sum(len(refs) for _, _, refs in slices))
    for entry in manifest.shards:
        progress.count(entry.rows, entry.failures, entry.objects)
        progress.resumed_rows = progress.rows
    missing = [s for s in slices if (s[0], s[1]) not in done]
    refs = [ref for _, _, slice_refs in missing for ref in slice_refs]
    results = run_in_order(
        pickled(plan.job), refs, make_executor or (lambda: process_pool(workers)), workers
    )
    order = {(split, index): n for n, (split, index, _) in enumerate(slices)}
    table = _readable_table(plan.out)
    with contextlib.closing(results):
        for split, index, slice_refs in missing:
            made = []
            for _ in slice_refs:
                result = next(results)
                made.append(result)
                rows = 0 if result.columns is None else len(result.columns["label"])
                progress.count(rows, result.failures)
                if on_progress:
                    on_progress(progress)
            entry = _write_shard(plan, manifest, split, index, made, table)
            manifest.shards.append(entry)
            manifest.shards.sort(key=lambda e: order[e.split, e.index])
            # Before the manifest, which vouches for it.
            tables.save(plan.out, (table[e.file] for e in manifest.shards if e.rows))
            manifest.save(plan.out)


def _write_shard(
    plan: BuildPlan,
    manifest: Manifest,
    split: str,
    index: int,
    made: list[ObjectRows],
    table: dict[str, str],
) -> ShardEntry:
    """Write one shard, and its objects' lines into ``table``."""
    failures = [failure for result in made for failure in result.failures]
    kept = [result for result in made if result.columns is not None]
    name = f"{split}-{index:05d}.h5"
    if not kept:
        # A shard made anew may have had rows before.
        (plan.out / name).unlink(missing_ok=True)
        return ShardEntry("", split, index, 0, len(made), 0, "", failures)
    columns = concatenate([result.columns for result in kept if result.columns is not None])
    table[name] = tables.as_text(
        tables.ObjectLine(
            split, name, tables.stored_id(r.object_id).decode(), r.object_id, r.source_sha256,
            r.notices,
        )
        for r in kept
    )  # fmt: skip
    attributes: dict[str, str | int] = {
        "dataset_id": manifest.dataset_id,
        "configuration_digest": manifest.configuration_digest,
        "split": split,
        "index": index,
    }
    data = shard_bytes(columns, attributes, _take_images(kept))
    write_atomically(plan.out / name, data)
    rows = len(columns["label"])
    digest = manifests.bytes_sha256(data)
    return ShardEntry(
        name, split, index, rows, len(made), len(data), digest, failures,
        tables.text_digest(table[name]),
    )  # fmt: skip


def _take_images(made: list[ObjectRows]) -> PackedImages | None:
    """The depth images of all rows in order, taken out of the results to be let go one by one.

    Raises:
        InputError: only some objects have images, or of different sizes.
    """
    shapes = {None if result.depth is None else result.depth.shape for result in made}
    if len(shapes) > 1:
        raise InputError(f"the depth images of one shard differ in size: {shapes}")
    [shape] = shapes
    if shape is None:
        return None
    chunks: list[bytes] = []
    for result in made:
        chunks += result.depth.chunks if result.depth else []
        result.depth = None
    return PackedImages(shape, chunks)


def _finish(out: Path, manifest: Manifest) -> None:
    for split in manifest.splits():
        if manifest.rows(split) == 0:
            lost = [f for f in manifest.failures if f["split"] == split]
            again = ". Once the inputs are mended, run the same command with --retry-failed"
            raise InputError(
                f"no object of split {split!r} gave a row; see {out / manifests.FAILURES}"
                + (f". The first reason: {lost[0]['reason']}" if lost else "")
                + (again if any(f["kind"] == "failed" for f in lost) else "")
            )
        manifest.digests[split] = content_digest(
            read_columns(out / entry.file, ["row_sha256"])["row_sha256"]
            for entry in manifest.shards
            if entry.split == split and entry.rows
        )
    manifest.state = "complete"
    files = croissant.shard_files(manifest)
    write_atomically(out / croissant.NAME, croissant.text(manifest, files).encode())
    manifest.card_sha256 = manifests.bytes_sha256(write_card(out, manifest))
    manifest.save(out)
