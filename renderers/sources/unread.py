"""Files of a tree that look like shapes, but of which the source that was chosen makes no object.

A class of FBX files beside classes of OFF files, or of clouds beside classes of meshes, must not be
missing without a word.
"""

from __future__ import annotations

from pathlib import PurePosixPath

from partialbench.dataset.cloud_files import FORMATS
from partialbench.dataset.cloud_formats.text import SUFFIXES as TEXT
from partialbench.dataset.cloud_formats.text import looks_like_points
from renderers.sources.files import HEAD, Files
from renderers.sources.layout import Entry, Layout, split_name
from renderers.sources.mesh import SUFFIXES

OTHER_SHAPES = (
    ".3ds", ".3mf", ".abc", ".blend", ".c4d", ".ctm", ".dwg", ".dxf", ".drc", ".e57", ".fbx",
    ".iges", ".igs", ".las", ".laz", ".lwo", ".ma", ".max", ".mb", ".ptx", ".skp", ".sldprt",
    ".step", ".stp", ".usd", ".usda", ".usdc", ".usdz", ".vtk", ".vtp", ".wrl", ".x3d",
)  # fmt: skip
"""Formats of shapes that nothing here reads."""
_ARCHIVES = (".7z", ".rar", ".tar", ".tgz", ".zip")
_PACKED = (".bz2", ".gz", ".xz", ".zst")


def unread(files: Files, layout: Layout, suffixes: tuple[str, ...]) -> list[tuple[str, str]]:
    """(location, reason) of files below the classes that are shapes and belong to no object.

    A file belongs to an object that has its name or in whose own folder it lies: it is the object
    in another format, or something about it. Of the formats that the other source reads, clouds
    beside meshes or meshes beside clouds, only those are told whose class has no object at all:
    arrays and tables are often something else.

    Args:
        files: the tree.
        layout: what was understood of it.
        suffixes: the formats that were looked for.
    """
    known = [entry.location for entry in layout.entries]
    known += [location for location, _ in (*layout.left_out, *layout.alternates)]
    bare = {_bare(location) for location in known}
    own = {_own_folder(e, layout.root) for e in layout.entries if "<object>" in e.pattern}
    holding = {folder for location in known for folder in _folders(location, layout.root)}
    found = []
    for name in files.names():
        suffix = PurePosixPath(name).suffix.lower()
        folders = _folders(name, layout.root)
        if (
            suffix in suffixes
            or not name.startswith(layout.root)
            or _bare(name) in bare | holding
            or not own.isdisjoint(folders)
        ):
            continue
        if suffix in OTHER_SHAPES:
            found.append((name, f"is {suffix}, which is not read; export it as {suffixes[0]}"))
        elif _is_packed(name, suffix):
            found.append((name, "is packed, so that what it holds is not read; unpack it"))
        elif folders and holding.isdisjoint(folders) and _is_other_kind(files, name, suffix):
            kind, taken = ("cloud", "meshes") if suffix in FORMATS else ("mesh", "clouds")
            reason = f"is a {kind} in a tree that was taken for one of {taken}; give it by itself"
            found.append((name, reason))
    return found


def _is_packed(name: str, suffix: str) -> bool:
    if suffix in _ARCHIVES:
        return True
    inner = PurePosixPath(_bare(name)).suffix.lower()
    return suffix in _PACKED and inner in (*SUFFIXES, *FORMATS, *OTHER_SHAPES, ".tar")


def _is_other_kind(files: Files, name: str, suffix: str) -> bool:
    if suffix in TEXT:
        return looks_like_points(files.head(name, HEAD))
    return suffix in (*SUFFIXES, *FORMATS)


def _bare(location: str) -> str:
    return str(PurePosixPath(location).with_suffix(""))


def _own_folder(entry: Entry, root: str) -> str:
    """The folder that is the object, which its pattern tells."""
    depth = entry.pattern.split("/").index("<object>") + 1
    return root + "/".join(entry.location[len(root) :].split("/")[:depth])


def _folders(location: str, root: str) -> list[str]:
    """The folders that a file lies in, from its class's on."""
    parts = location[len(root) :].split("/")[:-1]
    first = 2 if parts and split_name(parts[0]) else 1
    return [root + "/".join(parts[:k]) for k in range(first, len(parts) + 1)]
