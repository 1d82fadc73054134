"""One view of one shape, without a data folder: what a notebook starts with."""

from __future__ import annotations

import dataclasses
from os import PathLike
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from partialbench import given, registry
from partialbench.dataset.rows import CANONICAL_PLACE, draw
from partialbench.dataset.seeding import generator
from partialbench.dataset.sources import RejectedView, View
from partialbench.errors import InputError
from partialbench.geometry.camera import Camera, sample_pose
from partialbench.geometry.rotations import is_rotation

if TYPE_CHECKING:
    import trimesh

FARTHEST = 300.0
"""From the camera, in object units: beyond, whether a point is hidden is lost in 32 bits."""

Pose = Literal["random", "aligned"] | tuple[ArrayLike, ArrayLike]


def render_view(
    shape: str | PathLike[str] | trimesh.Trimesh | ArrayLike,
    pose: Pose = "random",
    num_points: int | None = 1024,
    resolution: int = 256,
    sensor: str = "ideal",
    depth: bool = False,
    seed: int = 0,
    *,
    normals: bool = False,
    camera: Camera | None = None,
    up: str = "z",
) -> View:
    """What a depth camera sees of a mesh, or which points of a complete cloud are not hidden.

    The shape is moved and scaled into the unit ball about the origin first: the object frame.

    Args:
        shape: a mesh file (OFF, OBJ, PLY, STL, GLB, glTF, DAE), a ``trimesh.Trimesh``, a file of a
            complete cloud, or its (n,3) points; a ``trimesh.Scene`` is one shape.
        pose: "random" (uniform on SO(3), t as the paper draws it), "aligned" (as the shape stands,
            3.5 units in front of the camera), or (R_camera_object (3,3), t_camera_object (3,)),
            such as ``look_at`` gives; all of the unit ball in front of the camera plane.
        num_points: drawn without replacement; where fewer are seen, all of them first and repeats
            after. None for every point that is seen.
        resolution: side of the depth image in pixels (meshes only).
        sensor: what distorts the depth: "ideal", "kinect-v1", "tof", "stereo-d415",
            "stereo-kinect-v1", with ":STRENGTH" (meshes only).
        depth: keep the depth image (meshes only).
        seed: of the pose, the sensor's noise and the drawing.
        normals: with the surface normals of the points.
        camera: a fixed one instead of the crop fitted to the object; it may cut it (meshes only).
        up: the shape's upward axis, "z" or "y".

    Returns:
        A ``View``: ``points`` (num_points,3) float32 in the camera frame (x right, y down, z
        forward), ``R_camera_object``, ``t_camera_object``, ``K``, ``visible_fraction``,
        ``n_visible``, and on request ``depth`` (H,W) and ``normals``.

    Raises:
        InputError: what cannot be read, an option that a cloud does not take, or nothing to see.

    >>> import trimesh
    >>> box = trimesh.creation.box((1, 1, 1))
    >>> from partialbench.geometry.camera import look_at
    >>> view = render_view(box, look_at((0, -3, 0)), num_points=64, resolution=32)
    >>> view.points.shape, view.points.dtype, round(view.visible_fraction, 2)
    ((64, 3), dtype('float32'), 0.17)
    """
    if num_points is not None:
        num_points = given.whole_number(num_points, "num_points", 1)
    seed = given.whole_number(seed, "seed")
    depth, normals = given.truth(depth, "depth"), given.truth(normals, "normals")
    solid = registry.load(registry.READ_SHAPE)(shape, up)
    is_cloud = isinstance(solid, np.ndarray)
    asked = {"resolution": resolution, "sensor": sensor, "keep_depth": depth, "camera": camera}
    if is_cloud:
        defaults = {"resolution": 256, "sensor": "ideal", "keep_depth": False, "camera": None}
        if foreign := [name for name in asked if not _is(asked[name], defaults[name])]:
            raise InputError(
                f"{foreign[0].removeprefix('keep_')}={asked[foreign[0]]!r} does not apply: the "
                f"shape is a cloud, of which hidden points are removed; no image is formed"
            )
        asked = {}
    entry = registry.occluder_entry("hpr" if is_cloud else "mitsuba")
    occluder = registry.load(entry)(**asked, normals=normals)
    pair = _pose(pose, seed)
    _require_in_front(pair[1], camera)
    (view,) = occluder.views(solid, [pair], [generator(seed, "render_view", "occluder")])
    if isinstance(view, RejectedView):
        told = ", ".join(f"{name} {value}" for name, value in view.details.items())
        raise InputError(f"this pose shows nothing of the shape: {view.reason} ({told})")
    if num_points is None:
        return view
    chosen = draw(len(view.points), num_points, generator(seed, "render_view", "draw"))
    return dataclasses.replace(
        view,
        points=view.points[chosen],
        normals=None if view.normals is None else view.normals[chosen],
    )


def _is(value: Any, default: Any) -> bool:
    """Whether an option was left as it is; an array, which is compared by element, was not."""
    return np.ndim(value) == 0 and bool(value == default)


def _pose(pose: Any, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    if isinstance(pose, str):
        if pose == "random":
            return sample_pose(generator(seed, "render_view", "pose"))
        if pose == "aligned":
            return np.eye(3), CANONICAL_PLACE
        raise InputError(
            f"no pose {pose!r}{registry.close_matches(pose, ['random', 'aligned'])}; or give (R, t)"
        )
    try:
        R, t = pose
    except (TypeError, ValueError) as error:
        raise InputError(
            f"pose must be 'random', 'aligned' or (R (3,3), t (3,)), got {pose!r}"
        ) from error
    R = given.real_numbers(R, "R of the pose", "(3,3)")
    t = given.real_numbers(t, "t of the pose", "(3,)")
    if R.shape != (3, 3) or t.shape != (3,) or not is_rotation(R) or not np.isfinite(t).all():
        raise InputError(
            f"pose must be (R (3,3), t (3,)) with R a rotation, got shapes {R.shape} and "
            f"{t.shape}" + (f", det R = {np.linalg.det(R):g}" if R.shape == (3, 3) else "")
        )
    return R, t


def _require_in_front(t: NDArray[np.float64], camera: Camera | None) -> None:
    """Raises ``InputError`` where the camera is in the unit ball, or what it sees is uncertain.

    A fixed camera may cut the object: by its plane too.
    """
    if camera is None and not t[2] > 1:
        raise InputError(
            f"the object's centre is at z = {t[2]:g} in the camera frame, so its unit ball is not "
            f"all in front of the camera; z must exceed 1: move the eye away, or turn it round"
        )
    if (distance := float(np.linalg.norm(t))) > FARTHEST:
        raise InputError(
            f"the object is {distance:g} units away, {FARTHEST:g} at most can be rendered; it has "
            f"the size of the unit ball here, whatever its own: divide t by the object's radius"
        )
