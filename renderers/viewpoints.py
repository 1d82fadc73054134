"""Where a camera may be: at a place in a scanned room where a person could stand.

A place is a cell of the floor plan that shows floor and has nothing in it between a person's shins
and head. The camera is held at chest to eye height there, looks at the object, and is not quite
level.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from partialbench.geometry import portable

CELL_M = 0.25
MIN_FLOOR_VERTICES = 3
MAX_OBSTACLE_VERTICES = 4
OBSTACLE_M = (0.15, 1.9)
"""Heights above the floor between which a place must be free."""
CAMERA_HEIGHT_M = (1.2, 1.8)
DISTANCE_M = (0.5, 2.5)
"""Distance of the place from the object's bounding sphere, measured to its centre at mid height."""
AIM_SPREAD = 0.2
"""The camera aims at a point within this share of the object's radius from its centre, per axis."""
ROLL_SPREAD = np.deg2rad(5.0)


def standing_places(
    vertices: NDArray, is_floor: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], float]:
    """Places where a person could stand in a scan.

    Args:
        vertices: (n,3) scan frame, metres, z up.
        is_floor: (n,) which of them are floor.

    Returns:
        (k,2) x, y of the free floor cells' centres in row-major order of the grid, and the floor's
        height. Without any floor vertex: no place, and the height of the lowest percentile.
    """
    if not is_floor.any():
        return np.zeros((0, 2)), float(np.percentile(vertices[:, 2], 1))
    floor_z = float(np.median(vertices[is_floor, 2]))
    height = vertices[:, 2] - floor_z
    obstacle = ~is_floor & (height > OBSTACLE_M[0]) & (height < OBSTACLE_M[1])
    cells = np.floor(vertices[:, :2] / CELL_M).astype(np.int64)
    low = cells.min(axis=0)
    shape = tuple(cells.max(axis=0) - low + 1)
    flat = np.ravel_multi_index(tuple((cells - low).T), shape)
    size = shape[0] * shape[1]
    floor = np.bincount(flat[is_floor], minlength=size) >= MIN_FLOOR_VERTICES
    free = np.bincount(flat[obstacle], minlength=size) <= MAX_OBSTACLE_VERTICES
    places = np.stack(np.unravel_index(np.flatnonzero(floor & free), shape), axis=1)
    return (places + low + 0.5) * CELL_M, floor_z


def places_for(
    places: NDArray,
    floor_z: float,
    centre: NDArray,
    radius_m: float,
    height_m: tuple[float, float] = CAMERA_HEIGHT_M,
    distance_m: tuple[float, float] = DISTANCE_M,
) -> NDArray[np.float64]:
    """Those of the (k,2) places from which an object is at a natural distance: (j,2).

    Args:
        centre: (3,) of the object's bounding sphere, scan frame.
        radius_m: its radius; nobody stands nearer to it than the lesser ``distance_m``.
        height_m: between which the camera is held, above the floor.
    """
    eye_z = floor_z + sum(height_m) / 2
    across = np.linalg.norm(places - centre[:2], axis=1)
    distance = np.hypot(across, eye_z - centre[2])
    nearest, farthest = distance_m
    return places[(distance >= radius_m + nearest) & (distance <= radius_m + farthest)]


def standing_pose(
    rng: np.random.Generator,
    places: NDArray,
    floor_z: float,
    centre: NDArray,
    radius_m: float,
    height_m: tuple[float, float] = CAMERA_HEIGHT_M,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A hand-held camera at one of the (j,2) places.

    Returns:
        R_camera_scan (3,3) and the camera's position (3,) in the scan frame.
    """
    place = places[rng.integers(len(places))] + rng.uniform(-0.5, 0.5, 2) * CELL_M
    position = np.array([*place, floor_z + rng.uniform(*height_m)])
    target = centre + rng.uniform(-AIM_SPREAD, AIM_SPREAD, 3) * radius_m
    roll = rng.uniform(-ROLL_SPREAD, ROLL_SPREAD)
    return portable.product(portable.axis_rotation("z", roll), look_at(position, target)), position


def look_at(position: NDArray, target: NDArray) -> NDArray[np.float64]:
    """R_camera_world (3,3) of a level OpenCV camera at ``position`` that looks at ``target``.

    World z is up; looking straight up or down, the image's top is towards world +y or −y.
    """
    forward = np.asarray(target, np.float64) - position
    # ``hypot`` and not ``norm``, whose dot product follows the processor (``geometry.portable``).
    forward = forward / math.hypot(*forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    length = math.hypot(*right)
    right = right / length if length > 1e-9 else np.array([1.0, 0.0, 0.0])
    return np.stack([right, np.cross(forward, right), forward])
