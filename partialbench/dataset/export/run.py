"""Exporting a data folder, part by part: a part is whole under its name, and never made twice.

``export.json`` says what the export is of, which parts are finished, and at the end that all are.
What tells a reader that a folder is complete (README.md, croissant.json, …) is written last.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from types import ModuleType
from typing import Any

from partialbench import given, registry
from partialbench.dataset import manifest as manifests
from partialbench.dataset.export import bop, parquet, webdataset
from partialbench.dataset.export.parts import Done, Origin, Part, digest_of
from partialbench.dataset.lock import FILES as LOCK_FILES
from partialbench.dataset.lock import sole_user
from partialbench.dataset.render import source_of
from partialbench.dataset.shards import TEMPORARY_SUFFIX, make_folder, write_atomically
from partialbench.errors import ConfigurationMismatchError, InputError, PartialbenchError

NAME, FORMAT, VERSION = "export.json", "partialbench-export", 1
TARGETS = {"parquet": parquet, "webdataset": webdataset, "bop": bop}
"""Each module has ``parts(origin)`` and ``finish(origin, done)`` → the files that are written last.
Only "bop" needs the shapes themselves."""
THREADS = 4
"""Parts at once: reading, digesting and writing leave Python's lock free."""


def export(
    folder: Path | str,
    to: str,
    out: Path | str,
    *,
    source: str | None = None,
    on_progress: Callable[[int, int], None] | None = None,
    threads: int | None = None,
) -> list[Done]:
    """A data folder in another format, or the rest of one that was begun.

    Args:
        folder: made by ``partialbench render``, complete.
        to: "parquet" (``datasets``, pandas, Polars, DuckDB), "webdataset" (tar files) or "bop" (the
            BOP benchmark's layout, for pose estimators; of folders rendered with --keep-depth).
        out: a new folder, or one that an export of the same data was begun in.
        source: bop: what the folder was made from, for the models; the built-in shapes need none.
        on_progress: called with (rows exported, rows in all).
        threads: parts at once; default: as many as there are cores, 4 at most.

    Returns:
        The finished parts in order.

    Raises:
        InputError: no such target, a folder that is unfinished or damaged, or lacks what the target
            needs.
        ConfigurationMismatchError: ``out`` is an export of other data or to another format.
        MissingExtraError: a library of the extra [export] is missing.
    """
    if to not in TARGETS:
        raise InputError(f"no export to {to!r}{registry.close_matches(to, TARGETS)}")
    out = given.path(out, "the folder to write into")
    threads = given.whole_number(threads or min(THREADS, os.cpu_count() or 1), "threads", 1)
    origin = _origin(given.path(folder, "the data folder"), source, TARGETS[to])
    parts = TARGETS[to].parts(origin)
    make_folder(out)
    with sole_user(out):
        state = _begin_or_continue(out, to, origin.manifest)
        finished = {one.name: one for one in _finished(out, state)}
        total, rows = sum(part.rows for part in parts), 0
        for one in finished.values():
            rows += one.rows
        if on_progress:
            on_progress(rows, total)
        missing = [part for part in parts if part.name not in finished]
        recorded = {name: asdict(one) for name, one in finished.items()}
        for one in _made(out, missing, threads):
            finished[one.name] = one
            rows += one.rows
            recorded[one.name] = asdict(one)
            state["parts"] = [recorded[p.name] for p in parts if p.name in recorded]
            _save(out, state)
            if on_progress:
                on_progress(rows, total)
        done = [finished[part.name] for part in parts]
        last = TARGETS[to].finish(origin, done)
        for name, content in last.items():
            make_folder((out / name).parent)
            write_atomically(out / name, content)
        state["files"] = {name: manifests.bytes_sha256(content) for name, content in last.items()}
        state["state"] = "complete"
        _save(out, state)
    return done


def check_export(out: Path | str) -> list[str]:
    """What is wrong with an export: unfinished, or a file that is not as it was written.

    Raises:
        InputError: the folder is no export.
    """
    out = Path(out)
    state = _load(out)
    problems = []
    if state["state"] != "complete":
        problems.append("the export is unfinished; run the same command again to complete it")
    for one in (Done(**part) for part in state["parts"]):
        if not (out / one.name).exists():
            problems.append(f"{one.name} is missing")
        elif digest_of(out / one.name) != (one.bytes, one.sha256):
            problems.append(f"{one.name} is not as it was written: damaged or edited")
    for name, sha256 in state.get("files", {}).items():
        if not (out / name).is_file():
            problems.append(f"{name} is missing")
        elif digest_of(out / name)[1] != sha256:
            problems.append(f"{name} is not as it was written: damaged or edited")
    return problems


def is_export(folder: Path | str) -> bool:
    """Whether a folder was written by ``export``."""
    return (Path(folder) / NAME).is_file()


