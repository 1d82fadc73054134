"""From what a user names to a source: a registered name, or whatever lies at a path."""

from __future__ import annotations

import inspect
import zipfile
from os import PathLike
from pathlib import Path, PurePosixPath
from typing import Any

from partialbench import registry
from partialbench.dataset.categories import MODELNET40
from partialbench.dataset.sources import Source
from partialbench.errors import InputError
from renderers.sources.files import SPLITS, Archive, Directory, Files, is_mesh
from renderers.sources.mesh import SUFFIXES
from renderers.sources.scannet.filters import Rules

CLOUDS = "renderers.sources.clouds:CompleteClouds"
CLOUD_SUFFIXES = (".h5", ".hdf5")
CLOUD_FILE_SUFFIXES = (".pcd", ".xyz", ".txt", ".npy")


def open_source(
    path_or_name: str | PathLike[str], described: dict[str, Any] | None = None, **options: Any
) -> Source:
    """The source behind a registered name or a path.

    A path may be a folder or a zip in ModelNet40's tree (only OFF files, all in ModelNet40's
    classes and splits), any other folder or zip of meshes, a folder of complete clouds (PLY without
    faces, PCD, XYZ, TXT, NPY), or an HDF5 file of them.

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
    path = Path(path_or_name)
    if not path.exists():
        near = registry.close_matches(text, registry.SOURCES)
        raise InputError(f"{text!r} is neither a path that exists nor the name of a source{near}")
    suffix = path.suffix.lower()
    if path.is_dir():
        files = Directory(path)
        entry = CLOUDS if _holds_clouds(files) else _layout(files, "modelnet40")
    elif suffix in CLOUD_SUFFIXES:
        entry = CLOUDS
    elif zipfile.is_zipfile(path):
        entry = _layout(Archive(path), "modelnet40-zip")
    elif suffix == ".zip":
        raise InputError(f"{path} is not a readable zip file: it is damaged or was cut short")
    elif suffix in SUFFIXES:
        raise InputError(
            f"{path} is a single mesh; put it as <class>/{path.name} and give the folder above"
        )
    else:
        raise InputError(
            f"{path} is no source: expected a folder or a .zip of meshes "
            f"({', '.join(SUFFIXES)}) or an HDF5 file of clouds ({', '.join(CLOUD_SUFFIXES)})"
        )
    return _make(entry, text, {_first_parameter(entry): path, **options}, described)


def _holds_clouds(files: Files) -> bool:
    """Whether a folder is one of clouds: none of its meshes has a face, and there are clouds.

    PLY is written for both: a header without faces tells a cloud.
    """
    found = False
    for name in files.names():
        suffix = PurePosixPath(name).suffix.lower()
        if suffix == ".ply":
            header = files.read(name)[:4096].partition(b"end_header")[0]
            if b"element face" in header:
                return False
            found = True
        elif is_mesh(name):
            return False
        elif suffix in CLOUD_FILE_SUFFIXES:
            found = True
    return found


def _layout(files: Files, modelnet: str) -> str:
    """The entry of the source that reads this tree of meshes."""
    meshes = [PurePosixPath(name) for name in files.names() if is_mesh(name)]
    as_published = meshes and all(
        len(path.parts) >= 3
        and path.suffix.lower() == ".off"
        and path.parts[-3] in MODELNET40
        and path.parts[-2] in SPLITS
        for path in meshes
    )
    return registry.SOURCES[modelnet if as_published else "folder"]


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
