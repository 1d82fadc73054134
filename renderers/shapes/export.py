"""The families as files, in ModelNet40's tree: ``<class>/<split>/<class>_0001.off``."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from trimesh.exchange.gltf import export_glb
from trimesh.exchange.obj import export_obj
from trimesh.exchange.off import export_off

from partialbench import given
from partialbench.dataset.shards import make_folder, write_atomically
from partialbench.dataset.sources import ObjectRef
from partialbench.errors import InputError
from renderers.shapes.catalogue import family_of
from renderers.shapes.source import ParametricShapes

FORMATS = ("off", "obj", "glb")

log = logging.getLogger(__name__)

# glTF 2.0 (section 3.4) has +Y up; an aligned object has +z up.
_Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def export_tree(
    out: Path,
    counts: tuple[int, int] | str = (10, 5),
    formats: Sequence[str] = ("off",),
    classes: Sequence[str] | None = None,
    seed: int = 0,
) -> int:
    """Write the objects of ``ParametricShapes(counts, seed)``, numbered as it numbers them.

    Coordinates are the aligned frame's (z up, unit ball) in .off and .obj; .glb files are turned so
    that +Y is up, as glTF demands. Files that are there already are written anew; a tree of other
    counts is not mixed with this one.

    Args:
        out: folder of the tree; made if need be.
        counts: (training, test) objects a class, or "modelnet40" for the official numbers.
        formats: any of "off", "obj", "glb".
        classes: only these class names; None for all.

    Returns:
        The number of files written.

    Raises:
        InputError: an unknown format or class, bad counts, ``out`` cannot be made, or it has
            objects of an export with other counts.
    """
    for name in formats:
        if name not in FORMATS:
            raise InputError(f"unknown format {name!r}: expected some of {', '.join(FORMATS)}")
    wanted = None if classes is None else {family_of(name).name for name in classes}
    source, tree = ParametricShapes(counts, seed), given.path(out, "--out")
    folders: dict[Path, list[ObjectRef]] = {}
    for split in source.splits():
        for ref in source.objects(split):
            name = source.class_names[ref.label]
            if wanted is None or name in wanted:
                folders.setdefault(tree / name / split, []).append(ref)
    for folder, refs in folders.items():
        _require_no_others(folder, {ref.object_id for ref in refs})
    for folder, refs in folders.items():
        make_folder(folder)
        log.info("%s/%s", folder.parent.name, folder.name)
        for ref in refs:
            mesh = source.load(ref)
            for suffix in formats:
                _write(mesh, folder / f"{ref.object_id}.{suffix}", suffix)
    return len(formats) * sum(map(len, folders.values()))


def _require_no_others(folder: Path, own: set[str]) -> None:
    """Refuses a class's folder with objects that this export has not.

    Test objects are numbered on from the training objects. With other counts the same object has
    another name, and both would stand in the tree as two.
    """
    numbered = re.compile(rf"{re.escape(folder.parent.name)}_\d+")
    there = sorted(folder.iterdir()) if folder.is_dir() else []
    for path in there:
        if path.stem not in own and numbered.fullmatch(path.stem) and path.suffix[1:] in FORMATS:
            raise InputError(
                f"{path} is of an export with other --counts, whose objects have other names in "
                f"this one: choose a folder without them, or delete {folder.parent} first"
            )


def _write(mesh: trimesh.Trimesh, path: Path, suffix: str) -> None:
    if suffix == "glb":
        turned = trimesh.Trimesh(mesh.vertices @ _Y_UP.T, mesh.faces, process=False)
        write_atomically(path, export_glb(trimesh.Scene(turned)))
    else:
        text = export_off(mesh, digits=9) if suffix == "off" else export_obj(mesh, digits=9)
        write_atomically(path, text.encode())
