"""A furnished room as a scan: depth images along a walk, fused into a mesh with labels.

Depth is drawn by ``rooms.raster`` and fused by Open3D's TSDF grid. The grid's hash map hands its
surface out in an order that depends on threads; `_canonical` sorts it, so that a scan is the same
bits for any number of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from partialbench.errors import InputError, PartialbenchError
from partialbench.geometry import portable
from renderers.rooms.layout import WALL_HEIGHT_M, Room
from renderers.rooms.owners import nearest_surface
from renderers.rooms.raster import depth_image
from renderers.rooms.trajectory import Frame
from renderers.sensors import Sensor

WIDTH_PX, HEIGHT_PX, FOCAL_PX = 320, 240, 289.0
"""ScanNet's depth camera (640×480, focal 578 px) at half resolution."""
VOXEL_M = 0.025
TRUNCATION_VOXELS = 4.0
BLOCK_VOXELS = 8
MIN_WEIGHT = 2.0
"""A voxel that fewer frames have seen gives no surface."""
FARTHEST_M = 4.5
LABEL_RADIUS_M = 0.05
"""A vertex farther than this from every true surface is noise: it stays unlabelled."""
NOTHING, WALL, FLOOR = -3, -2, -1


@dataclass(frozen=True)
class Scan:
    """A fused room, room frame, metres.

    Attributes:
        vertices: (n,3) float32.
        faces: (f,3) int32.
        piece: (n,) int64 index of the piece a vertex lies on, or WALL, FLOOR, or NOTHING.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    piece: NDArray[np.int64]


def scan(room: Room, frames: list[Frame], sensor: Sensor, rng: np.random.Generator) -> Scan:
    """What a sensor sees of a room along a walk.

    Args:
        sensor: measures z-depth in metres.

    Raises:
        PartialbenchError: Open3D cannot be imported (the message names what it lacks).
        InputError: the frames see nothing.
    """
    o3d = import_open3d()
    surfaces, owner = _surfaces(room)
    corners = np.concatenate(surfaces)
    K = np.array([[FOCAL_PX, 0, WIDTH_PX / 2], [0, FOCAL_PX, HEIGHT_PX / 2], [0, 0, 1.0]])
    # Open3D's fusion counts pixel centres from 0, we from 0.5.
    K_fusion = o3d.core.Tensor(K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    grid = o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight"),
        attr_dtypes=(o3d.core.float32, o3d.core.float32),
        attr_channels=((1), (1)),
        voxel_size=VOXEL_M,
        block_resolution=BLOCK_VOXELS,
        block_count=10_000,
    )
    for frame in frames:
        T = frame.T_camera_room
        in_camera = portable.product(corners.reshape(-1, 3), T[:3, :3].T) + T[:3, 3]
        exact = depth_image(in_camera.reshape(-1, 3, 3), FOCAL_PX, WIDTH_PX, HEIGHT_PX)
        depth = sensor.apply(exact, K, rng)
        if not depth.any():
            continue
        image = o3d.t.geometry.Image(o3d.core.Tensor(depth))
        pose = o3d.core.Tensor(frame.T_tracked)
        seen = (1.0, FARTHEST_M, TRUNCATION_VOXELS)
        blocks = grid.compute_unique_block_coordinates(image, K_fusion, pose, *seen)
        grid.integrate(blocks, image, K_fusion, pose, *seen)
    if grid.hashmap().size() == 0:
        raise InputError("the walk through the room sees nothing")
    mesh = grid.extract_triangle_mesh(MIN_WEIGHT)
    vertices, faces = _canonical(
        mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy().astype(np.int64)
    )
    nearest = nearest_surface(o3d, vertices, surfaces, LABEL_RADIUS_M)
    return Scan(vertices, faces, np.append(owner, NOTHING)[nearest])


def import_open3d() -> ModuleType:
    """Open3D, or a PartialbenchError that says which packages it lacks."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise PartialbenchError(
            f"simulating rooms needs Open3D, which does not import here ({error}). Its wheel needs "
            f"system libraries that slim machines lack: on Debian and Ubuntu, "
            f"'apt-get install libgl1 libegl1 libx11-6 libusb-1.0-0 libgomp1'"
        ) from error
    return open3d


def _surfaces(room: Room) -> tuple[list[NDArray[np.float64]], NDArray[np.int64]]:
    """Triangles (f,3,3) of the floor, of each wall's inner side, of every piece; whose each is."""
    width, depth = room.size_m
    x, y, z = np.diag([width, depth, WALL_HEIGHT_M])
    corner = np.zeros(3)
    shell = [(corner, x, y), (corner, y, z), (x, y, z), (corner, x, z), (y, x, z)]
    surfaces = [np.array([[o, o + u, o + u + v], [o, o + u + v, o + v]]) for o, u, v in shell]
    for piece in room.pieces:
        M = piece.M_room_cad
        vertices = portable.product(piece.cad.mesh.vertices, M[:3, :3].T) + M[:3, 3]
        surfaces.append(vertices[piece.cad.mesh.faces])
    return surfaces, np.array([FLOOR, *[WALL] * 4, *range(len(room.pieces))])


def _canonical(vertices: NDArray, faces: NDArray) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """The same surface in an order of its own: vertices by x, y, z, faces by their vertices."""
    unique, inverse = np.unique(vertices.astype(np.float32), axis=0, return_inverse=True)
    corners = inverse.reshape(-1)[faces]
    a, b, c = corners.T
    corners = corners[(a != b) & (b != c) & (c != a)]
    # Each face begins with its least vertex and keeps its winding.
    start = corners.argmin(axis=1)[:, None]
    corners = np.take_along_axis(corners, (start + np.arange(3)) % 3, axis=1)
    return unique, np.unique(corners, axis=0).astype(np.int32)
