"""Where the bytes of files lie: a folder, or a zip read in place."""

from __future__ import annotations

import os
import zipfile
import zlib
from os import PathLike
from pathlib import Path
from typing import Any, Protocol

from partialbench.dataset.names import printable
from partialbench.errors import InputError

HEAD = 4096
"""Bytes of a file's beginning that tell what it holds."""


class Files(Protocol):
    """A tree of files. Picklable."""

    def names(self) -> list[str]:
        """The files' paths inside it with "/" between parts, sorted; none that is hidden."""
        ...

    def read(self, name: str) -> bytes:
        """One file's content; ``InputError`` where it cannot be read."""
        ...

    def head(self, name: str, size: int) -> bytes:
        """Its first bytes, ``size`` at most: all that listing reads of a file."""
        ...


class Directory:
    """A folder on disk."""

    def __init__(self, root: str | PathLike[str]) -> None:
        self.root = Path(root)
        if not self.root.is_dir():
            what = "is a file, not a folder" if self.root.exists() else "does not exist"
            raise InputError(f"{self.root} {what}; expected a folder of meshes or of clouds")

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
                if not hidden(f) and not here.resolve().is_relative_to((here / f).resolve())
            ]
            inside = here.relative_to(self.root)
            found += [(inside / f).as_posix() for f in files if not hidden(f)]
        return sorted(found)

    def read(self, name: str) -> bytes:
        """As ``Files.read``."""
        return self.head(name, -1)

    def head(self, name: str, size: int) -> bytes:
        """As ``Files.head``."""
        try:
            with open(self.root / name, "rb") as file:
                return file.read(size)
        except OSError as error:
            where = printable(str(self.root / name))
            raise InputError(f"{where}: cannot be read ({error.strerror})") from error


class Archive:
    """A zip file, read in place: nothing is unpacked to disk.

    Each process opens its own handle, so a copy may be used after a fork or a pickle.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            what = "is a folder, not a file" if self.path.exists() else "does not exist"
            raise InputError(f"{self.path} {what}; expected a zip file of meshes or of clouds")
        self._opened: tuple[int, zipfile.ZipFile, dict[str, list[zipfile.ZipInfo]]] | None = None
        self._open()

    def __str__(self) -> str:
        return str(self.path)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": None}

    def names(self) -> list[str]:
        """As ``Files.names``."""
        _, members = self._open()
        return sorted(name for name in members if not any(map(hidden, name.split("/"))))

    def read(self, name: str) -> bytes:
        """As ``Files.read``."""
        return self.head(name, -1)

    def head(self, name: str, size: int) -> bytes:
        """As ``Files.head``."""
        archive, members = self._open()
        same = members.get(name, [])
        if len({(info.CRC, info.file_size) for info in same}) > 1:
            raise InputError(
                f"{self.path}: {len(same)} different members are called {name}; pack it anew"
            )
        try:
            with archive.open(members[name][0]) as member:
                return member.read(size)
        except (zipfile.BadZipFile, zlib.error, EOFError, OSError, KeyError) as error:
            raise InputError(f"{self.path}: the member {name} is broken ({error})") from error
        except RuntimeError as error:
            # An encrypted member, or (NotImplementedError) a compression that this Python lacks.
            raise InputError(f"{self.path}: the member {name} cannot be read ({error})") from error

    def _open(self) -> tuple[zipfile.ZipFile, dict[str, list[zipfile.ZipInfo]]]:
        """This process's handle, and path inside the tree → the members that lie there."""
        if self._opened is None or self._opened[0] != os.getpid():
            try:
                archive = zipfile.ZipFile(self.path)
            except (zipfile.BadZipFile, OSError) as error:
                raise InputError(f"{self.path} is not a readable zip file ({error})") from error
            self._opened = os.getpid(), archive, _members(archive)
        return self._opened[1:]


def _members(archive: zipfile.ZipFile) -> dict[str, list[zipfile.ZipInfo]]:
    """Path with "/" between parts → the members that lie there: more than one in a damaged zip.

    Old .NET libraries write "\\" between them, which zip does not have; others keep what the folder
    was called when it was packed ("./mug/0.off", "/data//mug/0.off").
    """
    infos = [info for info in archive.infolist() if not info.is_dir()]
    backslashes = not any("/" in info.filename for info in infos)
    members: dict[str, list[zipfile.ZipInfo]] = {}
    for info in infos:
        name = info.filename
        if backslashes:
            if name.endswith("\\"):
                continue
            name = name.replace("\\", "/")
        parts = [part for part in name.split("/") if part not in ("", ".")]
        while parts[:1] == [".."]:
            del parts[0]
        members.setdefault("/".join(parts), []).append(info)
    return members


def hidden(part: str) -> bool:
    """Whether a file or folder of this name is none of the user's: ``.git``, ``._a.off``."""
    return part.startswith(".") or part == "__MACOSX"


def open_files(root: str | PathLike[str]) -> Files:
    """The tree at a path: a zip where it is a file, else a folder."""
    return Archive(root) if Path(root).is_file() else Directory(root)
