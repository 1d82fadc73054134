"""Mesh files of any common format as one ``trimesh.Trimesh``, and their place in the unit ball."""

from __future__ import annotations

import logging
from collections.abc import Callable
from os import PathLike
from pathlib import Path, PurePosixPath

import numpy as np
import trimesh
from numpy.typing import NDArray

from partialbench.errors import InputError, parsing
from renderers.sources.formats.counted import require_counts
from renderers.sources.formats.dae import read_dae
from renderers.sources.formats.gltf import read_gltf
from renderers.sources.formats.obj import read_obj
from renderers.sources.formats.off import read_off
from renderers.sources.formats.ply import read_ply
from renderers.sources.formats.polygons import EPSILON, Polygons
from renderers.sources.formats.stl import read_stl

log = logging.getLogger(__name__)

READERS: dict[str, Callable[[bytes], Polygons]] = {
    ".off": read_off, ".obj": read_obj, ".ply": read_ply, ".stl": read_stl, ".glb": read_gltf,
    ".dae": read_dae, ".gltf": read_gltf,
}  # fmt: skip
SUFFIXES = tuple(READERS)
"""The formats that are read, in the order of preference where an object comes in several."""

UPS = ("z", "y")


def read_mesh(
    source: bytes | str | PathLike[str], suffix: str = "", up: str = "z", name: str = ""
) -> trimesh.Trimesh:
    """One mesh from a file, with z up.

    Several bodies and the transforms of a scene graph are concatenated; polygons are cut into
    triangles (``Polygons.triangles`` says how); materials and textures are left aside (an OBJ needs
    no .mtl). Nothing is merged or culled: vertices and faces are as many as the file has, which is
    counted a second time without the reader.

    Args:
        source: the file's content or its path.
        suffix: one of ``SUFFIXES``; taken from the path where it is "".
        up: the file's upward axis. "y" (glTF by its standard, most OBJ) turns y onto z and z onto
            −y, which keeps the handedness. It alone decides; where glTF's standard or a COLLADA
            file says another axis, a notice tells.
        name: what errors call the file; the path where it was given one.

    Returns:
        Vertices (V,3) float64 in the file's units, faces (F,3) int64. ``metadata["notices"]`` is a
        tuple of sentences on what the file holds besides, such as lines that were left out.

    Raises:
        InputError: the format is not one of these, or the file is broken, empty, without faces,
            holds more or less than it says, needs a feature that is not read, names a vertex that
            it does not have, or a vertex that is no finite point.
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
    with parsing(name, suffix.lstrip(".").upper()):
        polygons = READERS[suffix](content)
        polygons.require_sound()
        require_counts(content, suffix, polygons)
        triangles, notices = polygons.triangles()
    notices = (*polygons.notices, *polygons.unused(), *notices)
    if polygons.up and polygons.up != up:
        notices += (
            f"{polygons.up} is up by what the file or its format says, but it was read with {up} "
            f"up; the option --up decides",
        )
    for notice in notices:
        log.info("%s: %s", name, notice)
    vertices = polygons.vertices
    if up == "y":
        x, y, z = vertices.T
        vertices = np.stack([x, -z, y], axis=1)
    return _mesh(vertices, triangles, notices)


def normalise(mesh: trimesh.Trimesh, name: str = "the mesh") -> trimesh.Trimesh:
    """The mesh with its bounding-box centre at the origin and its largest norm 1.

    Faces without area are no shape and vertices that no other face uses are none: they are dropped
    first, so that they bear on neither. Nothing else is merged or culled, and the given mesh stays
    as it is.

    Raises:
        InputError: no face with an area, a face that names a vertex that is not there, or a vertex
            in use that is no finite number.
    """
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    if not len(faces):
        raise InputError(f"{name}: has no faces")
    if len(outside := faces[(faces < 0) | (faces >= len(vertices))]):
        raise InputError(
            f"{name}: a face names vertex {outside[0]}; its vertices are 0 to {len(vertices) - 1}"
        )
    if not (np.isfinite(vertices).all() or np.isfinite(vertices[faces]).all()):
        raise InputError(f"{name}: has vertices that are NaN or infinite")
    notices: tuple[str, ...] = tuple(mesh.metadata.get("notices", ()))
    with_area = _have_area(vertices, faces)
    if not with_area.all():
        faces = faces[with_area]
        notices += (f"{(~with_area).sum()} faces without area are no shape and were left out",)
    if not len(faces):
        raise InputError(
            f"{name}: none of its {len(with_area)} faces has an area: their corners are at one "
            f"place or on one line"
        )
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    if not used.all():
        faces = (np.cumsum(used) - 1)[faces]
        vertices = vertices[used]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    # Halved before the sum: two coordinates near the largest float must not overflow.
    centred = vertices - (low / 2 + high / 2)
    # By the extent first, so that the squares neither overflow nor vanish.
    centred /= float(np.abs(centred).max())
    centred /= np.sqrt(np.einsum("ij,ij->i", centred, centred).max())
    return _mesh(centred, faces, notices)


def _have_area(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which triangles (F,3) have an area: more height over their longest side than rounding gives.

    Each by its own size: neither a body far from the origin nor a tiny one loses its faces.
    """
    largest = float(np.abs(vertices).max())
    have = np.zeros(len(faces), bool)
    if 1e-100 < largest < 1e100:
        # No face of this mesh can be rounded by as much, so that most need no closer look.
        have = _cross(vertices, faces) > 32 * EPSILON * largest**2
    doubtful = np.flatnonzero(~have)
    if len(doubtful):
        corners = vertices[faces[doubtful]]
        reach = np.abs(corners).max(axis=(1, 2)) / 2
        # Halved first, as above.
        corners = corners / 2 - corners[:, :1] / 2
        size = np.abs(corners).max(axis=(1, 2))
        scale = np.where(size > 0, size, 1)
        corners /= scale[:, None, None]
        with np.errstate(over="ignore"):
            rounding = 8 * EPSILON * np.maximum(reach / scale, 1)
        each = np.arange(3 * len(doubtful)).reshape(-1, 3)
        have[doubtful] = _cross(corners.reshape(-1, 3), each) > rounding
    return have


def _cross(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """The largest component of the cross product of two sides of each triangle, (F,).

    By columns: several times as fast as ``np.cross`` of gathered corners.
    """
    a, b, c = np.ascontiguousarray(faces.T)
    x, y, z = np.ascontiguousarray(vertices.T)
    ax, ay, az = x[a], y[a], z[a]
    bx, by, bz = x[b] - ax, y[b] - ay, z[b] - az
    cx, cy, cz = x[c] - ax, y[c] - ay, z[c] - az
    largest = np.abs(by * cz - bz * cy)
    for component in (bz * cx - bx * cz, bx * cy - by * cx):
        np.maximum(largest, np.abs(component, out=component), out=largest)
    return largest


def _mesh(vertices: NDArray, faces: NDArray, notices: tuple[str, ...] = ()) -> trimesh.Trimesh:
    return trimesh.Trimesh(
        vertices, faces, process=False, validate=False, metadata={"notices": notices}
    )
