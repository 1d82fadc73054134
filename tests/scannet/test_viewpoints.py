from __future__ import annotations

import numpy as np
import pytest

from partialbench.geometry.rotations import is_rotation
from renderers.viewpoints import (
    CAMERA_HEIGHT_M,
    CELL_M,
    look_at,
    places_for,
    standing_places,
    standing_pose,
)


def room() -> tuple[np.ndarray, np.ndarray]:
    """A 4 × 3 m floor at height 0.2, a table 0.7 m high over x < 1, a lamp shade at 2.3 m."""
    x, y = np.meshgrid(np.arange(0.02, 4, 0.05), np.arange(0.02, 3, 0.05))
    floor = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.2)], axis=1)
    table = floor[floor[:, 0] < 1] + [0, 0, 0.7]
    shade = floor[floor[:, 0] > 3.5] + [0, 0, 2.3]
    rug = floor[floor[:, 1] < 0.5] + [0, 0, 0.02]
    vertices = np.concatenate([floor, table, shade, rug])
    return vertices, np.arange(len(vertices)) < len(floor)


def test_people_stand_on_free_floor_only():
    places, floor_z = standing_places(*room())
    assert floor_z == pytest.approx(0.2)
    assert len(places) == 12 * 12  # 3 m of free width, all of the depth, in cells of 0.25 m
    assert (places[:, 0] > 1).all()
    assert (places[:, 0] < 4).all()
    assert (places[:, 1] > 0).all()
    assert (places[:, 1] < 3).all()


def test_without_floor_nobody_stands():
    vertices, _ = room()
    places, floor_z = standing_places(vertices, np.zeros(len(vertices), bool))
    assert places.shape == (0, 2)
    assert floor_z == pytest.approx(0.2, abs=0.01)


def test_places_are_at_a_natural_distance():
    places, floor_z = standing_places(*room())
    centre, radius = np.array([0.5, 1.5, 0.6]), 0.6
    near = places_for(places, floor_z, centre, radius)
    assert 0 < len(near) < len(places)
    distance = np.hypot(np.linalg.norm(near - centre[:2], axis=1), 0.2 + 1.5 - 0.6)
    assert distance.min() >= radius + 0.5
    assert distance.max() <= radius + 2.5


def test_the_camera_is_held_at_a_place_and_sees_the_object(rng):
    places, floor_z = standing_places(*room())
    centre, radius = np.array([0.5, 1.5, 0.6]), 0.6
    near = places_for(places, floor_z, centre, radius)
    positions = []
    for _ in range(200):
        R, position = standing_pose(rng, near, floor_z, centre, radius)
        assert is_rotation(R, 1e-12)
        x, y, z = R @ (centre - position)
        assert z > radius  # in front of the camera, and the camera outside the object
        assert np.hypot(x, y) / z < 0.5
        assert R[1, 2] < -0.2  # the image's down is the room's down
        across = np.abs(near - position[:2]).max(axis=1).min()
        assert across <= CELL_M / 2 + 1e-12
        assert floor_z + CAMERA_HEIGHT_M[0] <= position[2] <= floor_z + CAMERA_HEIGHT_M[1]
        positions.append(position)
    assert np.ptp(positions, axis=0).min() > 0.5


@pytest.mark.parametrize("target", [(3, 0, 0), (-1, 2, -1), (0, 0, 5), (0, 0, -5)])
def test_look_at_puts_the_target_on_the_axis(target):
    eye = np.array([0.3, -0.2, 0.1])
    R = look_at(eye, eye + target)
    assert is_rotation(R, 1e-12)
    np.testing.assert_allclose(R @ target, [0, 0, np.linalg.norm(target)], atol=1e-12)


def test_look_at_is_level():
    R = look_at(np.zeros(3), np.array([2.0, 1.0, -1.0]))
    assert R[0, 2] == 0  # image right is horizontal
    assert R[1, 2] < 0  # image down is down
