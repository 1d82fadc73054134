"""Other objects between a camera and the one it looks at, so that they hide a wanted share of it.

The object, its pose and its crop are those of the unoccluded view: of its pixels, or of a scanned
object's points, some are lost, and the others are the same to the last bit. An obstacle is traced
by a scene of its own, in its own frame, and the nearer surface wins: the same pixels as of one
scene whose hits name their shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from partialbench.geometry import portable
from partialbench.geometry.camera import Camera
from partialbench.geometry.rotations import haar_rotations
from renderers.tracing import Tracer

SPREAD = 0.4
"""The share to hide is uniform within this part of the one asked for, below and above it."""
MOST_HIDDEN = 0.95
MOST_OBSTACLES = 3
NEAR_ENOUGH = 0.02
"""An obstacle that comes so near to the wanted share needs no further one."""
COARSE = 32
"""Pixels across the image in which places are tried."""
PLACES = 24
FEW_PIXELS = 100
"""Of the object in the coarse image: fewer do not tell what share an obstacle hides."""
WIDE = np.deg2rad(75)
NO_ROOM = "no room for an occluder between camera and object"
ALL_HIDDEN = "wholly hidden by other objects"


class Obstacle(NamedTuple):
    """An object in the way: p_camera = size·R·p + t for its points p in the unit ball.

    Attributes:
        shape: number of its mesh among the others.
        R: (3,3) rotation. t: (3,). size: its radius in object units.
    """

    shape: int
    R: NDArray[np.float64]
    t: NDArray[np.float64]
    size: float


class Shown(Protocol):
    """What a view shows of an object: M things that an obstacle hides or not.

    Attributes:
        count: M.
    """

    @property
    def count(self) -> int: ...

    def hidden_by(self, tracer: Tracer, R: NDArray, size: float, places: NDArray) -> NDArray:
        """(n,M) bool: which of them an obstacle of this rotation and size hides from each place
        (n,3), camera frame."""
        ...


class Pixels:
    """The pixels of a depth image that show an object, as many as placing an obstacle needs.

    Args:
        depth: (H,W) of the unoccluded object, 0 = no surface.
    """

    def __init__(self, depth: NDArray[np.float32], camera: Camera) -> None:
        step = max(1, min(depth.shape) // COARSE)
        shown = depth[::step, ::step]
        self.camera = _every(camera, step, shown.shape)
        self.there = shown > 0
        self.depth = shown[self.there]

    @property
    def count(self) -> int:
        """Pixels; none of an object so thin that the coarse image misses it."""
        return len(self.depth)

    def hidden_by(self, tracer: Tracer, R: NDArray, size: float, places: NDArray) -> NDArray:
        """As ``Shown.hidden_by``."""
        count = len(places)
        turned = np.broadcast_to(R / size, (count, 3, 3))
        images = tracer.images(turned, places, [self.camera] * count)
        other = np.stack([depth[self.there] for depth, _ in images])
        return (other > 0) & (other < self.depth)


class Lines:
    """Lines of sight from the camera to an object's points.

    Args:
        directions: (M,3) camera frame; ends: (M,) in units of them, as ``visibility.sight_lines``
            gives both.
    """

    def __init__(self, directions: NDArray[np.float32], ends: NDArray[np.float32]) -> None:
        self.directions, self.ends = directions, ends

    @property
    def count(self) -> int:
        """Points."""
        return len(self.ends)

    def hidden_by(self, tracer: Tracer, R: NDArray, size: float, places: NDArray) -> NDArray:
        """As ``Shown.hidden_by``."""
        A, count = R / size, len(places)
        along = portable.product(self.directions, A).astype(np.float32)
        eyes = -portable.product(places, A)
        every = np.broadcast_to(along, (count, *along.shape))
        return ~tracer.clear(eyes, every, np.broadcast_to(self.ends, (count, len(along))))


def arrange(
    shown: Shown,
    centre: NDArray,
    share: float,
    tracers: Sequence[Tracer],
    rng: np.random.Generator,
) -> list[Obstacle] | None:
    """Obstacles that together hide about ``share`` of what a view shows of an object.

    Each is an object of the pool in a random orientation, as large as the object itself where there
    is room, wholly between the camera and the object's unit ball. It is pushed in from a random
    side until it hides what is wanted; where it cannot hide enough, another comes from another
    side.

    Args:
        centre: (3,) of the object's unit ball, camera frame.
        share: expected, in (0, 1).
        tracers: of the pool, one a mesh in the unit ball.

    Returns:
        None where there is no room, [] where nothing is shown that could be hidden.
    """
    distance = float(np.sqrt((np.asarray(centre, np.float64) ** 2).sum()))
    room = distance - 1
    if room < 0.1:
        return None
    if not shown.count:
        return []
    wanted = min(share * rng.uniform(1 - SPREAD, 1 + SPREAD), MOST_HIDDEN)
    hidden: NDArray[np.bool_] = np.zeros((), bool)
    obstacles: list[Obstacle] = []
    for _ in range(MOST_OBSTACLES):
        k = int(rng.integers(len(tracers)))
        R = haar_rotations(rng, 1)[0]
        size = min(1.0, room / 2.7)
        away = rng.uniform(1.5 * size, room - 1.1 * size)
        sight = np.asarray(centre, np.float64) / distance
        side = _across(sight, rng.uniform(0, 2 * np.pi))
        reach = _reach(distance, away, size)
        offsets = np.linspace(reach, 0, PLACES)
        for _ in range(2):  # coarsely, then between the neighbours of the best
            places = away * sight + offsets[:, None] * side
            masks = shown.hidden_by(tracers[k], R, size, places) | hidden
            errors = np.abs(masks.mean(axis=1) - wanted)
            best = int(errors.argmin())
            tried, found = offsets[best], masks[best]
            low, high = offsets[max(best - 1, 0)], offsets[min(best + 1, PLACES - 1)]
            offsets = np.linspace(low, high, PLACES)
        obstacles.append(Obstacle(k, R, away * sight + tried * side, size))
        hidden = found
        if hidden.mean() >= wanted - NEAR_ENOUGH:
            break
    return obstacles


def _reach(distance: float, away: float, size: float) -> float:
    """How far aside an obstacle hides nothing of an object's unit ball."""
    half = np.arcsin(1 / distance)
    # From here the two cones just touch.
    if (angle := half + np.arcsin(size / away)) < WIDE:
        return float(away * np.tan(angle))
    # Towards a right angle that place runs off to infinity, and all the places that are tried with
    # it. The obstacle's ball touches the object's cone long before.
    return float((size + away * np.sin(half)) / np.cos(half))


