"""A folder or a zip of meshes, in any layout that ``layout`` understands."""

from __future__ import annotations

import hashlib
from os import PathLike
from pathlib import PurePosixPath
from typing import Any

import trimesh

from partialbench.dataset.categories import MODELNET40
from partialbench.dataset.names import printable
from partialbench.dataset.sources import ObjectRef
from partialbench.errors import InputError
from renderers.sources.files import open_files
from renderers.sources.listing import SPLITS, list_tree
from renderers.sources.mesh import SUFFIXES, UPS, normalise, read_mesh

EXPECTED = "<class>/<file>, <class>/<split>/<file>, <split>/<class>/<file> or <class>/<object>/…"


class MeshFolder:
    """Meshes by class: OFF, OBJ, PLY, STL, GLB or DAE files in a folder or in a zip of one.

    An object is named "<class>/<file without suffix>", or by its own folder: file names such as
    ``0001.obj`` repeat from class to class. Where it comes in several formats, the first of
    ``SUFFIXES`` is taken. Where neither a folder nor a list says its split, its name does: see
    ``listing.split_of``. Labels follow the class names in order, or ModelNet40's where all of them
    are ModelNet40 classes.

    Its data set is ModelNet40 ("modelnet40", PM40) if it has all of its forty classes and nothing
    else: OFF files in the folders train and test. Its frame: the original release
    (modelnet.cs.princeton.edu) has z up and a yaw that differs from object to object; the release
    aligned by hand, published with ORION (lmb-freiburg), has the yaw of the category too. The files
    do not tell which they are, so whoever opens them says it.

    Args:
        root: a folder, or a zip file of one.
        up: the meshes' upward axis, "z" or "y" (glTF by its standard, most OBJ).
        aligned: whether all objects of a class face the same way, as pose labels need.

    Attributes: as ``partialbench.dataset.sources.Source``.
    """

    def __init__(self, root: str | PathLike[str], up: str = "z", aligned: bool = False) -> None:
        if up not in UPS:
            raise InputError(f"up must be one of {', '.join(UPS)}, got {up!r}")
        self.files = open_files(root)
        self.up = up
        self.frame = "aligned" if aligned else "original"
        names = self.files.names()
        meshes = [name for name in names if is_mesh(name)]
        found = list_tree(self.files, meshes, SUFFIXES)
        if found is None:
            raise InputError(
                f"{self.files} holds no meshes: looked for {', '.join(SUFFIXES)} as {EXPECTED} "
                f"among {len(names)} files"
                + (f"; {len(meshes)} of these formats lie otherwise" if meshes else "")
            )
        self._listed = found
        self.class_names = found.class_names
        self.rejected = found.rejected
        self.listing = found.words
        self.name = "modelnet40" if self._is_modelnet40() else "folder"
        self._last: tuple[str, bytes] | None = None

    def _is_modelnet40(self) -> bool:
        refs = [ref for split in SPLITS for ref in self._listed.of(split)]
        return (
            {self.class_names[ref.label] for ref in refs} == set(MODELNET40)
            and self._listed.pattern == "<class>/<split>/<file>"
            and not self._listed.notes
            and not self.rejected
            and all(PurePosixPath(ref.location).suffix.lower() == ".off" for ref in refs)
        )

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_last": None}

    def splits(self) -> tuple[str, ...]:
        """The splits that have objects."""
        return self._listed.splits()

    def objects(self, split: str) -> list[ObjectRef]:
        """The split's objects by label, then by name."""
        return self._listed.of(split)

    def load(self, ref: ObjectRef) -> trimesh.Trimesh:
        """The mesh, z up, in the unit ball; ``InputError`` says what is wrong with the file."""
        suffix = PurePosixPath(ref.location).suffix
        name = printable(ref.location)
        return normalise(read_mesh(self._read(ref.location), suffix, self.up, name), name)

    def digest(self, ref: ObjectRef) -> str:
        """SHA-256 of the file's bytes; ``InputError`` where they cannot be read."""
        return hashlib.sha256(self._read(ref.location)).hexdigest()

    def describe(self) -> dict[str, Any]:
        """What defines the source: where it lies does not, what it lists does."""
        return {"name": self.name, "frame": self.frame, "up": self.up, **self._listed.describe()}

    def _read(self, location: str) -> bytes:
        # A build asks for the digest and the mesh of an object one after the other.
        if self._last is None or self._last[0] != location:
            self._last = location, self.files.read(location)
        return self._last[1]


def is_mesh(name: str) -> bool:
    """Whether a file's suffix is one of a mesh format."""
    return PurePosixPath(name).suffix.lower() in SUFFIXES
