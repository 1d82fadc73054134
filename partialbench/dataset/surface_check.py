"""Whether a folder's points and normals, brought back, are those of their source's surface."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from partialbench.dataset import objects as tables
from partialbench.dataset.manifest import Manifest, ShardEntry
from partialbench.dataset.shards import Columns
from partialbench.dataset.sources import Source
from partialbench.errors import InputError

SURFACE_TOLERANCE = 1e-4
"""How far off the source's surface an ideal sensor's point may lie (object units)."""
ANGLE_TOLERANCE_DEG = 1.0
"""How far a point's normal may be turned from its source's."""
POINTS_A_ROW = 64


@dataclass
class SurfaceCheck:
    """What a sample of rows looked like beside their source."""

    found: list[str] = field(default_factory=list)
    offsets: list[NDArray[np.float64]] = field(default_factory=list)
    angles: list[NDArray[np.float64]] = field(default_factory=list)

    def look(self, entry: ShardEntry, columns: Columns, source: Source, share: int) -> None:
        """Hold the first points of ``share`` rows of a shard against their source."""
        try:
            refs = {tables.stored_id(ref.object_id): ref for ref in source.objects(entry.split)}
        except InputError as error:
            self.found.append(f"{entry.file}: {error}")
            return
        for row in np.unique(np.linspace(0, entry.rows - 1, share).astype(int)):
            stored = bytes(columns["object_id"][row])
            if stored not in refs:
                name = stored.decode("utf-8", "backslashreplace")
                self.found.append(f"{entry.file}: the source has no object {name!r}")
                continue
            try:
                # Sources of mesh files hold what they read against a count of their own.
                shape = source.load(refs[stored])
            except InputError as error:
                self.found.append(f"{entry.file}: row {row} cannot be checked: {error}")
                continue
            R, t = columns["R_camera_object"][row], columns["t_camera_object"][row]
            points = (columns["points"][row][:POINTS_A_ROW] - t) @ R
            self.offsets.append(surface_distance(shape, points))
            if "normals" in columns:
                normals = columns["normals"][row][:POINTS_A_ROW].astype(np.float64) @ R
                self.angles.append(normal_angles_deg(shape, points, normals))

    def distances(self) -> dict[str, float] | None:
        """The largest and the mean distance to the surface; None where nothing was looked at."""
        if not self.offsets:
            return None
        distances = np.concatenate(self.offsets)
        return {"max": float(distances.max()), "mean": float(distances.mean())}

    def problems(self, manifest: Manifest) -> list[str]:
        """One sentence each. What a noisy sensor moved is reported, not judged."""
        problems = list(self.found)
        distances = self.distances()
        if distances is None or manifest.sensor:
            return problems
        if distances["max"] > SURFACE_TOLERANCE:
            problems.append(
                f"points lie up to {distances['max']:.2g} object units off the source's surface "
                f"(allowed: {SURFACE_TOLERANCE:g})"
            )
        angles = np.concatenate([*self.angles, np.zeros(0)])
        if (wrong := angles > ANGLE_TOLERANCE_DEG).any():
            problems.append(
                f"{wrong.sum()} of {len(angles)} normals are turned from the source's, by up to "
                f"{np.nanmax(angles):.0f} degrees (allowed: {ANGLE_TOLERANCE_DEG:g})"
            )
        return problems

    def notes(self, manifest: Manifest) -> list[str]:
        """What could not be judged."""
        notes = []
        if self.offsets and manifest.sensor:
            notes.append("the sensor is noisy: surface distances are reported, not judged")
        if any(np.isnan(angles).all() for angles in self.angles):
            notes.append("normals not checked where the source's clouds have none of their own")
        return notes


def surface_distance(shape: Any, points: NDArray) -> NDArray[np.float64]:
    """Distance of (n,3) object-frame points to a mesh's surface or to a cloud's points: (n,)."""
    if hasattr(shape, "faces"):
        from trimesh.proximity import closest_point

        return closest_point(shape, points)[1]
    from scipy.spatial import cKDTree

    cloud = shape if isinstance(shape, np.ndarray) else shape.points
    return cKDTree(cloud).query(points)[0]


def normal_angles_deg(shape: Any, points: NDArray, normals: NDArray) -> NDArray[np.float64]:
    """Angles (n,) between normals and those of the surface at the points, of either sign, degrees.

    At an edge several faces are near enough to be the point's: the best of them counts.

    Args:
        shape: a mesh, or a cloud; NaN for each point where a cloud has no normals of its own.
        points, normals: (n,3), object frame; normals of unit length.
    """
    if not hasattr(shape, "faces"):
        own = None if isinstance(shape, np.ndarray) else getattr(shape, "normals", None)
        if own is None:
            return np.full(len(points), np.nan)
        from scipy.spatial import cKDTree

        nearest = cKDTree(shape.points).query(points)[1]
        return _angles_deg(np.asarray(own, np.float64)[nearest], normals)
    from trimesh.proximity import nearby_faces
    from trimesh.triangles import closest_point

    triangles = np.asarray(shape.triangles, np.float64)
    crosses = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    near = nearby_faces(shape, points)
    of_point = np.repeat(np.arange(len(points)), [len(faces) for faces in near])
    faces = np.concatenate(near).astype(int)
    closest = closest_point(triangles[faces], points[of_point])
    touching = np.linalg.norm(closest - points[of_point], axis=1) <= SURFACE_TOLERANCE
    angles = np.full(len(points), 90.0)  # off the surface, which is a problem of its own
    found = _angles_deg(crosses[faces[touching]], normals[of_point[touching]])
    np.fmin.at(angles, of_point[touching], found)
    return angles


def _angles_deg(vectors: NDArray, units: NDArray) -> NDArray[np.float64]:
    """Angles (n,) between lines: of vectors of any length, NaN where it is 0, and of units."""
    across = np.linalg.norm(np.cross(vectors, units), axis=1)
    along = np.abs(np.einsum("ij,ij->i", vectors, units))
    none = (across == 0) & (along == 0)
    return np.where(none, np.nan, np.rad2deg(np.arctan2(across, along)))
