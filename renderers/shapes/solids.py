"""The vocabulary the families are written in: boxes, revolutions, sweeps, lofts, extrusions.

Every function returns a `Solid`, a bare triangle mesh. An extent along an axis is a length
(centred on zero) or an interval ``(low, high)``: ``box(1.2, 0.6, (0.70, 0.74))`` is a table top.
Faces are wound outwards; a surface that bounds no volume (a curtain, an open pot) is one sheet.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import manifold3d
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull

from renderers.shapes.outlines import Extent, circle, counter_clockwise, span, superellipse

_AXES = {"x": 0, "y": 1, "z": 2}


@dataclass(frozen=True, eq=False)
class Solid:
    """A triangle mesh under construction.

    Attributes:
        vertices: (V,3) float64, object frame, any unit; `family.finish` normalises the whole.
        faces: (F,3) int64 into ``vertices``.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]

    def at(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Solid:
        """Moved by (x, y, z)."""
        return Solid(self.vertices + np.array([x, y, z]), self.faces)

    def turned(self, axis: str, degrees: float) -> Solid:
        """Turned about a coordinate axis through the origin, right-handed."""
        i = _AXES[axis]
        j, k = (i + 1) % 3, (i + 2) % 3
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        out = self.vertices.copy()
        out[:, j] = c * self.vertices[:, j] - s * self.vertices[:, k]
        out[:, k] = s * self.vertices[:, j] + c * self.vertices[:, k]
        return Solid(out, self.faces)

    def scaled(self, x: float = 1.0, y: float = 1.0, z: float = 1.0) -> Solid:
        """Scaled along the axes about the origin; factors must be positive."""
        return Solid(self.vertices * (x, y, z), self.faces)

    def mirrored(self, axis: str) -> Solid:
        """The mirror image through the plane ``axis`` = 0, still wound outwards."""
        sign = np.ones(3)
        sign[_AXES[axis]] = -1.0
        return Solid(self.vertices * sign, self.faces[:, ::-1])

    def warped(self, move: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Solid:
        """Every vertex moved by ``move``: (V,3) → (V,3)."""
        return Solid(np.asarray(move(self.vertices.copy()), np.float64), self.faces)

    def subdivided(self, times: int = 1) -> Solid:
        """Each triangle cut into four at its edges' midpoints, ``times`` times."""
        solid = self
        for _ in range(times):
            f = solid.faces
            edges = np.sort(f[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
            key = edges[:, 0] * len(solid.vertices) + edges[:, 1]
            _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
            m = inverse.reshape(-1, 3) + len(solid.vertices)
            middle = solid.vertices[edges[first]].mean(axis=1)
            quarters = np.stack([
                np.stack([f[:, 0], m[:, 0], m[:, 2]], 1), np.stack([f[:, 1], m[:, 1], m[:, 0]], 1),
                np.stack([f[:, 2], m[:, 2], m[:, 1]], 1), m,
            ], 1)  # fmt: skip
            solid = Solid(np.concatenate([solid.vertices, middle]), quarters.reshape(-1, 3))
        return solid


def join(*parts: Solid | Iterable[Solid]) -> Solid:
    """All parts as one mesh, as CAD assemblies are: overlapping parts keep their inner faces."""
    solids: list[Solid] = []
    for part in parts:
        solids.extend([part] if isinstance(part, Solid) else part)
    starts = np.cumsum([0, *(len(s.vertices) for s in solids)])
    return Solid(
        np.concatenate([s.vertices for s in solids] or [np.zeros((0, 3))]),
        np.concatenate(
            [s.faces + n for s, n in zip(solids, starts, strict=False)]
            or [np.zeros((0, 3), np.int64)]
        ),
    )


def both(part: Solid, axis: str = "x") -> Solid:
    """The part and its mirror image through ``axis`` = 0."""
    return join(part, part.mirrored(axis))


def four(part: Solid) -> Solid:
    """The part in all four quadrants: table legs, car wheels."""
    return both(both(part, "x"), "y")


def ring(part: Solid, count: int, start_degrees: float = 0.0) -> Solid:
    """``count`` copies of the part, turned evenly about z."""
    return join(part.turned("z", start_degrees + 360.0 * i / count) for i in range(count))


# --- flat-faced -------------------------------------------------------------------------------

_BOX_FACES = np.array([
    [0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4],
    [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5],
])  # fmt: skip
_BOX_CORNERS = np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)])


def box(x: Extent, y: Extent, z: Extent) -> Solid:
    """An axis-aligned box."""
    low, high = np.array([span(x), span(y), span(z)], np.float64).T
    return Solid(np.where(_BOX_CORNERS, high, low), _BOX_FACES)


def rounded_box(x: Extent, y: Extent, z: Extent, radius: float, steps: int = 3) -> Solid:
    """A box with all edges and corners rounded; ``radius`` is cut to half the least side."""
    low, high = np.array([span(x), span(y), span(z)], np.float64).T
    radius = min(radius, float((high - low).min()) * 0.499)
    # A sphere whose eight octants are moved apart: seam rows occur twice, the flats span the gap.
    quarter = np.linspace(0, np.pi / 2, steps + 1)
    longitude = np.concatenate([quarter + q * np.pi / 2 for q in range(4)])
    latitude = np.concatenate([quarter - np.pi / 2, quarter])
    lon_sign = np.repeat([[1, 1], [-1, 1], [-1, -1], [1, -1]], steps + 1, axis=0)
    lat_sign = np.repeat([-1, 1], steps + 1)
    shape = (len(latitude), len(longitude))
    sphere = np.stack([
        np.cos(latitude)[:, None] * np.cos(longitude),
        np.cos(latitude)[:, None] * np.sin(longitude),
        np.broadcast_to(np.sin(latitude)[:, None], shape),
    ], -1)  # fmt: skip
    sign = np.stack([
        np.broadcast_to(lon_sign[:, 0], shape), np.broadcast_to(lon_sign[:, 1], shape),
        np.broadcast_to(lat_sign[:, None], shape),
    ], -1)  # fmt: skip
    half = (high - low) / 2 - radius
    return loft((low + high) / 2 + sign * half + radius * sphere)


def beam(start: ArrayLike, end: ArrayLike, width: float, depth: float, taper: float = 1.0) -> Solid:
    """A straight bar of rectangular section; ``taper`` scales the section at the end."""
    w, d = width / 2, depth / 2
    section = np.array([[-w, -d], [w, -d], [w, d], [-w, d]])
    return sweep(section, np.array([start, end], np.float64), scale=(1.0, taper))


def extrude(
    outline: ArrayLike, extent: Extent, axis: str = "z", holes: Sequence[ArrayLike] = ()
) -> Solid:
    """A polygon, possibly concave and with holes, pulled along an axis.

    Args:
        outline: (n,2) corners in either order: (x, y) for axis z, (x, z) for y, (y, z) for x.
        extent: where it lies along the axis.
        holes: outlines to cut out.
    """
    low, high = span(extent)
    section = manifold3d.CrossSection([counter_clockwise(outline)])
    for hole in holes:
        section = section - manifold3d.CrossSection([counter_clockwise(hole)])
    solid = _from_manifold(section.extrude(high - low)).at(z=low)
    if axis == "z":
        return solid
    u, v, w = solid.vertices.T
    if axis == "x":
        return Solid(np.stack([w, u, v], 1), solid.faces)
    return Solid(np.stack([u, w, v], 1), solid.faces[:, ::-1])


def hull(points: ArrayLike) -> Solid:
    """The convex hull of (n,3) points."""
    points = np.asarray(points, np.float64)
    found = ConvexHull(points)
    faces = found.simplices.astype(np.int64)
    a, b, c = points[faces].transpose(1, 0, 2)
    inward = (np.cross(b - a, c - a) * found.equations[:, :3]).sum(axis=1) < 0
    faces[inward] = faces[inward][:, ::-1]
    return Solid(points, faces)


# --- round ------------------------------------------------------------------------------------


def revolve(profile: ArrayLike, segments: int = 32, degrees: float = 360.0) -> Solid:
    """A profile turned about z.

    Args:
        profile: (n,2) radius and height, from bottom to top along the outside (then down again
            along the inside for a hollow vessel). An end off the axis leaves an open rim.
        segments: facets of a full turn: 4 gives a square section, 6 a hexagonal one.
        degrees: less than 360 leaves an open shell, beginning at +x.
    """
    r, z = np.asarray(profile, np.float64).T
    full = degrees >= 360.0
    count = segments if full else max(2, round(segments * degrees / 360.0)) + 1
    angle = np.linspace(0, np.radians(min(degrees, 360.0)), count, endpoint=not full)
    rings = np.stack([
        r[:, None] * np.cos(angle), r[:, None] * np.sin(angle),
        np.broadcast_to(z[:, None], (len(z), len(angle))),
    ], -1)  # fmt: skip
    return sheet(rings, wrap=full)


def cylinder(radius: float, z: Extent, segments: int = 24, top: float | None = None) -> Solid:
    """A capped upright cylinder, or a frustum when its ``top`` radius differs."""
    low, high = span(z)
    upper = radius if top is None else top
    return revolve([(0, low), (radius, low), (upper, high), (0, high)], segments)


def ellipsoid(x: float, y: float, z: float, segments: int = 20) -> Solid:
    """An ellipsoid about the origin with the given half axes."""
    t = np.linspace(-np.pi / 2, np.pi / 2, segments // 2 + 1)
    return revolve(np.stack([np.cos(t), np.sin(t)], 1), segments).scaled(x, y, z)


def rod(
    start: ArrayLike, end: ArrayLike, radius: float, segments: int = 10, taper: float = 1.0
) -> Solid:
    """A straight round bar; ``taper`` scales the radius at the end."""
    path = np.array([start, end], np.float64)
    return sweep(circle(radius, segments), path, scale=(1.0, taper))


def tube(
    path: ArrayLike, radius: float, segments: int = 8, closed: bool = False,
    scale: ArrayLike | None = None,
) -> Solid:  # fmt: skip
    """A round bar along (n,3) points."""
    return sweep(circle(radius, segments), path, closed=closed, scale=scale)


# --- general ----------------------------------------------------------------------------------


def sweep(
    section: ArrayLike, path: ArrayLike, closed: bool = False, scale: ArrayLike | None = None
) -> Solid:
    """A section carried along a path without twisting.

    Args:
        section: (n,2) counter-clockwise outline; its first axis starts out horizontal.
        path: (m,3) points, m ≥ 2, neighbours distinct.
        closed: the path returns to its first point.
        scale: (m,) size of the section at each point.
    """
    section, path = np.asarray(section, np.float64), np.asarray(path, np.float64)
    step = np.diff(path, axis=0, append=path[:1] if closed else path[-1:] * 2 - path[-2:-1])
    step /= np.linalg.norm(step, axis=1, keepdims=True)
    before = np.roll(step, 1, axis=0)
    if not closed:
        before[0], step[-1] = step[0], step[-2]
    tangent = step + before
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    side = np.cross((0, 0, 1.0), tangent[0])
    if np.linalg.norm(side) < 1e-6:
        side = np.array([1.0, 0, 0])
    sides = np.zeros_like(path)
    for i, t in enumerate(tangent):  # parallel transport, one point after the other
        across = side - t * (side @ t)
        # Where a hoop's corners turn the bar by 90° at once, the side comes to lie along the bar
        # and what is left of it is rounding: the turn between the directions says where it goes.
        if np.linalg.norm(across) < 1e-6:
            last = tangent[i - 1]
            across = side - (last + t) * (side @ t) / (1 + last @ t)
        side = across / np.linalg.norm(across)
        sides[i] = side
    ups = np.cross(tangent, sides)
    size = np.ones(len(path)) if scale is None else np.asarray(scale, np.float64)
    # Mitred joints: the section widens where the path bends, so a bar keeps its thickness.
    mitre = 1 / np.clip((step * tangent).sum(axis=1), 0.5, 1.0)
    bend = step - before
    length = np.linalg.norm(bend, axis=1, keepdims=True)
    bend = np.divide(bend, length, out=np.zeros_like(bend), where=length > 1e-9)
    offsets = section[:, 0, None] * sides[:, None] + section[:, 1, None] * ups[:, None]
    along = (offsets * bend[:, None]).sum(axis=-1, keepdims=True)
    offsets = offsets + along * bend[:, None] * (mitre - 1)[:, None, None]
    rings = path[:, None] + offsets * size[:, None, None]
    return _wrap_both(rings) if closed else loft(rings)


def loft(rings: ArrayLike, caps: bool = True) -> Solid:
    """Closed rings (m,n,3) joined in order, the ends closed by fans about their middles.

    The rings run counter-clockwise seen from the end towards the start.
    """
    rings = np.asarray(rings, np.float64)
    walls = sheet(rings, wrap=True)
    if not caps:
        return walls
    m, n = rings.shape[:2]
    around = np.arange(n)
    after = (around + 1) % n
    first, last = m * n, m * n + 1
    bottom = np.stack([after, around, np.full(n, first)], 1)
    top = np.stack([around + (m - 1) * n, after + (m - 1) * n, np.full(n, last)], 1)
    middles = np.stack([rings[0].mean(axis=0), rings[-1].mean(axis=0)])
    return Solid(
        np.concatenate([walls.vertices, middles]), np.concatenate([walls.faces, bottom, top])
    )


def body(stations: ArrayLike, segments: int = 20, power: float = 2.0, caps: bool = True) -> Solid:
    """A hull along x through (super)elliptic sections.

    Args:
        stations: (m,4) rows of x, half width in y, half height in z, height of the centre; x rises.
        power: 2 for ellipses, more for boxier sections.
    """
    outline = superellipse(1.0, 1.0, power, segments)
    rows = np.asarray(stations, np.float64)
    rings = np.zeros((len(rows), segments, 3))
    rings[..., 0] = rows[:, :1]
    rings[..., 1] = rows[:, 1:2] * outline[:, 0]
    rings[..., 2] = rows[:, 2:3] * outline[:, 1] + rows[:, 3:4]
    return loft(rings, caps)


def sheet(grid: ArrayLike, wrap: bool = False) -> Solid:
    """A surface through a grid of points (m,n,3); ``wrap`` joins the last column to the first."""
    grid = np.asarray(grid, np.float64)
    m, n = grid.shape[:2]
    index = np.arange(m * n).reshape(m, n)
    if wrap:
        index = np.concatenate([index, index[:, :1]], axis=1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], 2).reshape(-1, 3)
    return Solid(grid.reshape(-1, 3), faces)


def _wrap_both(rings: NDArray[np.float64]) -> Solid:
    m, n = rings.shape[:2]
    open_ended = sheet(np.concatenate([rings, rings[:1]]), wrap=True)
    return Solid(rings.reshape(-1, 3), open_ended.faces % (m * n))


# --- booleans ---------------------------------------------------------------------------------


def difference(body: Solid, *tools: Solid) -> Solid:
    """The closed body less the closed tools."""
    return _from_manifold(_manifold(body) - _manifold(join(*tools)))


def intersection(a: Solid, b: Solid) -> Solid:
    """What two closed solids share."""
    return _from_manifold(_manifold(a) ^ _manifold(b))


def _manifold(solid: Solid) -> manifold3d.Manifold:
    mesh = manifold3d.Mesh(
        np.ascontiguousarray(solid.vertices, np.float32), solid.faces.astype(np.uint32)
    )
    mesh.merge()
    made = manifold3d.Manifold(mesh)
    assert made.status() == manifold3d.Error.NoError, f"not a closed solid: {made.status()}"
    return made


def _from_manifold(made: manifold3d.Manifold) -> Solid:
    mesh = made.to_mesh()
    return Solid(
        np.asarray(mesh.vert_properties, np.float64)[:, :3],
        np.asarray(mesh.tri_verts).astype(np.int64),
    )
