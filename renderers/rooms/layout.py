"""Where things stand: a room of a type, its furniture placed without collision.

Room frame: metres, z up, the floor at z = 0, one corner at the origin, walls along x and y.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.seeding import generator
from partialbench.geometry import portable
from renderers.rooms.furniture import KINDS, SINK_RIM_M, SUPPORTS, Cad, make_cad
from renderers.sources.scannet.scan2cad import FRONT, R_canonical_cad
from renderers.whole import sample_surface

WALL_HEIGHT_M = 2.4
CLEARANCE_M = 0.06
"""Least horizontal distance between two pieces."""
WALL_GAP_M = (0.03, 0.08)
YAW_JITTER = np.deg2rad(4.0)
TRIES = 300
ATTEMPTS = 20
SURFACE_SAMPLES = 10_000
MAX_COVER = 0.45
"""At most this share of the floor is covered: a person must be able to walk about."""

_DIRECTIONS = {"-x": np.array([-1.0, 0.0]), "-y": np.array([0.0, -1.0])}


@dataclass(frozen=True)
class RoomType:
    """What a kind of room holds.

    Attributes:
        width_m, depth_m: (low, high).
        always: classes, one piece each, repeated for more.
        maybe: class → probability of one more piece.
    """

    width_m: tuple[float, float]
    depth_m: tuple[float, float]
    always: tuple[str, ...]
    maybe: dict[str, float]


ROOM_TYPES: dict[str, RoomType] = {
    "bedroom": RoomType(
        (4.2, 5.2), (3.8, 4.8), ("bed", "night_stand", "dresser", "lamp"),
        {"night_stand": 0.6, "chair": 0.6, "desk": 0.4, "bed": 0.3, "monitor": 0.4},
    ),
    "bathroom": RoomType(
        (3.2, 4.2), (3.0, 3.8), ("bathtub", "toilet", "sink"),
        {"sink": 0.4, "dresser": 0.3, "toilet": 0.3, "bathtub": 0.3},
    ),
    "kitchen": RoomType(
        (4.2, 5.2), (3.8, 4.8), ("stove", "sink", "table", "chair", "chair"),
        {"chair": 0.7, "stove": 0.3, "sink": 0.3},
    ),
    "living room": RoomType(
        (4.6, 6.0), (4.2, 5.2), ("sofa", "table", "bookshelf", "lamp"),
        {"sofa": 0.6, "chair": 0.7, "bookshelf": 0.4, "lamp": 0.5, "dresser": 0.4},
    ),
    "office": RoomType(
        (4.4, 5.6), (4.0, 5.0), ("desk", "desk", "monitor", "printer", "chair"),
        {"monitor": 0.7, "printer": 0.4, "chair": 0.8, "bookshelf": 0.6, "table": 0.4},
    ),
}  # fmt: skip
"""Room types in the order in which rooms take turns: five rooms in a row have all 15 classes."""


@dataclass(frozen=True)
class Piece:
    """A CAD model at its place.

    Attributes:
        R_room_object: (3,3) float64, canonical frame → room.
        centre: (3,) box centre in the room.
    """

    cad: Cad
    R_room_object: NDArray[np.float64]
    centre: NDArray[np.float64]

    @property
    def M_room_cad(self) -> NDArray[np.float64]:
        """(4,4) float64: CAD frame → room, with the CAD's scale."""
        matrix = np.eye(4)
        turn = R_canonical_cad(self.cad.class_name)
        matrix[:3, :3] = portable.product(self.R_room_object, turn) * self.cad.scale
        matrix[:3, 3] = self.centre
        return matrix

    def footprint(self, margin_m: float = 0.0) -> NDArray[np.float64]:
        """(4,2) corners of the box seen from above, widened by a margin."""
        x, y = self.cad.size_m[:2] / 2 + margin_m
        corners = np.array([[-x, -y], [x, -y], [x, y], [-x, y]])
        return portable.product(corners, self.R_room_object[:2, :2].T) + self.centre[:2]

    @property
    def top_m(self) -> float:
        """Height of the box's top."""
        return float(self.centre[2] + self.cad.size_m[2] / 2)


