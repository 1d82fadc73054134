"""ModelNet40 as published: ``<class>/<split>/<class>_<number>.off`` in a folder or in its zip.

Its frame: the original release (modelnet.cs.princeton.edu) has z up and a yaw that differs from
object to object; the release aligned by hand, published with ORION (lmb-freiburg), has the yaw of
the category too. The files do not tell which they are, so whoever opens them says it.
"""

from __future__ import annotations

from os import PathLike
from pathlib import PurePosixPath

from partialbench.dataset.categories import MODELNET40
from partialbench.dataset.sources import ObjectRef, RejectedObject
from renderers.sources.files import SPLITS, Archive, Directory, Files, MeshFiles, no_meshes

LAYOUT = "<class>/<train or test>/<file>.off"


class _ModelNet40(MeshFiles):
    """Labels are the forty official ones, whether or not every class is there."""

    name = "modelnet40"

    def __init__(self, files: Files, aligned: bool) -> None:
        super().__init__(files, up="z", aligned=aligned)
        self.class_names = MODELNET40
        names = files.names()
        refs = []
        for location in names:
            path = PurePosixPath(location)
            if len(path.parts) < 3 or path.suffix.lower() != ".off":
                continue
            category, split = path.parts[-3:-1]
            if split not in SPLITS:
                continue
            if category in MODELNET40:
                refs.append(ObjectRef(path.stem, MODELNET40.index(category), split, location))
            else:
                self.rejected.append(
                    RejectedObject(
                        path.stem,
                        split,
                        "its folder is not a class of ModelNet40",
                        location,
                        {"folder": category},
                    )
                )
        if not refs:
            raise no_meshes(files, len(names), (".off",), LAYOUT)
        self._list(refs)


class ModelNet40Tree(_ModelNet40):
    """A folder with ModelNet40's tree, or the folder above it.

    Args:
        root: the folder.
        aligned: whether this is the aligned release.
    """

    def __init__(self, root: str | PathLike[str], aligned: bool = False) -> None:
        super().__init__(Directory(root), aligned)


class ModelNet40Zip(_ModelNet40):
    """ModelNet40.zip, read in place. A broken member fails when it is loaded, and alone.

    Args:
        path: the zip file.
        aligned: whether this is the aligned release.
    """

    def __init__(self, path: str | PathLike[str], aligned: bool = False) -> None:
        super().__init__(Archive(path), aligned)
