"""Mesh files of any common format as one ``trimesh.Trimesh``, and their place in the unit ball."""

from __future__ import annotations

import io
from os import PathLike
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import trimesh

from partialbench.dataset.ply import require_whole
from partialbench.errors import InputError, parsing
from renderers.sources.off import check, read_off

SUFFIXES = (".off", ".obj", ".ply", ".stl", ".glb", ".dae")
"""The formats that are read, in the order of preference where an object comes in several."""

UPS = ("z", "y")


def read_mesh(
    source: bytes | str | PathLike[str], suffix: str = "", up: str = "z", name: str = ""
) -> trimesh.Trimesh:
    """One mesh from a file, with z up.

    Several bodies and the transforms of a scene graph are concatenated; polygons are cut into
    triangles; materials and textures are left aside (an OBJ needs no .mtl). Nothing is merged or
    culled: vertices and faces are as many as the file has.

    Args:
        source: the file's content or its path.
        suffix: one of ``SUFFIXES``; taken from the path where it is "".
        up: the file's upward axis. "y" (glTF by its standard, most OBJ) turns y onto z and z onto
            −y, which keeps the handedness. It alone decides: the axis that a COLLADA file
            declares is not read.
        name: what errors call the file; the path where it was given one.

    Returns:
        Vertices (V,3) float64 in the file's units, faces (F,3) int64.

    Raises:
        InputError: the format is not one of these, or the file is broken, empty, without faces,
            names a vertex that it does not have, or has a coordinate that is no finite number.
    """
    if up not in UPS:
        raise InputError(f"up must be one of {', '.join(UPS)}, got {up!r}")
    if isinstance(source, bytes):
        content, name = source, name or f"{suffix.lstrip('.').upper()} data"
    else:
        name, suffix = name or str(source), suffix or PurePosixPath(source).suffix
        try:
            content = Path(source).read_bytes()
        except OSError as error:
            raise InputError(f"{name}: cannot be read ({error.strerror})") from error
    suffix = suffix.lower()
    if suffix not in SUFFIXES:
        found = f"the suffix {suffix}" if suffix else "no suffix"
        raise InputError(f"{name}: has {found}; expected one of {', '.join(SUFFIXES)}")
    if not content.strip():
        raise InputError(f"{name}: the file is empty; expected a mesh ({suffix})")
    mesh = read_off(content, name) if suffix == ".off" else _read_other(content, suffix, name)
    if up == "y":
        x, y, z = mesh.vertices.T
        mesh = _mesh(np.stack([x, -z, y], axis=1), mesh.faces)
    return mesh


def _read_other(content: bytes, suffix: str, name: str) -> trimesh.Trimesh:
    kind = suffix.lstrip(".")
    options: dict[str, Any] = {}
    if kind == "obj":
        options = {"skip_materials": True, "maintain_order": True}
    with parsing(name, kind.upper()):
        if kind == "ply":
            require_whole(content)
        scene = trimesh.load_scene(io.BytesIO(content), file_type=kind, process=False, **options)
        mesh = scene.to_mesh()
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    if not len(faces):
        raise InputError(f"{name}: has no faces; expected a mesh, not points or lines")
    check(vertices, faces, name)
    return _mesh(vertices, faces)


def normalise(mesh: trimesh.Trimesh, name: str = "the mesh") -> trimesh.Trimesh:
    """The mesh with its bounding-box centre at the origin and its largest norm 1.

    Vertices that no face uses are dropped first, so that they bear on neither. Nothing else is
    merged or culled, and the given mesh stays as it is.

    Raises:
        InputError: no faces, a vertex in use that is no finite number, or all of them at one place.
    """
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    if not len(faces):
        raise InputError(f"{name}: has no faces")
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    if not used.all():
        faces = (np.cumsum(used) - 1)[faces]
        vertices = vertices[used]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise InputError(f"{name}: has vertices that are NaN or infinite")
    # Halved before the sum: two coordinates near the largest float must not overflow.
    centred = vertices - (low / 2 + high / 2)
    extent = float(np.abs(centred).max())
    if extent == 0:
        raise InputError(f"{name}: all {len(vertices)} vertices in use are at {low.tolist()}")
    # By the extent first, so that the squares neither overflow nor vanish.
    centred /= extent
    centred /= np.sqrt(np.einsum("ij,ij->i", centred, centred).max())
    return _mesh(centred, faces)


def _mesh(vertices: np.ndarray, faces: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(vertices, faces, process=False, validate=False)
