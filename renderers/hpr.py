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
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import ConvexHull, QhullError

from partialbench.dataset.sources import RejectedView, View
from partialbench.errors import InputError
from renderers.whole import as_cloud

DEFAULT_GAMMA = 2.0
"""The best F-score of 1,024-point clouds against ray casting (docs/hpr.md)."""

CULL_FROM = 30_000
"""Points from which culling pays for itself (benchmarks/hpr.py)."""

_POINTS_PER_CELL = 16
_DEPTH_MARGIN = 1e-9
_CORNER_MARGIN = 1e-10


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


def visible_sets(
    points: ArrayLike, viewpoints: ArrayLike, radius: float
) -> list[NDArray[np.int64]]:
    """``hidden_point_removal`` of one cloud (N,3) from V viewpoints (V,3), in their order."""
    points = _cloud(points)
    viewpoints = np.asarray(viewpoints, np.float64)
    if viewpoints.ndim != 2 or viewpoints.shape[1] != 3:
        raise InputError(f"viewpoints must have the shape (V,3), got {viewpoints.shape}")
    return [_visible(points, _viewpoint(viewpoint), radius) for viewpoint in viewpoints]


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


def _visible(points: NDArray, viewpoint: NDArray, radius: float) -> NDArray[np.int64]:
    offsets = _offsets(points, viewpoint)
    norms = _norms(offsets)
    farthest = norms.max()
    if not (np.isfinite(radius) and radius >= farthest):
        raise InputError(
            f"radius {radius!r} is less than the largest distance {farthest:g} from the viewpoint; "
            f"take at least ten times that, or paper_radius(points, viewpoint, gamma)"
        )
    flipped = offsets + (2 * (radius - norms))[:, None] * offsets / norms[:, None]
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


def possible_vertices(flipped: NDArray) -> NDArray[np.intp]:
    """Indices of (N,3) points left when those strictly inside hull(flipped ∪ {0}) are dropped.

    Every hull vertex is among them. With h = 1/z over the image plane of a cube's face, a plane in
    space is a plane in (u, v, h), and farther out is lower. The farthest points of the grid cells,
    triangulated, give heights that lie inside the hull; the hull's own lower boundary H is convex
    and not above them. So these heights bound H at a grid triangle's corners, and their linear
    interpolation bounds H between: what lies higher than that, nearer to the viewpoint, is inside.
    The margin of 1e-9 of the depth is far more than rounding in h (1e-15) or in qhull (about 1e-14
    of the largest coordinate).
    """
    keep = np.ones(len(flipped), np.bool_)
    axis = np.abs(flipped).argmax(axis=1)
    face = 2 * axis + (flipped[np.arange(len(flipped)), axis] < 0)
    for f in range(6):
        members = np.flatnonzero(face == f)
        cells = int(np.sqrt(len(members) / _POINTS_PER_CELL))
        if cells < 8:
            continue
        z, u, v = np.roll(flipped[members], -(f // 2), axis=1).T
        z = np.abs(z)
        x, y = _grid_coordinate(u / z, cells), _grid_coordinate(v / z, cells)
        keep[members] = ~_above(x, y, 1 / z, cells)
    return np.flatnonzero(keep)


def _grid_coordinate(u: NDArray, cells: int) -> NDArray[np.float64]:
    """u mapped linearly to [0, cells)."""
    low, high = u.min(), u.max()
    return (u - low) * (cells * (1 - 1e-12) / max(high - low, np.finfo(float).tiny))


def _above(x: NDArray, y: NDArray, h: NDArray, cells: int) -> NDArray[np.bool_]:
    """Whether each height surely lies above the lower convex hull of all (x, y, h)."""
    column, row = x.astype(np.intp), y.astype(np.intp)
    cell = column * cells + row
    lowest = np.full(cells * cells, np.inf)
    np.minimum.at(lowest, cell, h)
    chosen = h == lowest[cell]
    sites = np.stack([x[chosen], y[chosen]], axis=1)
    grid = np.stack(np.meshgrid(*2 * [np.arange(cells + 1.0)], indexing="ij"), axis=-1)
    try:
        interpolate = LinearNDInterpolator(sites, np.column_stack([h[chosen], sites]))
    except QhullError:  # the directions lie on a line
        return np.zeros(len(x), np.bool_)
    # NaN outside the triangulation: nothing is known there. In slivers the weights lose digits;
    # the corner that they give back tells how many.
    found = interpolate(grid)
    exact = np.abs(found[..., 1:] - grid).max(axis=-1) < _CORNER_MARGIN
    inside = np.where(exact, found[..., 0], np.nan)
    # Each cell is cut along its diagonal from (0,0) to (1,1).
    fx, fy = x - column, y - row
    far, near = np.maximum(fx, fy), np.minimum(fx, fy)
    side = np.where(fx >= fy, inside[column + 1, row], inside[column, row + 1])
    start, end = inside[column, row], inside[column + 1, row + 1]
    bound = (1 - far) * start + (far - near) * side + near * end
    return h > bound * (1 + _DEPTH_MARGIN)  # False where the bound is NaN


class HprOccluder:
    """What viewpoints see of a complete cloud, by hidden point removal.

    A view's points are the cloud's own visible points; no image is formed (K is zeros), and
    ``visible_fraction`` is the share of the cloud's points.

    Args:
        gamma: radius = 10^gamma · the largest distance from the viewpoint, per view.
        radius: absolute radius in object units instead of gamma.

    Raises:
        InputError: both are given, or one is out of range.
    """

    def __init__(self, gamma: float | None = None, radius: float | None = None) -> None:
        if gamma is not None and radius is not None:
            raise InputError(f"give gamma or radius, not both (got {gamma!r} and {radius!r})")
        if radius is not None and not (np.isfinite(radius) and radius > 0):
            raise InputError(f"radius must be a finite number > 0, got {radius!r}")
        self.gamma = DEFAULT_GAMMA if gamma is None else gamma
        self.radius = radius
        if not (np.isfinite(self.gamma) and self.gamma >= 0):
            raise InputError(f"gamma must be a finite number ≥ 0, got {gamma!r}")

    def views(
        self, shape: Any, poses: list[tuple[NDArray, NDArray]], rngs: list[np.random.Generator]
    ) -> list[View | RejectedView]:
        """One view per pose of an (n,3) cloud. Deterministic: the generators are not used.

        Raises:
            InputError: the shape is not a cloud, or as ``hidden_point_removal``.
        """
        cloud = as_cloud(shape)
        views: list[View | RejectedView] = []
        for rotation, translation in poses:
            in_camera = cloud @ np.asarray(rotation, np.float64).T + translation
            viewpoint = np.zeros(3)
            radius = self.radius
            if radius is None:
                radius = paper_radius(in_camera, viewpoint, self.gamma)
            visible = hidden_point_removal(in_camera, viewpoint, radius)
            views.append(
                View(
                    points=in_camera[visible].astype(np.float32),
                    R_camera_object=np.asarray(rotation, np.float64),
                    t_camera_object=np.asarray(translation, np.float64),
                    K=np.zeros((3, 3)),
                    visible_fraction=len(visible) / len(cloud),
                    n_visible=len(visible),
                )
            )
        return views

    def describe(self) -> dict[str, Any]:
        """Name and radius, for the configuration."""
        size = {"gamma": self.gamma} if self.radius is None else {"radius": self.radius}
        return {"name": "hpr", **size}
