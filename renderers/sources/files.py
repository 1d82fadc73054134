"""Where the bytes of mesh files lie, a folder or a zip read in place, and a source over either."""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
import zlib
from os import PathLike
from pathlib import Path, PurePosixPath
from typing import Any, Protocol

import trimesh

from partialbench.dataset.sources import ObjectRef, RejectedObject
from partialbench.errors import InputError
from renderers.sources.mesh import SUFFIXES, normalise, read_mesh

SPLITS = ("train", "test")


class Files(Protocol):
    """A tree of files. Picklable."""

    def names(self) -> list[str]:
        """The files' paths inside it with "/" between parts, sorted; none that is hidden."""
        ...

    def read(self, name: str) -> bytes:
        """One file's content; ``InputError`` where it cannot be read."""
        ...


class Directory:
    """A folder on disk."""

    def __init__(self, root: str | PathLike[str]) -> None:
        self.root = Path(root)
        if not self.root.is_dir():
            what = "is a file, not a folder" if self.root.exists() else "does not exist"
            raise InputError(f"{self.root} {what}; expected a folder of meshes")

    def __str__(self) -> str:
        return str(self.root)

    def names(self) -> list[str]:
        """As ``Files.names``; ``InputError`` where a folder in it cannot be listed."""

        def fail(error: OSError) -> None:
            raise InputError(f"{error.filename}: cannot be listed ({error.strerror})") from error

        found = []
        for folder, folders, files in os.walk(self.root, onerror=fail, followlinks=True):
            here = Path(folder)
            # A link may lead to another disk, but one that leads back up would never end.
            folders[:] = [
                f
                for f in folders
                if not _hidden(f) and not here.resolve().is_relative_to((here / f).resolve())
            ]
            inside = here.relative_to(self.root)
            found += [(inside / f).as_posix() for f in files if not _hidden(f)]
        return sorted(found)

    def read(self, name: str) -> bytes:
        """As ``Files.read``."""
        try:
            return (self.root / name).read_bytes()
        except OSError as error:
            raise InputError(f"{self.root / name}: cannot be read ({error.strerror})") from error


class Archive:
    """A zip file, read in place: nothing is unpacked to disk.

    Each process opens its own handle, so a copy may be used after a fork or a pickle.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            what = "is a folder, not a file" if self.path.exists() else "does not exist"
            raise InputError(f"{self.path} {what}; expected a zip file of meshes")
        self._opened: tuple[int, zipfile.ZipFile] | None = None
        self._zip()

    def __str__(self) -> str:
        return str(self.path)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": None}

    def names(self) -> list[str]:
        """As ``Files.names``."""
        return sorted(
            info.filename
            for info in self._zip().infolist()
            if not info.is_dir() and not any(map(_hidden, info.filename.split("/")))
        )

    def read(self, name: str) -> bytes:
        """As ``Files.read``."""
        try:
            return self._zip().read(name)
        except (zipfile.BadZipFile, zlib.error, EOFError, OSError, KeyError) as error:
            raise InputError(f"{self.path}: the member {name} is broken ({error})") from error
        except RuntimeError as error:
            # An encrypted member, or (NotImplementedError) a compression that this Python lacks.
            raise InputError(f"{self.path}: the member {name} cannot be read ({error})") from error

    def _zip(self) -> zipfile.ZipFile:
        if self._opened is None or self._opened[0] != os.getpid():
            try:
                self._opened = os.getpid(), zipfile.ZipFile(self.path)
            except (zipfile.BadZipFile, OSError) as error:
                raise InputError(f"{self.path} is not a readable zip file ({error})") from error
        return self._opened[1]


class MeshFiles:
    """A source over files whose paths say class and split; subclasses say how.

    Attributes: as ``partialbench.dataset.sources.Source``.
    """

    name = "meshes"

    def __init__(self, files: Files, up: str, aligned: bool) -> None:
        self.files = files
        self.up = up
        self.frame = "aligned" if aligned else "original"
        self.class_names: tuple[str, ...] = ()
        self.rejected: list[RejectedObject] = []
        self._objects: dict[str, list[ObjectRef]] = {split: [] for split in SPLITS}
        self._last: tuple[str, bytes] | None = None

    def _list(self, refs: list[ObjectRef]) -> None:
        """Take the objects found, in order; of two with one name in a split the first stands."""
        taken: dict[tuple[str, str], str] = {}
        for ref in refs:
            key = ref.split, ref.object_id
            if key in taken:
                self.rejected.append(
                    RejectedObject(
                        ref.object_id,
                        ref.split,
                        "another file gives an object of this name",
                        ref.location,
                        {"taken": taken[key]},
                    )
                )
                continue
            taken[key] = ref.location
            self._objects[ref.split].append(ref)
        for split in SPLITS:
            self._objects[split].sort(key=lambda ref: (ref.label, ref.object_id))

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_last": None}

    def splits(self) -> tuple[str, ...]:
        """The splits that have objects."""
        return tuple(split for split in SPLITS if self._objects[split])

    def objects(self, split: str) -> list[ObjectRef]:
        """The split's objects by label, then by name."""
        if split not in self._objects:
            raise InputError(f"no split {split!r}; expected one of {', '.join(SPLITS)}")
        return list(self._objects[split])

    def load(self, ref: ObjectRef) -> trimesh.Trimesh:
        """The mesh, z up, in the unit ball; ``InputError`` says what is wrong with the file."""
        suffix = PurePosixPath(ref.location).suffix
        content = self._read(ref.location)
        return normalise(read_mesh(content, suffix, self.up, ref.location), ref.location)

    def digest(self, ref: ObjectRef) -> str:
        """SHA-256 of the file's bytes; ``InputError`` where they cannot be read."""
        return hashlib.sha256(self._read(ref.location)).hexdigest()

    def describe(self) -> dict[str, Any]:
        """What defines the source: where it lies does not, what it lists does."""
        listing = [
            (ref.split, ref.object_id, ref.label, PurePosixPath(ref.location).suffix.lower())
            for split in SPLITS
            for ref in self._objects[split]
        ]
        return {
            "name": self.name,
            "frame": self.frame,
            "up": self.up,
            "objects": {split: len(self._objects[split]) for split in self.splits()},
            "listing_sha256": hashlib.sha256(json.dumps(listing).encode()).hexdigest(),
        }

    def _read(self, location: str) -> bytes:
        # A build asks for the digest and the mesh of an object one after the other.
        if self._last is None or self._last[0] != location:
            self._last = location, self.files.read(location)
        return self._last[1]


def is_mesh(name: str) -> bool:
    """Whether a file's suffix is one of a mesh format."""
    return PurePosixPath(name).suffix.lower() in SUFFIXES


def no_meshes(files: Files, found: int, suffixes: tuple[str, ...], layout: str) -> InputError:
    """The error for a tree without meshes."""
    return InputError(
        f"{files} holds no meshes: looked for {', '.join(suffixes)} as {layout} among {found} files"
    )


def _hidden(part: str) -> bool:
    return part.startswith(".") or part == "__MACOSX"
