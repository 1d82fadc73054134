"""Any folder or zip of meshes whose folders are the classes."""

from __future__ import annotations

import hashlib
from os import PathLike
from pathlib import Path, PurePosixPath

from partialbench.dataset.categories import MODELNET40
from partialbench.dataset.sources import ObjectRef, RejectedObject
from partialbench.errors import InputError
from renderers.sources.files import SPLITS, Archive, Directory, Files, MeshFiles, is_mesh, no_meshes
from renderers.sources.mesh import SUFFIXES, UPS

LAYOUT = "<class>/<file> or <class>/<train or test>/<file>"
TRAIN_SHARE = 0.8


class MeshFolder(MeshFiles):
    """``<class>/<split>/<file>`` or ``<class>/<file>``, of OFF, OBJ, PLY, STL, GLB or DAE files.

    An object is named "<class>/<file without suffix>": file names such as ``0001.obj`` repeat from
    class to class. Where it comes in several formats, the first of ``SUFFIXES`` is taken. A file
    that lies in no split's folder is put into one by its name: see ``split_of``. Labels follow the
    folder names in order, or ModelNet40's where all of them are ModelNet40 classes.

    Args:
        root: a folder, or a zip file of one.
        up: the meshes' upward axis, "z" or "y" (glTF by its standard, most OBJ).
        aligned: whether all objects of a class face the same way, as pose labels need.
    """

    name = "folder"

    def __init__(self, root: str | PathLike[str], up: str = "z", aligned: bool = False) -> None:
        if up not in UPS:
            raise InputError(f"up must be one of {', '.join(UPS)}, got {up!r}")
        files: Files = Archive(root) if Path(root).is_file() else Directory(root)
        super().__init__(files, up, aligned)
        names = files.names()
        found: list[tuple[str, str, str]] = []
        for location in filter(is_mesh, names):
            *folders, _ = location.split("/")
            stem = PurePosixPath(location).stem
            if len(folders) == 1:
                object_id = f"{folders[0]}/{stem}"
                found.append((folders[0], split_of(object_id), location))
            elif len(folders) == 2 and folders[1] in SPLITS:
                found.append((folders[0], folders[1], location))
            else:
                self.rejected.append(
                    RejectedObject(stem, "", f"does not lie as {LAYOUT}", location)
                )
        if not found:
            raise no_meshes(files, len(names), SUFFIXES, LAYOUT)
        present = sorted({category for category, _, _ in found})
        known = set(present) <= set(MODELNET40)
        self.class_names = MODELNET40 if known else tuple(present)
        found.sort(key=lambda item: SUFFIXES.index(PurePosixPath(item[2]).suffix.lower()))
        self._list(
            [
                ObjectRef(
                    f"{category}/{PurePosixPath(location).stem}",
                    self.class_names.index(category),
                    split,
                    location,
                )
                for category, split, location in found
            ]
        )


def split_of(object_id: str) -> str:
    """The split of an object that lies in none: "train" for four in five names, by their digest.

    It depends on the name alone, so that adding or removing files moves no other.
    """
    digest = hashlib.sha256(object_id.encode()).digest()
    return "train" if int.from_bytes(digest[:8], "big") < TRAIN_SHARE * 2**64 else "test"
