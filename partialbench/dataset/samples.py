"""Rows of a data folder as pictures show them: the cloud about its object, from one side.

Shared by ``show`` and by the pages of the leaderboard. A scene's points are in the camera frame
(x right, y down, z forward) about the object's centre, scaled so that all lie in the unit ball.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.loader import ShardDataset
from partialbench.dataset.whole import whole_objects

YAW, PITCH = 0.5, 0.3
"""From where a scene is first seen, radians: seen from its camera a cloud hides its own depth."""
_CAMERA = 1.3
"""How far from the centre the camera is drawn; it stands further away."""


@dataclass(frozen=True)
class Scene:
    """One row.

    Attributes:
        points: (n,3). whole: (m,3) of the whole object's surface, m = 0 where it is not at hand.
        axes: (3,3) the object's canonical axes, one a row.
        camera: (8,2,3) line segments that draw a camera where the row's is, looking at the centre;
            (0,2,3) where the row has no camera.
    """

    points: NDArray[np.float64]
    whole: NDArray[np.float64]
    axes: NDArray[np.float64]
    camera: NDArray[np.float64]


def scenes(data: ShardDataset, rows: Sequence[int], whole_points: int) -> list[Scene]:
    """The scenes of some rows, with as many points as ``data`` gives."""
    names = [str(data.object_ids[row]) for row in rows]
    wholes = whole_objects(data.folder, data.split, names, whole_points) if len(rows) else {}
    found = []
    for row, name in zip(rows, names, strict=True):
        points, rotation = data.points([row])[0].astype(float), data.rotations[row]
        centre = data.translations[row]
        has_camera = bool(centre[2] > 0)  # whole clouds, and releases without translations
        whole = wholes[name] @ rotation.T if name in wholes else np.zeros((0, 3))
        points = points - (centre if has_camera else points.mean(axis=0))
        size = max(1e-9, *np.linalg.norm(np.concatenate([points, whole]), axis=1))
        camera = _camera(centre) if has_camera else np.zeros((0, 2, 3))
        found.append(Scene(points / size, whole / size, rotation.T, camera))
    return found


def packed(points: NDArray) -> str:
    """(n,3) in [−1.27, 1.27] as base64 of bytes, hundredths from 128: what viewer.js decodes."""
    bytes_ = np.clip(np.round(points * 100) + 128, 0, 255).astype(np.uint8)
    return base64.b64encode(bytes_.tobytes()).decode()


def projected(points: NDArray, yaw: float = YAW, pitch: float = PITCH) -> NDArray[np.float64]:
    """(…,3) → (…,3): right, down, and away from who looks; as viewer.js does it."""
    x, y, z = np.moveaxis(points, -1, 0)
    right, away = np.cos(yaw) * x + np.sin(yaw) * z, -np.sin(yaw) * x + np.cos(yaw) * z
    return np.stack(
        [right, np.cos(pitch) * y - np.sin(pitch) * away, np.sin(pitch) * y + np.cos(pitch) * away],
        axis=-1,
    )


def _camera(centre: NDArray) -> NDArray[np.float64]:
    """The edges of a small pyramid: its apex is the camera, its base what it looks through."""
    apex = -_CAMERA * centre / np.linalg.norm(centre)
    corners = apex + 0.16 * np.array(
        [(-1, -0.75, 1.5), (1, -0.75, 1.5), (1, 0.75, 1.5), (-1, 0.75, 1.5)]
    )
    edges = [(apex, corner) for corner in corners]
    return np.array([*edges, *zip(corners, np.roll(corners, -1, axis=0), strict=True)])
