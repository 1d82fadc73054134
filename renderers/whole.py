"""The whole surface, nothing hidden: complete clouds, aligned or turned."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from partialbench.dataset.sources import OrientedCloud, RejectedView, View
from partialbench.errors import InputError
from renderers.normals import (
    NEIGHBOURS,
    face_normals,
    plane_normals,
    towards_camera,
    unit_normals,
)

CLOUD_NORMALS = f"the source's own, or of the plane through {NEIGHBOURS} points of the whole cloud"
"""Where a cloud's normals come from, for the configuration."""


def as_cloud(shape: Any) -> NDArray[np.float64]:
    """The (n,3) float64 points of a shape that must be a cloud; ``InputError`` when it is not."""
    if isinstance(shape, trimesh.Trimesh):
        raise InputError(
            "the shape is a mesh, expected an (n,3) cloud; hidden point removal works on clouds: "
            "use a source of clouds, or a depth renderer for meshes"
        )
    cloud = np.asarray(shape.points if isinstance(shape, OrientedCloud) else shape, np.float64)
    if cloud.ndim != 2 or cloud.shape[1] != 3 or len(cloud) == 0:
        raise InputError(f"the shape must be an (n,3) cloud with n ≥ 1, got {cloud.shape}")
    return cloud


def cloud_normals(shape: Any) -> NDArray[np.float64]:
    """(n,3) unit normals of a cloud's points, of either sign, object frame: its own if it has any.

    Raises:
        InputError: the shape is no cloud, or its own normals are not one vector a point.
    """
    cloud = as_cloud(shape)
    # An ``OrientedCloud`` has them, and an instance of a scan.
    own = None if isinstance(shape, np.ndarray) else getattr(shape, "normals", None)
    if own is None:
        return plane_normals(cloud)
    if np.shape(own) != cloud.shape:
        raise InputError(
            f"the cloud has normals of shape {np.shape(own)} and points of shape {cloud.shape}; "
            f"expected one normal a point"
        )
    return unit_normals(own, cloud)


def sample_surface(
    mesh: trimesh.Trimesh, count: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """``count`` points uniform on the surface of a mesh by area, (count,3) float64, object frame.

    Raises:
        InputError: the mesh has no area.
    """
    return sample_faces(mesh, count, rng)[0]


def sample_faces(
    mesh: trimesh.Trimesh, count: int, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """As ``sample_surface``, and the face (count,) that each point lies on.

    Source of the barycentric weights: Osada et al. 2002, section 3.1 (1 − √a, √a(1 − b), √a·b).

    Raises:
        InputError: the mesh has no area.
    """
    triangles = np.asarray(mesh.triangles, np.float64)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    cumulative = np.cumsum(np.linalg.norm(normals, axis=1) / 2)
    if len(cumulative) == 0 or not cumulative[-1] > 0:
        raise InputError(f"the mesh has no surface: {len(triangles)} faces with a total area of 0")
    # side="right" never picks a face without area.
    face = np.searchsorted(cumulative, rng.random(count) * cumulative[-1], side="right")
    face = np.minimum(face, len(triangles) - 1)
    root, b = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1 - root, root * (1 - b), root * b], axis=1)
    return np.einsum("nk,nkd->nd", weights, triangles[face]), face


class WholeOccluder:
    """Complete clouds: every point of a cloud, or samples of a mesh's whole surface.

    No image is formed (K is zeros) and ``visible_fraction`` is 1.

    Args:
        samples: points drawn on a mesh per view; at least as many as the builder keeps, or rows
            repeat points.
        normals: whether views have normals: of a mesh's faces, a cloud's own, or of planes through
            neighbouring points.
    """

    def __init__(self, samples: int = 2048, normals: bool = False) -> None:
        if samples < 1:
            raise InputError(f"samples must be at least 1, got {samples}")
        self.samples = samples
        self.normals = normals

    def views(
        self, shape: Any, poses: list[tuple[NDArray, NDArray]], rngs: list[np.random.Generator]
    ) -> list[View | RejectedView]:
        """One view per pose; a mesh is sampled with the view's own generator."""
        is_mesh = isinstance(shape, trimesh.Trimesh)
        # An instance has its own; a mesh's attribute of this name is trimesh's and something else.
        symmetry = None if is_mesh else getattr(shape, "symmetry", None)
        views: list[View | RejectedView] = []
        facets: NDArray | None = None
        cloud: NDArray | None = None
        own: NDArray | None = None
        if is_mesh:
            facets = face_normals(shape.vertices, shape.faces) if self.normals else None
        else:
            cloud = as_cloud(shape)
            own = cloud_normals(shape) if self.normals else None
        for (rotation, translation), rng in zip(poses, rngs, strict=True):
            if cloud is None:
                points, face = sample_faces(shape, self.samples, rng)
                seen = None if facets is None else facets[face]
            else:
                points, seen = cloud, own
            rotation = np.asarray(rotation, np.float64)
            in_camera = (points @ rotation.T + translation).astype(np.float32)
            views.append(
                View(
                    points=in_camera,
                    R_camera_object=rotation,
                    t_camera_object=np.asarray(translation, np.float64),
                    K=np.zeros((3, 3)),
                    visible_fraction=1.0,
                    n_visible=len(in_camera) if is_mesh else len(np.unique(points, axis=0)),
                    normals=None if seen is None else towards_camera(seen, in_camera, rotation),
                    symmetry=symmetry,
                )
            )
        return views

    def describe(self) -> dict[str, Any]:
        """Name, samples and normals, for the configuration."""
        origin = f"of a mesh's faces; of a cloud {CLOUD_NORMALS}"
        normals = {"normals": origin} if self.normals else {}
        return {"name": "whole", "samples": self.samples, **normals}