def _origin(folder: Path, source: str | None, target: ModuleType) -> Origin:
    manifest = manifests.load(folder)
    if manifest.state != "complete":
        raise InputError(
            f"{folder} is unfinished (state {manifest.state!r}): run its render command again to "
            f"complete it"
        )
    if target is not bop:
        if source is not None:
            raise InputError(f"--source {source!r} has no effect: this export needs no models")
        return Origin(folder, manifest)
    bop.require_depth(folder, manifest)
    opened, missing = source_of(folder, source)
    if opened is None:
        raise InputError(f"the models of {folder} are not at hand: {missing}")
    return Origin(folder, manifest, opened)


def _begin_or_continue(out: Path, to: str, manifest: manifests.Manifest) -> dict[str, Any]:
    # The configuration too: by it rows are cut into shards, and have images and normals or not.
    of = {
        "dataset_id": manifest.dataset_id, "digests": manifest.digests,
        "configuration_digest": manifest.configuration_digest,
    }  # fmt: skip
    wanted = {
        "format": FORMAT, "format_version": VERSION, "to": to, "of": of, "state": "unfinished",
        "parts": [], "files": {},
    }  # fmt: skip
    if not (out / NAME).exists():
        others = sorted(p.name for p in out.iterdir() if p.name not in LOCK_FILES)
        if [name for name in others if not name.endswith(TEMPORARY_SUFFIX)]:
            raise PartialbenchError(
                f"{out} is not empty and no export (it has {', '.join(others[:5])}); choose an "
                f"empty or new folder"
            )
        _save(out, wanted)
        return wanted
    state = _load(out)
    if (state["to"], state["of"]) != (to, of):
        raise ConfigurationMismatchError(
            f"{out} is an export of {_short(state['of'])} to {state['to']}, asked for "
            f"{_short(of)} to {to}; choose another --out"
        )
    for leftover in out.rglob(f".*{TEMPORARY_SUFFIX}"):
        shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
    # Before a file is replaced: the record never vouches for bytes it has not seen.
    state["state"] = "unfinished"
    _save(out, state)
    return state


def _short(of: Mapping[str, Any]) -> str:
    """ "pm40 (train 0123abcd, test …; configuration …)", digests by their first digits."""
    digests = ", ".join(f"{split} {digest[:8]}" for split, digest in of["digests"].items())
    configuration = str(of.get("configuration_digest"))[:8]
    return f"{of.get('dataset_id')} ({digests}; configuration {configuration})"


def _load(out: Path) -> dict[str, Any]:
    path = out / NAME
    if not path.is_file():
        raise InputError(f"{out} is no export: it has no {NAME}")
    try:
        state = json.loads(path.read_text("utf-8"))
        if state["format"] != FORMAT or state["format_version"] != VERSION:
            raise InputError(
                f"{path} has format {state['format']!r} version {state['format_version']!r}, "
                f"expected {FORMAT!r} version {VERSION}; export into another folder"
            )
        for part in state["parts"]:
            Done(**part)
        _ = state["to"], state["of"]["digests"], state["state"]
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} is damaged ({type(error).__name__}: {error})") from error
    return state


def _save(out: Path, state: dict[str, Any]) -> None:
    write_atomically(out / NAME, (json.dumps(state, indent=1) + "\n").encode())


def _finished(out: Path, state: dict[str, Any]) -> list[Done]:
    """The recorded parts that are there as they were written."""
    recorded = [Done(**part) for part in state["parts"]]
    return [
        one
        for one in recorded
        if (out / one.name).exists() and digest_of(out / one.name) == (one.bytes, one.sha256)
    ]


def _made(out: Path, parts: list[Part], threads: int) -> Iterator[Done]:
    with ThreadPoolExecutor(threads) as pool:
        futures = [pool.submit(_make, out, part) for part in parts]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            for future in futures:
                future.cancel()


def _make(out: Path, part: Part) -> Done:
    path = out / part.name
    make_folder(path.parent)
    with _whole(path) as temporary:
        part.write(temporary)
        size, sha256 = digest_of(temporary)
    return Done(part.name, part.rows, size, sha256)


@contextmanager
def _whole(path: Path) -> Iterator[Path]:
    """A name to write a file or folder under; it gets its own when all is there."""
    temporary = path.with_name(f".{path.name}{TEMPORARY_SUFFIX}")
    try:
        yield temporary
        if path.is_dir():
            shutil.rmtree(path)
        os.replace(temporary, path)
    except OSError as error:
        raise PartialbenchError(
            f"could not write {path}: {error.strerror or error}. What was finished before is kept; "
            f"free some space or fix the permission and run the same command again to continue"
        ) from error
    finally:
        if temporary.is_dir():
            shutil.rmtree(temporary, ignore_errors=True)
        else:
            temporary.unlink(missing_ok=True)
