"""One shape by itself, a file or in memory, in the unit ball as a source would give it."""

from __future__ import annotations

from os import PathLike

import numpy as np
import trimesh
from numpy.typing import NDArray

from partialbench import given
from partialbench.dataset.cloud_files import FORMATS, read_cloud
from partialbench.dataset.ply import is_mesh
from partialbench.errors import InputError
from renderers.sources.clouds import normalise_cloud
from renderers.sources.mesh import SUFFIXES, UPS, normalise, read_mesh


def read_shape(
    shape: str | PathLike[str] | trimesh.Trimesh | trimesh.Scene | trimesh.PointCloud | NDArray,
    up: str = "z",
) -> trimesh.Trimesh | NDArray[np.float32]:
    """A mesh, or a cloud (n,3) float32, with z up, in the unit ball.

    Args:
        shape: the path of a mesh or of a complete cloud (a PLY with faces is a mesh), a mesh, a
            scene, all of whose meshes are one shape, or (n,3) points, see ``given.cloud``.
        up: the shape's upward axis, "z" or "y".

    Raises:
        InputError: no such file or format, a file that is broken, or no shape.
    """
    if not isinstance(up, str) or up not in UPS:
        raise InputError(f"up must be one of {', '.join(UPS)}, got {up!r}")
    if isinstance(shape, trimesh.Scene):
        shape = _mesh_of(shape)
    if isinstance(shape, trimesh.Trimesh):
        return normalise(_turned(shape) if up == "y" else shape)
    if isinstance(shape, trimesh.PointCloud):
        return _cloud(np.asarray(shape.vertices), up, "the cloud")
    if not isinstance(shape, str | PathLike):
        points = given.cloud(shape, "the shape (no mesh and no path)")
        if not len(points):
            raise InputError("the cloud has no points")
        return _cloud(points, up, "the cloud")
    path = given.path(shape, "the shape")
    suffix, name = path.suffix.lower(), str(path)
    if not path.is_file():
        if path.is_dir():
            raise InputError(f"{path} is a folder; give one of its files")
        raise InputError(f"no file at {path}")
    if suffix not in (*SUFFIXES, *FORMATS):
        raise InputError(
            f"{path}: {suffix or 'a file without suffix'} is not read; give a mesh "
            f"({', '.join(SUFFIXES)}) or a cloud ({', '.join(FORMATS)})"
        )
    content = path.read_bytes()
    if suffix in SUFFIXES and (suffix != ".ply" or is_mesh(content)):
        return normalise(read_mesh(content, suffix, up, name), name)
    return _cloud(read_cloud(content, name), up, name)


def _cloud(points: NDArray, up: str, name: str) -> NDArray[np.float32]:
    if up == "y":
        x, y, z = points.T
        points = np.stack([x, -z, y], axis=1)
    return normalise_cloud(points, name)


def _mesh_of(scene: trimesh.Scene) -> trimesh.Trimesh:
    """All of a scene's meshes as one; a cloud beside them would be lost without a word."""
    for name, part in scene.geometry.items():
        if isinstance(part, trimesh.PointCloud):
            raise InputError(
                f"the scene's part {name!r} is a cloud, expected meshes: delete it "
                f"(scene.delete_geometry({name!r})), or give it by itself"
            )
    return scene.to_mesh()


def _turned(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    x, y, z = np.asarray(mesh.vertices).T
    return trimesh.Trimesh(np.stack([x, -z, y], axis=1), mesh.faces, process=False, validate=False)