def cropped(depth: NDArray[np.float32], camera: Camera) -> tuple[NDArray[np.float32], Camera]:
    """The part of a depth image (H,W) that shows something, at least a pixel, and its camera."""
    rows, columns = np.nonzero(depth.any(axis=1))[0], np.nonzero(depth.any(axis=0))[0]
    top, left = rows[0], columns[0]
    part = depth[top : rows[-1] + 1, left : columns[-1] + 1]
    K = camera.K.copy()
    K[:2, 2] -= left, top
    return part, Camera(K, part.shape[1], part.shape[0])


def composite(
    obstacles: Sequence[Obstacle],
    tracers: Sequence[Tracer],
    depth: NDArray[np.float32],
    camera: Camera,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """The depth of the nearest surface, and which pixels show the object: (H,W) each."""
    nearest, own = depth, depth > 0
    for each in obstacles:
        R, t = _scaled(each)
        ((other, _),) = tracers[each.shape].images(R[None], t[None], [camera])
        before = (other > 0) & ((nearest == 0) | (other < nearest))
        nearest, own = np.where(before, other, nearest), own & ~before
    return nearest, own


def unhidden(
    obstacles: Sequence[Obstacle],
    tracers: Sequence[Tracer],
    R: NDArray,
    directions: NDArray[np.float32],
    ends: NDArray[np.float32],
) -> NDArray[np.bool_]:
    """Which segments from the camera meet no obstacle: (S,) bool.

    Args:
        R: (3,3) from the frame of the directions to the camera's.
        directions: (S,3), ends: (S,) in units of them.
    """
    clear = np.ones(len(ends), bool)
    in_camera = portable.product(directions, np.asarray(R).T)
    for each in obstacles:
        A, place = _scaled(each)
        eye = -portable.apply(A.T, place)
        along = portable.product(in_camera, A).astype(np.float32)
        clear &= tracers[each.shape].clear(eye[None], along[None], ends[None])[0]
    return clear


def placed(
    obstacle: Obstacle, vertices: NDArray[np.float32], faces: NDArray[np.uint32]
) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """An obstacle's mesh where it stands, camera frame."""
    turned = obstacle.size * portable.product(vertices, obstacle.R.T) + obstacle.t
    return turned.astype(np.float32), faces


def _scaled(obstacle: Obstacle) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(3,3) and (3,) for a tracer of the mesh at its own size.

    Rays come to the mesh's frame by Rᵀ/size; their parameter, which is the depth, stays.
    """
    return obstacle.R / obstacle.size, obstacle.t


def _every(camera: Camera, step: int, shape: tuple[int, ...]) -> Camera:
    """The camera whose pixels are every ``step``-th of another's in each direction."""
    K = camera.K.copy()
    K[:2, :2] /= step
    K[:2, 2] = (camera.K[:2, 2] - 0.5) / step + 0.5
    return Camera(K, shape[1], shape[0])


def _across(sight: NDArray, angle: float) -> NDArray[np.float64]:
    """A unit vector at right angles to a unit vector."""
    # Any axis not along the line of sight, which is never across the camera's own.
    first = np.cross([0.0, 1.0, 0.0], sight)
    first /= np.sqrt((first**2).sum())
    second = np.cross(sight, first)
    cosine, sine = portable.cosine_sine(angle)
    return cosine * first + sine * second
