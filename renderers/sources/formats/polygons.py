"""Polygons as a mesh file holds them, and how they are cut into triangles."""

from __future__ import annotations

from dataclasses import dataclass

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

from partialbench.errors import InputError

AREA_TOLERANCE = 1e-6
"""How much of a polygon's area its triangles may miss or cover twice."""
FLAT = 0.01
"""How far a corner may lie off its polygon's plane, as a share of its size, without a word."""
EPSILON = float(np.finfo(np.float64).eps)


@dataclass(frozen=True, eq=False)
class Polygons:
    """What a reader found, before anything is cut.

    Attributes:
        vertices: (V,3) float64 in the file's units.
        corners: (C,) int64, the vertex of each corner, face after face.
        sizes: (F,) int64, the corners of each face, at least 3.
        notices: what the file holds besides, and what became of it: a sentence each.
        edges: how many more faces the file has, of fewer than three corners.
        up: the axis that is up by the file's own word or its format's, "" where neither says it.
    """

    vertices: NDArray[np.float64]
    corners: NDArray[np.int64]
    sizes: NDArray[np.int64]
    notices: tuple[str, ...] = ()
    edges: int = 0
    up: str = ""

    @classmethod
    def of_triangles(
        cls, vertices: NDArray, triangles: NDArray, notices: tuple[str, ...] = ()
    ) -> Polygons:
        """From vertices (V,3) and triangles (F,3)."""
        triangles = np.asarray(triangles, np.int64).reshape(-1, 3)
        sizes = np.full(len(triangles), 3, np.int64)
        return cls(np.asarray(vertices, np.float64), triangles.reshape(-1), sizes, notices)

    @classmethod
    def of_faces(cls, vertices: NDArray, corners: NDArray, sizes: NDArray) -> Polygons:
        """From faces of any size, of which those of fewer than three corners are left out.

        Raises:
            InputError: none is left, one has no corner at all, or one, left out or not, names a
                vertex that is not there.
        """
        whole = cls(
            np.asarray(vertices, np.float64),
            np.asarray(corners, np.int64),
            np.asarray(sizes, np.int64),
        )
        whole.require_sound()
        if (whole.sizes < 1).any():
            raise InputError("a face has no corners; the file is damaged")
        edges = whole.sizes < 3
        if not edges.any():
            return whole
        if edges.all():
            raise InputError(
                f"none of its {len(edges)} faces has three corners; expected a surface"
            )
        return cls(
            whole.vertices,
            whole.corners[np.repeat(~edges, whole.sizes)],
            whole.sizes[~edges],
            (f"{edges.sum()} faces of fewer than three corners are no surface and were left out",),
            int(edges.sum()),
        )

    def require_sound(self) -> None:
        """Raise ``InputError`` for a corner that names no vertex, or one that is no point."""
        outside = (self.corners < 0) | (self.corners >= len(self.vertices))
        if outside.any():
            raise InputError(
                f"a face names vertex {self.corners[outside][0]}; the file's vertices are 0 to "
                f"{len(self.vertices) - 1}"
            )
        bad = self._not_finite()
        if len(bad) and len(wrong := np.intersect1d(bad, self.corners)):
            k = int(wrong[0])
            raise InputError(f"vertex {k} is {self.vertices[k].tolist()}; expected finite numbers")

    def unused(self) -> tuple[str, ...]:
        """What there is to say of vertices that no face uses: where some are no points."""
        count = len(self._not_finite())
        return (f"{count} vertices that no face uses are no finite points",) if count else ()

    def _not_finite(self) -> NDArray[np.int64]:
        finite = np.isfinite(self.vertices)
        return np.flatnonzero(~finite.all(axis=1)) if not finite.all() else np.zeros(0, np.int64)

    def triangles(self) -> tuple[NDArray[np.int64], tuple[str, ...]]:
        """The faces cut into triangles, and what there is to say about it.

        A polygon lies in the plane of its Newell normal (the sum of the cross products of its
        corners one after the other, which needs no flatness). Where the fan from its first corner
        covers it there, as it does every convex one, it is that fan; else ears are clipped. A
        polygon that is not flat keeps its corners, so that its triangles are not flat either; what
        is further off than ``FLAT`` is told. Corners all on one line give triangles without area.

        Returns:
            (T,3) int64, in the order of the faces, and notices.

        Raises:
            InputError: a polygon crosses itself, so that no triangles cover just what it encloses.
        """
        if (self.sizes == 3).all():
            return self.corners.reshape(-1, 3), ()
        starts = np.cumsum(self.sizes) - self.sizes
        counts = self.sizes - 2
        clipped: dict[int, NDArray[np.int64]] = {}
        fans: list[tuple[NDArray, NDArray]] = []
        warped, furthest = 0, 0.0
        for size in np.unique(self.sizes).tolist():
            faces = np.flatnonzero(self.sizes == size)
            corners = self.corners[starts[faces][:, None] + np.arange(size)]
            if size > 3:
                covers, off_plane = self._judge(corners)
                warped += int((off_plane > FLAT).sum())
                furthest = max(furthest, float(off_plane.max(initial=0)))
                for k in np.flatnonzero(~covers).tolist():
                    clipped[int(faces[k])] = self._clip_ears(corners[k], int(faces[k]))
                faces, corners = faces[covers], corners[covers]
            first = np.broadcast_to(corners[:, :1], (len(corners), size - 2))
            fans.append((faces, np.stack([first, corners[:, 1:-1], corners[:, 2:]], axis=2)))
        for face, ears in clipped.items():
            counts[face] = len(ears)
        offsets = np.cumsum(counts) - counts
        triangles = np.empty((int(counts.sum()), 3), np.int64)
        for faces, fan in fans:
            triangles[offsets[faces][:, None] + np.arange(fan.shape[1])] = fan
        for face, ears in clipped.items():
            triangles[offsets[face] : offsets[face] + len(ears)] = ears
        if not warped:
            return triangles, ()
        return triangles, (
            f"{warped} polygons are not flat (by up to {100 * furthest:.2g} % of their size); they "
            f"were cut as they look along their normal",
        )

    def _judge(self, corners: NDArray) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Of polygons of one size (m,n): whether their fan covers them, and how far off flat."""
        points, rounding = _unit_size(self.vertices[corners])
        normals, area = _newell(points)
        spokes = points[:, 1:]
        cross = np.cross(spokes[:, :-1], spokes[:, 1:])
        # Triangles of the fan that turn the other way, or go round more than once, overlap.
        turn = np.einsum("mkj,mj->mk", cross, normals)
        height = np.einsum("mkj,mj->mk", points, normals)
        flat = spokes - height[:, 1:, None] * normals[:, None]
        angle = np.arctan2(turn, np.einsum("mkj,mkj->mk", flat[:, :-1], flat[:, 1:])).sum(axis=1)
        covers = (turn >= -rounding[:, None]).all(axis=1) & (angle < 2 * np.pi - 1e-6)
        covers &= area > rounding
        return covers | _on_a_line(points, rounding), np.abs(height).max(axis=1)

    def _clip_ears(self, corners: NDArray, face: int) -> NDArray[np.int64]:
        points, rounding = _unit_size(self.vertices[corners][None])
        normals, areas = _newell(points)
        area = float(areas[0])
        if area > float(rounding[0]):
            across = np.eye(3)[np.abs(normals[0]).argmin()]
            u = np.cross(normals[0], across)
            u /= np.linalg.norm(u)
            plane = points[0] @ np.stack([u, np.cross(normals[0], u)], axis=1)
            ends = np.array([len(plane)], np.uint32)
            ears = mapbox_earcut.triangulate_float64(np.ascontiguousarray(plane), ends)
            ears = ears.reshape(-1, 3).astype(np.int64)
            a, b = points[0][ears[:, 1]], points[0][ears[:, 2]]
            vectors = np.cross(a - points[0][ears[:, 0]], b - points[0][ears[:, 0]]) / 2
            turns = vectors @ normals[0]
            # Ears may come the other way round than the polygon goes.
            ears[turns < 0] = ears[turns < 0][:, ::-1]
            vectors[turns < 0] *= -1
            lost = float(np.linalg.norm(vectors.sum(axis=0) - area * normals[0]))
            if max(lost, abs(float(np.abs(turns).sum()) - area)) <= AREA_TOLERANCE * area:
                return corners[ears]
        named = ", ".join(map(str, corners[:8].tolist())) + (", …" if len(corners) > 8 else "")
        raise InputError(
            f"face {face}, a polygon of {len(corners)} corners (vertices {named}, the first being "
            f"0), crosses itself or is far from flat, so that what it encloses is not defined; cut "
            f"it into triangles"
        )


def _unit_size(points: NDArray) -> tuple[NDArray, NDArray]:
    """Polygons (m,n,3) from their first corners, of size 1, and what rounding did to them (m,)."""
    largest = np.abs(points).max(axis=(1, 2))
    # Halved first: two coordinates near the largest float must not overflow.
    points = points / 2 - points[:, :1] / 2
    size = np.abs(points).max(axis=(1, 2))
    scale = np.where(size > 0, size, 1)
    with np.errstate(over="ignore"):
        rounding = 32 * EPSILON * np.maximum(largest / 2 / scale, 1)
    return points / scale[:, None, None], rounding


def _newell(points: NDArray) -> tuple[NDArray, NDArray]:
    """Unit normals (m,3) and areas (m,) of polygons (m,n,3) whose first corner is the origin."""
    vectors = np.cross(points[:, 1:-1], points[:, 2:]).sum(axis=1) / 2
    areas = np.linalg.norm(vectors, axis=1)
    return vectors / np.where(areas > 0, areas, 1)[:, None], areas


def _on_a_line(points: NDArray, rounding: NDArray) -> NDArray[np.bool_]:
    """Whether all corners of polygons (m,n,3), the first the origin, lie on one line or point."""
    far = np.einsum("mnj,mnj->mn", points, points).argmax(axis=1)
    line = points[np.arange(len(points)), far]
    off = np.linalg.norm(np.cross(points, line[:, None]), axis=2).max(axis=1)
    return off <= rounding
