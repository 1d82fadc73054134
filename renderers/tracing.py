"""Rays against one mesh, by Mitsuba: depth images of many cameras, and lines of sight.

One acceleration structure in the mesh's frame serves every view; the cameras move instead. A ray
leaves through each pixel's exact centre with a direction whose camera z is 1, so the distance
Mitsuba returns, in units of that direction, is the z-depth itself: no integrator, no film and no
jitter stand between the ray and the number. Faces count from both sides.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from partialbench.geometry.camera import Camera

# A packet of rays costs what the region it crosses costs: 16 neighbours in a 4×4 tile took two
# thirds of the time of 16 in a row.
TILE = 4
# Bounds the memory of one launch (64 MiB of depth); ten views of 256×256 are a twenty-fifth of it.
MAX_RAYS = 1 << 24

Image = tuple[NDArray[np.float32], NDArray[np.uint32] | None]
"""z-depth (H,W), 0 = no surface, and the index of the face that each pixel shows (0 where none)."""


class Tracer(Protocol):
    """What traces rays against one mesh."""

    def images(
        self, R: NDArray, t: NDArray, cameras: list[Camera], faces: bool = False
    ) -> Iterator[Image]:
        """Each view's z-depth image and, if asked for, which face each pixel shows."""
        ...

    def clear(
        self, eyes: NDArray, directions: NDArray[np.float32], ends: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """Which segments meet no surface.

        Args:
            eyes: (V,3) where they begin; directions: (V,S,3); ends: (V,S) in units of direction.

        Returns:
            (V,S) bool.
        """
        ...


def make_tracer(variant: str, vertices: NDArray[np.float32], faces: NDArray[np.uint32]) -> Tracer:
    """A tracer of a mesh, vertices (V,3) and faces (F,3), under an active Mitsuba variant."""
    kind = _ScalarTracer if variant.startswith("scalar") else _VectorTracer
    return kind(vertices, faces)


def make_scene(vertices: NDArray[np.float32], faces: NDArray[np.uint32]) -> Any:
    """A ``mitsuba.Scene`` of the active variant; Any, as what it returns depends on the variant."""
    mesh = mi.Mesh("object", len(vertices), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = vertices.ravel()
    parameters["faces"] = faces.ravel()
    parameters.update()
    # Embree's robust test leaves no cracks between triangles. It also spares the splitting of
    # triangles: on 20,000 faces the structure is built in a third of the time.
    return mi.load_dict({"type": "scene", "object": mesh, "embree_use_robust_intersections": True})


def _rays(R: NDArray, t: NDArray, cameras: list[Camera]) -> NDArray[np.float32]:
    """(V,12): the map from (u, v, 1) to a view's ray direction in the object frame, and its eye."""
    rows = np.zeros((len(cameras), 12), np.float32)
    for k, camera in enumerate(cameras):
        (fx, _, cx), (_, fy, cy), _ = camera.K
        to_slope = np.array([[1 / fx, 0, -cx / fx], [0, 1 / fy, -cy / fy], [0, 0, 1]])
        rows[k, :9] = (R[k].T @ to_slope).ravel()
        rows[k, 9:] = -R[k].T @ t[k]
    return rows


class _VectorTracer:
    """Vectorised ray tracing of one mesh: all rays of all views in one launch."""

    def __init__(self, vertices: NDArray[np.float32], faces: NDArray[np.uint32]) -> None:
        self.scene = make_scene(vertices, faces)

    def images(
        self, R: NDArray, t: NDArray, cameras: list[Camera], faces: bool = False
    ) -> Iterator[Image]:
        """As ``Tracer.images``."""
        width, height = cameras[0].width, cameras[0].height
        tile_columns, tile_rows = -(-width // TILE), -(-height // TILE)
        per_view = tile_columns * tile_rows * TILE * TILE
        rays = _rays(R, t, cameras)
        step = max(1, MAX_RAYS // per_view)
        for first in range(0, len(rays), step):
            batch = rays[first : first + step]
            hit = self._launch(batch, per_view, tile_columns)
            z = dr.select(hit.is_valid(), hit.t, 0.0)
            face = dr.select(hit.is_valid(), hit.prim_index, 0) if faces else None
            dr.eval(z, face)
            parts = []
            for values in (z, face):
                if values is None:
                    parts.append([None] * len(batch))
                    continue
                tiles = values.numpy().reshape(len(batch), tile_rows, tile_columns, TILE, TILE)
                whole = tiles.swapaxes(2, 3).reshape(len(batch), tile_rows * TILE, -1)
                parts.append(whole[:, :height, :width])
            yield from zip(*parts, strict=True)

    def _launch(self, rays: NDArray[np.float32], per_view: int, tile_columns: int) -> Any:
        """What the rays of some views meet first, in tiles: a preliminary intersection."""
        index = dr.arange(mi.UInt32, len(rays) * per_view)
        view = index // per_view
        pixel = index - view * per_view
        tile, inner = pixel // (TILE * TILE), pixel % (TILE * TILE)
        tile_row = tile // tile_columns
        u = mi.Float((tile - tile_row * tile_columns) * TILE + inner % TILE) + 0.5
        v = mi.Float(tile_row * TILE + inner // TILE) + 0.5
        table = mi.Float(rays.ravel())
        m = [dr.gather(mi.Float, table, view * 12 + k) for k in range(12)]
        direction = mi.Vector3f(*(m[k] * u + m[k + 1] * v + m[k + 2] for k in (0, 3, 6)))
        ray = mi.Ray3f(mi.Point3f(*m[9:]), direction)
        return self.scene.ray_intersect_preliminary(ray, coherent=True)

    def clear(
        self, eyes: NDArray, directions: NDArray[np.float32], ends: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """As ``Tracer.clear``."""
        count = ends.shape[1]
        view = dr.arange(mi.UInt32, ends.size) // count
        origin = dr.gather(mi.Point3f, mi.Float(eyes.astype(np.float32).ravel()), view)
        direction = mi.Vector3f(directions.reshape(-1, 3).T)
        ray: Any = mi.Ray3f(origin, direction)
        ray.maxt = mi.Float(ends.ravel())
        return ~self.scene.ray_test(ray).numpy().reshape(ends.shape)


class _ScalarTracer:
    """The same, one ray at a time: for machines without LLVM."""

    def __init__(self, vertices: NDArray[np.float32], faces: NDArray[np.uint32]) -> None:
        self.scene = make_scene(vertices, faces)

    def images(
        self, R: NDArray, t: NDArray, cameras: list[Camera], faces: bool = False
    ) -> Iterator[Image]:
        """As ``Tracer.images``."""
        intersect = self.scene.ray_intersect_preliminary
        for row, camera in zip(_rays(R, t, cameras), cameras, strict=True):
            M, eye = row[:9].reshape(3, 3), row[9:]
            pixels = camera.pixel_centres().reshape(-1, 2).astype(np.float32)
            directions = pixels @ M[:, :2].T + M[:, 2]
            ray = mi.Ray3f(mi.Point3f(eye), mi.Vector3f(0, 0, 1))
            z = np.zeros(len(directions), np.float32)
            face = np.zeros(len(directions), np.uint32)
            for k, direction in enumerate(directions.tolist()):
                ray.d = direction
                hit = intersect(ray)
                z[k] = hit.t
                if faces:
                    face[k] = hit.prim_index
            missed = np.isinf(z)
            z[missed] = face[missed] = 0
            shape = camera.height, camera.width
            yield z.reshape(shape), face.reshape(shape) if faces else None

    def clear(
        self, eyes: NDArray, directions: NDArray[np.float32], ends: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """As ``Tracer.clear``."""
        seen = np.zeros(ends.shape, bool)
        blocked = self.scene.ray_test
        for k, eye in enumerate(eyes.tolist()):
            ray = mi.Ray3f(mi.Point3f(eye), mi.Vector3f(0, 0, 1))
            segments = zip(directions[k].tolist(), ends[k].tolist(), strict=True)
            for j, (ray.d, ray.maxt) in enumerate(segments):
                seen[k, j] = not blocked(ray)
        return seen
