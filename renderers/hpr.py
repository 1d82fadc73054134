"""Hidden point removal: which points of a cloud a viewpoint sees, without any surface.

Katz, Tal, Basri, "Direct Visibility of Point Sets", SIGGRAPH 2007: flip every point about a sphere
around the viewpoint, so that nearer points come to lie farther out; those on the convex hull of
the flipped points and the viewpoint are visible. docs/hpr.md says how to choose the radius and
where the method fails.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError

from partialbench.dataset.sources import RejectedView, View
from partialbench.errors import InputError
from renderers.hull_cull import possible_vertices
from renderers.normals import towards_camera
from renderers.whole import CLOUD_NORMALS, as_cloud, cloud_normals

DEFAULT_GAMMA = 1.5
"""For 1,024-point clouds, against ray casting: the least gamma whose F-score is within 0.002 of the
best, so of equal ones that which reports fewest hidden points (docs/hpr.md)."""

CULL_FROM = 30_000
"""Points from which culling is no slower and often faster (benchmarks/hpr.py speed)."""


def paper_radius(points: ArrayLike, viewpoint: ArrayLike, gamma: float) -> float:
    """The absolute radius for a relative one: 10^gamma · max‖p − viewpoint‖.

    Source: Katz et al. 2007; the exponent is the parameter of the authors' published script.

    Raises:
        InputError: as ``hidden_point_removal``, or gamma is negative (the sphere would not hold
            the cloud).
    """
    if not (np.isfinite(gamma) and gamma >= 0):
        raise InputError(f"gamma must be a finite number ≥ 0, got {gamma!r}")
    offsets = _offsets(_cloud(points), _viewpoint(viewpoint))
    return float(_norms(offsets).max() * 10.0**gamma)


def hidden_point_removal(
    points: ArrayLike, viewpoint: ArrayLike, radius: float
) -> NDArray[np.int64]:
    """Indices of the points that ``viewpoint`` sees, ascending.

    Args:
        points: (N,3), any frame and unit, N ≥ 1. Of points with equal coordinates one is reported
            (qhull's choice, as in Open3D), never two. A cloud that lies in one plane or line with
            the viewpoint is treated in that plane or line.
        viewpoint: (3,), same frame; may lie inside the cloud but not on a point.
        radius: of the sphere about the viewpoint, same unit, at least the largest distance. It is
            absolute, as Open3D's ``hidden_point_removal`` takes it; ``paper_radius`` gives it from
            the paper's relative parameter. A larger radius keeps more, seen and hidden.

    Returns:
        (V,) int64, V ≥ 1.

    Raises:
        InputError: shapes, non-finite values, a point on the viewpoint, a radius too small.
    """
    return _visible(_cloud(points), _viewpoint(viewpoint), radius)


def _cloud(points: ArrayLike) -> NDArray[np.float64]:
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise InputError(f"points must have the shape (N,3) with N ≥ 1, got {points.shape}")
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        raise InputError(
            f"{bad.sum()} of {len(points)} points are not finite, the first at index "
            f"{bad.argmax()}: {points[bad.argmax()].tolist()}; remove them"
        )
    return points


def _viewpoint(viewpoint: ArrayLike) -> NDArray[np.float64]:
    viewpoint = np.asarray(viewpoint, np.float64)
    if viewpoint.shape != (3,) or not np.isfinite(viewpoint).all():
        raise InputError(f"the viewpoint must be three finite numbers, got {viewpoint.tolist()}")
    return viewpoint


def _offsets(points: NDArray, viewpoint: NDArray) -> NDArray[np.float64]:
    offsets = points - viewpoint
    on_it = ~offsets.any(axis=1)
    if on_it.any():
        raise InputError(
            f"the viewpoint {viewpoint.tolist()} lies on point {on_it.argmax()}; a point there has "
            f"no direction: move the viewpoint"
        )
    return offsets


def _norms(offsets: NDArray) -> NDArray[np.float64]:
    x, y, z = offsets.T
    return np.sqrt(x * x + y * y + z * z)


def flip(offsets: NDArray, radius: float) -> NDArray[np.float64]:
    """The spherical flip of (N,3) offsets from the viewpoint: p ↦ p + 2(radius − ‖p‖)·p/‖p‖."""
    norms = _norms(offsets)
    return offsets + (2 * (radius - norms))[:, None] * offsets / norms[:, None]


def _visible(points: NDArray, viewpoint: NDArray, radius: float) -> NDArray[np.int64]:
    offsets = _offsets(points, viewpoint)
    farthest = _norms(offsets).max()
    if not (np.isfinite(radius) and radius >= farthest):
        raise InputError(
            f"radius {radius!r} is less than the largest distance {farthest:g} from the viewpoint; "
            f"take at least ten times that, or paper_radius(points, viewpoint, gamma)"
        )
    flipped = flip(offsets, radius)
    kept = np.arange(len(points)) if len(points) < CULL_FROM else possible_vertices(flipped)
    vertices = _hull_vertices(np.concatenate([flipped[kept], np.zeros((1, 3))]))
    return np.sort(kept[vertices[vertices < len(kept)]])


def _hull_vertices(points: NDArray) -> NDArray[np.intp]:
    """Hull vertices of (M,3) points of which the last is the origin, whatever their rank."""
    try:
        return ConvexHull(points).vertices
    except QhullError as error:
        # Fewer than four points or all in one plane: the hull is that of the plane or line.
        _, spread, axes = np.linalg.svd(points, full_matrices=False)
        rank = int((spread > 1e-9 * spread[0]).sum())
        if rank == 3:
            raise InputError(
                f"the convex hull of the {len(points) - 1} flipped points failed: they are nearly, "
                f"but not quite, in one plane with the viewpoint; move the viewpoint"
            ) from error
        flat = points @ axes[:rank].T
        if rank == 1:
            return np.array([flat.argmin(), flat.argmax()])
        return ConvexHull(flat).vertices


class HprOccluder:
    """What viewpoints see of a complete cloud, by hidden point removal.

    A view's points are the cloud's own visible points; no image is formed (K is zeros), and
    ``visible_fraction`` is the share of the cloud's distinct points.

    Args:
        gamma: radius = 10^gamma · the largest distance from the viewpoint, per view.
        radius: absolute radius in object units instead of gamma.
        normals: whether views have normals: the source's own, or of planes through the complete
            cloud's neighbouring points.

    Raises:
        InputError: both are given, or one is out of range.
    """

    def __init__(
        self, gamma: float | None = None, radius: float | None = None, normals: bool = False
    ) -> None:
        if gamma is not None and radius is not None:
            raise InputError(f"give gamma or radius, not both (got {gamma!r} and {radius!r})")
        if radius is not None and not (np.isfinite(radius) and radius > 0):
            raise InputError(f"radius must be a finite number > 0, got {radius!r}")
        self.gamma = DEFAULT_GAMMA if gamma is None else gamma
        self.radius = radius
        self.normals = normals
        if not (np.isfinite(self.gamma) and self.gamma >= 0):
            raise InputError(f"gamma must be a finite number ≥ 0, got {gamma!r}")

    def views(
        self, shape: Any, poses: list[tuple[NDArray, NDArray]], rngs: list[np.random.Generator]
    ) -> list[View | RejectedView]:
        """One view per pose of a cloud, (n,3) or an ``OrientedCloud``.

        Deterministic: the generators are not used.

        Raises:
            InputError: the shape is not a cloud, or as ``hidden_point_removal``.
        """
        cloud = as_cloud(shape)
        distinct = len(np.unique(cloud, axis=0))
        normals = cloud_normals(shape) if self.normals else None
        views: list[View | RejectedView] = []
        for rotation, translation in poses:
            in_camera = cloud @ np.asarray(rotation, np.float64).T + translation
            viewpoint = np.zeros(3)
            radius = self.radius
            if radius is None:
                radius = paper_radius(in_camera, viewpoint, self.gamma)
            visible = hidden_point_removal(in_camera, viewpoint, radius)
            points = in_camera[visible].astype(np.float32)
            views.append(
                View(
                    points=points,
                    R_camera_object=np.asarray(rotation, np.float64),
                    t_camera_object=np.asarray(translation, np.float64),
                    K=np.zeros((3, 3)),
                    visible_fraction=len(visible) / distinct,
                    n_visible=len(visible),
                    normals=None
                    if normals is None
                    else towards_camera(normals[visible], points, rotation),
                )
            )
        return views

    def describe(self) -> dict[str, Any]:
        """Name and radius, for the configuration."""
        size = {"gamma": self.gamma} if self.radius is None else {"radius": self.radius}
        normals = {"normals": CLOUD_NORMALS} if self.normals else {}
        return {"name": "hpr", **size, **normals}