@dataclass(frozen=True)
class Room:
    """A furnished room; ``size_m`` is its (width, depth)."""

    room_type: str
    size_m: tuple[float, float]
    pieces: tuple[Piece, ...]


def furnish(index: int, seed: int) -> Room:
    """Room ``index``: its type by turns, everything else keyed by (seed, index).

    A room in which a piece of ``always`` finds no free place is begun anew, up to 20 times; one of
    ``maybe`` is left out.
    """
    name = list(ROOM_TYPES)[index % len(ROOM_TYPES)]
    kind = ROOM_TYPES[name]
    for attempt in range(ATTEMPTS):
        rng = generator(seed, "rooms", "layout", index, attempt)
        size = float(rng.uniform(*kind.width_m)), float(rng.uniform(*kind.depth_m))
        more = [c for c, chance in kind.maybe.items() if rng.random() < chance]
        # What every such room has comes first; along the walls, then in the middle, then on top.
        order = [c for part in (kind.always, more) for c in sorted(part, key=_turn)]
        room, complete = Room(name, size, ()), True
        for n, class_name in enumerate(order):
            cad = make_cad(class_name, index * 100 + n, seed)
            piece = _place(cad, room, rng)
            if piece is not None:
                room = Room(name, size, (*room.pieces, piece))
            complete &= piece is not None or n >= len(kind.always)
        if complete:
            break
    return room


def _turn(class_name: str) -> int:
    return ("wall", "floor", "top").index(KINDS[class_name].place)


def _place(cad: Cad, room: Room, rng: np.random.Generator) -> Piece | None:
    place = KINDS[cad.class_name].place
    if place == "top":
        return _on_top(cad, room, rng)
    area = room.size_m[0] * room.size_m[1]
    covered = sum(np.prod(p.cad.size_m[:2]) for p in room.pieces if p.centre[2] < p.top_m)
    if covered + np.prod(cad.size_m[:2]) > MAX_COVER * area:
        return None
    for _ in range(TRIES):
        piece = (_at_wall if place == "wall" else _on_floor)(cad, room, rng)
        if _inside(piece, room) and not any(collide(piece, p) for p in room.pieces):
            return piece
    return None


def _turned(class_name: str, towards: NDArray, yaw: float) -> NDArray[np.float64]:
    """The turn about z that brings the class's front to a horizontal direction, and yaw more."""
    (x, y), (u, v) = _DIRECTIONS[FRONT[class_name]], towards
    length = math.hypot(u, v) or 1.0
    cosine, sine = (x * u + y * v) / length, (x * v - y * u) / length
    facing = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]])
    return portable.product(portable.axis_rotation("z", yaw), facing)


def _standing_height(cad: Cad) -> float:
    height = float(cad.size_m[2])
    hangs = cad.class_name == "sink" and height < 0.6 * SINK_RIM_M
    return SINK_RIM_M - height / 2 if hangs else height / 2


def _at_wall(cad: Cad, room: Room, rng: np.random.Generator) -> Piece:
    wall = int(rng.integers(4))
    inward = np.array([(1.0, 0), (-1.0, 0), (0, 1.0), (0, -1.0)][wall])
    R = _turned(cad.class_name, inward, rng.uniform(-YAW_JITTER, YAW_JITTER) / 2)
    # Half extent of the turned footprint.
    reach = (np.abs(R[:2, :2]) * cad.size_m[:2]).sum(axis=1) / 2
    along = rng.uniform(0, 1, 2) * room.size_m
    gap = rng.uniform(*WALL_GAP_M)
    near = np.where(inward > 0, reach + gap, np.array(room.size_m) - reach - gap)
    xy = np.where(inward != 0, near, along)
    return Piece(cad, R, np.array([*xy, _standing_height(cad)]))


