"""The way a person with a depth camera walks through a room."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from partialbench.geometry import portable
from renderers.rooms.layout import Room
from renderers.viewpoints import look_at

STEP_M = 0.2
WALL_MARGIN_M = 0.25
BODY_M = 0.15
"""Nobody walks nearer to a piece of furniture."""
HEIGHT_M = (1.25, 1.75)
RANGE_M = (0.9, 3.5)
"""Distances from which a piece is looked at."""
FRAMES_PER_PIECE = 5
PANORAMA_FRAMES = 16
TRACKING_SIGMA_M, TRACKING_SIGMA = 0.002, np.deg2rad(0.1)
"""Error of the poses that the fusion is given, per axis."""


@dataclass(frozen=True)
class Frame:
    """One camera of the walk.

    Attributes:
        T_camera_room: (4,4) float64, where the camera is.
        T_tracked: (4,4) float64, where the tracking says it is.
    """

    T_camera_room: NDArray[np.float64]
    T_tracked: NDArray[np.float64]


def walkable(room: Room) -> NDArray[np.float64]:
    """(k,2) places on a grid that are clear of walls and furniture."""
    x, y = (np.arange(WALL_MARGIN_M, size - WALL_MARGIN_M, STEP_M) for size in room.size_m)
    places = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    free = np.ones(len(places), np.bool_)
    for piece in room.pieces:
        local = portable.product(places - piece.centre[:2], piece.R_room_object[:2, :2])
        free &= (np.abs(local) > piece.cad.size_m[:2] / 2 + BODY_M).any(axis=1)
    return places[free]


def walk(room: Room, rng: np.random.Generator) -> list[Frame]:
    """Frames from which every piece is seen from several sides, in the order of a short walk.

    Each piece is looked at from five places spread in direction as far as the room allows; sixteen
    more frames look around from the freest place. Without a free place the walk is empty.
    """
    places = walkable(room)
    if len(places) == 0:
        return []
    looks: list[tuple[NDArray, NDArray]] = []
    for piece in room.pieces:
        for place in _around(places, piece.centre[:2], rng):
            spread = rng.uniform(-0.15, 0.15, 3) * piece.cad.size_m
            looks.append((np.array([*place, rng.uniform(*HEIGHT_M)]), piece.centre + spread))
    middle = np.array(room.size_m) / 2
    stand = places[np.linalg.norm(places - middle, axis=1).argmin()]
    turns = np.arange(PANORAMA_FRAMES) * 2 * np.pi / PANORAMA_FRAMES
    for east, north in zip(*portable.cosine_sine(turns), strict=True):
        eye = np.array([*stand, rng.uniform(*HEIGHT_M)])
        ahead = np.array([east, north, -0.45 if len(looks) % 2 else -0.15])
        looks.append((eye, eye + ahead))
    return [_frame(*looks[i], rng) for i in _short_walk(np.stack([eye for eye, _ in looks]))]


def _around(places: NDArray, target: NDArray, rng: np.random.Generator) -> NDArray[np.float64]:
    """Up to five places around a target, each as far as possible in direction from the others."""
    offset = places - target
    distance = np.linalg.norm(offset, axis=1)
    allowed = np.flatnonzero((distance > RANGE_M[0]) & (distance < RANGE_M[1]))
    if len(allowed) == 0:
        allowed = np.array([np.abs(distance - RANGE_M[0]).argmin()])
    direction = offset[allowed] / distance[allowed, None]
    chosen = [int(rng.integers(len(allowed)))]
    while len(chosen) < min(FRAMES_PER_PIECE, len(allowed)):
        nearest = portable.product(direction, direction[chosen].T).max(axis=1)
        chosen.append(int((nearest + rng.uniform(0, 0.2, len(allowed))).argmin()))
    return places[allowed[chosen]]


def _short_walk(eyes: NDArray) -> list[int]:
    """Indices in the order of always going on to the nearest next place."""
    order, left = [0], set(range(1, len(eyes)))
    while left:
        here = eyes[order[-1]]
        nearest = min(left, key=lambda i: (math.dist(eyes[i], here), i))
        order.append(nearest)
        left.remove(nearest)
    return order


def _frame(eye: NDArray, target: NDArray, rng: np.random.Generator) -> Frame:
    true = np.eye(4)
    roll = portable.axis_rotation("z", rng.normal(0, np.deg2rad(2.0)))
    true[:3, :3] = portable.product(roll, look_at(eye, target))
    true[:3, 3] = -portable.apply(true[:3, :3], eye)
    error = np.eye(4)
    for axis, angle in zip("xyz", rng.normal(0, TRACKING_SIGMA, 3), strict=True):
        error[:3, :3] = portable.product(portable.axis_rotation(axis, angle), error[:3, :3])
    error[:3, 3] = rng.normal(0, TRACKING_SIGMA_M, 3)
    return Frame(true, portable.product(error, true))
