"""From what a user names to a source: a registered name, or whatever lies at a path."""

from __future__ import annotations

import inspect
import zipfile
from os import PathLike
from pathlib import PurePosixPath
from typing import Any

from partialbench import given, registry
from partialbench.dataset.cloud_files import FORMATS
from partialbench.dataset.ply import header_is_whole, is_mesh
from partialbench.dataset.sources import Source
from partialbench.errors import InputError
from renderers.sources.files import Archive, Directory, Files
from renderers.sources.mesh import SUFFIXES
from renderers.sources.ply_hdf5 import SUFFIXES as HDF5
from renderers.sources.scannet.filters import Rules

CLOUDS = "renderers.sources.clouds:CompleteClouds"
MESHES = "renderers.sources.folder:MeshFolder"


def open_source(
    path_or_name: str | PathLike[str], described: dict[str, Any] | None = None, **options: Any
) -> Source:
    """The source behind a registered name or a path.

    A path may be a folder or a zip of meshes, one of complete clouds (PLY without faces, PCD,
    XYZ, PTS, TXT, CSV, NPY, NPZ), an HDF5 file of them, or the folder of a release in HDF5.

    Args:
        path_or_name: a name of ``registry.SOURCES`` or a path; a name wins over a path of the same
            spelling (write ``./name`` for the path).
        described: what ``describe`` said of a source: it is opened with the same options, as far as
            it takes them and none of ``options`` says otherwise.
        options: passed to the source: ``aligned`` (meshes), ``up`` (folders), and others' own.

    Raises:
        InputError: nothing is there, it is nothing a source reads, it holds no meshes, or an option
            is not one of the source's.
    """
    text = str(path_or_name)
    if text in registry.SOURCES:
        return _make(registry.SOURCES[text], text, options, described)
    path = given.path(path_or_name, "the source")
    if not path.exists():
        near = registry.close_matches(text, registry.SOURCES)
        raise InputError(f"{text!r} is neither a path that exists nor the name of a source{near}")
    suffix = path.suffix.lower()
    if path.is_dir():
        entry = _entry(Directory(path))
    elif suffix in HDF5:
        entry = CLOUDS
    elif zipfile.is_zipfile(path) and suffix not in FORMATS:
        entry = _entry(Archive(path))
    elif suffix == ".zip":
        raise InputError(f"{path} is not a readable zip file: it is damaged or was cut short")
    elif suffix in (*SUFFIXES, *FORMATS):
        what = "mesh" if suffix in SUFFIXES else "cloud"
        raise InputError(
            f"{path} is a single {what}; put it as <class>/{path.name} and give the folder above"
        )
    else:
        raise InputError(
            f"{path} is no source: expected a folder or a .zip of meshes "
            f"({', '.join(SUFFIXES)}) or of clouds ({', '.join(FORMATS)}), or an HDF5 file of "
            f"clouds ({', '.join(HDF5)})"
        )
    return _make(entry, text, {_first_parameter(entry): path, **options}, described)


def _entry(files: Files) -> str:
    """The entry of the source that reads this tree: meshes, if there is one, else clouds.

    PLY is written for both: the faces that a header counts tell. HDF5 files are clouds.
    """
    plys = []
    other_clouds = False
    for name in files.names():
        suffix = PurePosixPath(name).suffix.lower()
        if suffix == ".ply":
            plys.append(name)
        elif suffix in SUFFIXES:
            return MESHES
        else:
            other_clouds |= suffix in (*FORMATS, *HDF5)
    if any(_has_faces(files, name) for name in plys):
        return MESHES
    return CLOUDS if plys or other_clouds else MESHES


def _has_faces(files: Files, name: str) -> bool:
    """Whether a PLY is a mesh; one without a header is left to the reader of clouds."""
    size = 4096
    while not header_is_whole(head := files.head(name, size)) and len(head) == size:
        size *= 4
    try:
        return is_mesh(head)
    except InputError:
        return False


def _first_parameter(entry: str) -> str:
    return next(iter(inspect.signature(registry.load(entry)).parameters))


def _described_options(described: dict[str, Any]) -> dict[str, Any]:
    """The options behind a description, of whichever source."""
    names = ("up", "viewpoints", "labels", "rooms", "seed", "sensor")
    options = {name: described[name] for name in names if name in described}
    if "frame" in described:
        options["aligned"] = described["frame"] == "aligned"
    if "rules" in described:
        known = Rules.__dataclass_fields__
        options["rules"] = Rules(**{k: v for k, v in described["rules"].items() if k in known})
    if isinstance(described.get("split"), dict):
        options["split_file"] = described["split"]
    return options


def _make(
    entry: str, named: str, options: dict[str, Any], described: dict[str, Any] | None
) -> Source:
    factory = registry.load(entry)
    signature = inspect.signature(factory)
    filled = _described_options(described or {})
    options = {k: v for k, v in filled.items() if k in signature.parameters} | options
    try:
        signature.bind(**options)
    except TypeError as error:
        known = ", ".join(signature.parameters)
        raise InputError(f"the source {named!r} takes {known or 'no options'}: {error}") from None
    return factory(**options)