def _on_floor(cad: Cad, room: Room, rng: np.random.Generator) -> Piece:
    xy = rng.uniform(0, 1, 2) * room.size_m
    R = portable.axis_rotation("z", rng.uniform(-np.pi, np.pi))
    hosts = [p for p in room.pieces if p.cad.class_name in ("table", "desk")]
    if cad.class_name == "chair" and hosts:
        # Chairs face a table or a desk.
        host = hosts[int(rng.integers(len(hosts)))]
        R = _turned("chair", host.centre[:2] - xy, rng.uniform(-4, 4) * YAW_JITTER)
    elif cad.class_name == "table":
        yaw = rng.integers(4) * np.pi / 2 + rng.uniform(-2, 2) * YAW_JITTER
        R = portable.axis_rotation("z", yaw)
    return Piece(cad, R, np.array([*xy, _standing_height(cad)]))


def _on_top(cad: Cad, room: Room, rng: np.random.Generator) -> Piece | None:
    """On a flat part of a support, front the same way as its front; None when none has room."""
    hosts = [p for name in SUPPORTS for p in room.pieces if p.cad.class_name == name]
    for host in hosts:
        R_host = host.R_room_object[:2, :2]
        forward = portable.apply(R_host, _DIRECTIONS[FRONT[host.cad.class_name]])
        M = host.M_room_cad
        samples = sample_surface(host.cad.mesh, SURFACE_SAMPLES, rng)
        surface = portable.product(samples, M[:3, :3].T) + M[:3, 3]
        for _ in range(TRIES // 10):
            local = rng.uniform(-0.4, 0.4, 2) * host.cad.size_m[:2]
            xy = host.centre[:2] + portable.apply(R_host, local)
            R = _turned(cad.class_name, forward, rng.uniform(-YAW_JITTER, YAW_JITTER))
            height = _support_height(portable.product(surface - [*xy, 0], R), cad)
            if height is None:
                continue
            piece = Piece(cad, R, np.array([*xy, height + cad.size_m[2] / 2]))
            if not any(collide(piece, p) for p in room.pieces if p is not host):
                return piece
    return None


def _support_height(surface: NDArray, cad: Cad) -> float | None:
    """The height at which a piece rests on (n,3) surface points about its middle; None if uneven.

    Its footprint is cut into 4 × 4 cells: the highest point of every cell must be within 3 cm of
    the highest of all.
    """
    cell = np.floor((surface[:, :2] / cad.size_m[:2] + 0.5) * 4).astype(np.int64)
    under = ((cell >= 0) & (cell < 4)).all(axis=1)
    highest = np.full(16, -np.inf)
    np.maximum.at(highest, cell[under] @ (4, 1), surface[under, 2])
    return float(highest.max()) if highest.min() > highest.max() - 0.03 else None


def _inside(piece: Piece, room: Room) -> bool:
    corners = piece.footprint()
    return bool((corners >= 0.02).all() and (corners <= np.array(room.size_m) - 0.02).all())


def collide(a: Piece, b: Piece) -> bool:
    """Whether two boxes come nearer than the clearance from above and overlap in height.

    Separating axes of two upright boxes: the four directions of their sides, and z.
    """
    za, zb = a.cad.size_m[2] / 2, b.cad.size_m[2] / 2
    if abs(a.centre[2] - b.centre[2]) >= za + zb - 1e-6:
        return False
    pa, pb = a.footprint(CLEARANCE_M / 2), b.footprint(CLEARANCE_M / 2)
    axes = np.concatenate([a.R_room_object[:2, :2].T, b.R_room_object[:2, :2].T])
    spans_a, spans_b = portable.product(pa, axes.T), portable.product(pb, axes.T)
    apart = (spans_a.max(axis=0) < spans_b.min(axis=0)) | (
        spans_b.max(axis=0) < spans_a.min(axis=0)
    )
    return not bool(apart.any())
