from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from partialbench.dataset.categories import PS15
from partialbench.dataset.seeding import generator
from renderers.rooms.layout import ROOM_TYPES, Piece, Room, collide, furnish
from renderers.rooms.trajectory import BODY_M, HEIGHT_M, walk, walkable
from renderers.sources.scannet.scan2cad import FRONT


@pytest.fixture(scope="module")
def furnished() -> list[Room]:
    return [furnish(index, seed=3) for index in range(10)]


def sides(piece: Piece, points: np.ndarray) -> np.ndarray:
    """(n,) whether points (n,3) are inside the piece's box."""
    local = (points - piece.centre) @ piece.R_room_object
    return (np.abs(local) <= piece.cad.size_m / 2).all(axis=1)


def test_five_rooms_in_a_row_have_all_classes(furnished):
    for rooms in (furnished[:5], furnished[5:]):
        assert {p.cad.class_name for room in rooms for p in room.pieces} == set(PS15)


def test_every_room_has_what_its_type_always_has(furnished):
    for room in furnished:
        have = Counter(p.cad.class_name for p in room.pieces)
        assert have >= Counter(ROOM_TYPES[room.room_type].always)


def test_no_two_pieces_share_space(furnished):
    """By dense sampling, independently of the separating axes; a support may reach around what
    stands in front of its raised back."""
    rng = np.random.default_rng(0)
    unit = rng.uniform(-0.5, 0.5, (4000, 3))
    for room in furnished:
        for a in room.pieces:
            inside_a = unit * a.cad.size_m @ a.R_room_object.T + a.centre
            for b in room.pieces:
                stacked = {a.cad.class_name, b.cad.class_name} & {"monitor", "printer"}
                if a is not b and not stacked:
                    assert not sides(b, inside_a).any()


def test_collision_is_seen():
    room = furnish(0, seed=3)
    piece = room.pieces[0]
    beside = Piece(piece.cad, piece.R_room_object, piece.centre + [0.3, 0, 0])
    away = Piece(piece.cad, piece.R_room_object, piece.centre + [5, 0, 0])
    above = Piece(piece.cad, piece.R_room_object, piece.centre + [0, 0, piece.cad.size_m[2]])
    assert collide(piece, beside)
    assert not collide(piece, away)
    assert not collide(piece, above)


def test_pieces_stand_in_the_room_with_their_backs_to_the_wall(furnished):
    for room in furnished:
        for piece in room.pieces:
            corners = piece.footprint()
            assert (corners > 0).all()
            assert (corners < room.size_m).all()
            vertices = piece.cad.mesh.vertices @ piece.M_room_cad[:3, :3].T + piece.centre
            assert vertices[:, 2].min() > -1e-9
            if piece.cad.class_name in ("bed", "sofa", "stove", "toilet", "bookshelf"):
                front = {"-x": [-1.0, 0, 0], "-y": [0, -1.0, 0]}[FRONT[piece.cad.class_name]]
                ahead = (piece.R_room_object @ front)[:2]
                wall = np.abs(ahead).argmax()
                gap = corners[:, wall].min() if ahead[wall] > 0 else (
                    room.size_m[wall] - corners[:, wall].max())  # fmt: skip
                assert 0.02 < gap < 0.2


def test_what_stands_on_something_touches_it(furnished):
    for room in furnished:
        for piece in room.pieces:
            if piece.cad.class_name not in ("monitor", "printer"):
                continue
            bottom = piece.centre[2] - piece.cad.size_m[2] / 2
            assert bottom > 0.3
            heights = []
            for host in room.pieces:
                if host.cad.class_name in ("desk", "table", "dresser"):
                    M = host.M_room_cad
                    surface = host.cad.mesh.sample(20_000, seed=0) @ M[:3, :3].T + M[:3, 3]
                    local = (surface - piece.centre) @ piece.R_room_object
                    under = (np.abs(local[:, :2]) < piece.cad.size_m[:2] / 2).all(axis=1)
                    heights += surface[under, 2].tolist()
            assert abs(max(heights) - bottom) < 0.03


def test_walks_keep_clear_and_look_at_every_piece(furnished):
    for index, room in enumerate(furnished):
        frames = walk(room, generator(0, "walk", index))
        assert len(frames) >= 16 + 3 * len(room.pieces)
        eyes = np.stack([-f.T_camera_room[:3, :3].T @ f.T_camera_room[:3, 3] for f in frames])
        assert (eyes[:, 2] >= HEIGHT_M[0]).all()
        assert (eyes[:, 2] <= HEIGHT_M[1]).all()
        for piece in room.pieces:
            local = (eyes - piece.centre) @ piece.R_room_object
            clear = np.abs(local[:, :2]) > piece.cad.size_m[:2] / 2 + BODY_M - 1e-9
            assert clear.any(axis=1).all()
            seen = sum(_in_image(frame.T_camera_room, piece.centre) for frame in frames)
            assert seen >= 3


def _in_image(T: np.ndarray, point: np.ndarray) -> bool:
    x, y, z = T[:3, :3] @ point + T[:3, 3]
    return bool(z > 0 and abs(x / z) < 160 / 289 and abs(y / z) < 120 / 289)


def test_a_full_room_has_no_walk(furnished):
    piece = furnished[0].pieces[0]
    tiny = Room("bedroom", (0.6, 0.6), (Piece(piece.cad, np.eye(3), np.array([0.3, 0.3, 0.5])),))
    assert len(walkable(tiny)) == 0
    assert walk(tiny, generator(0)) == []
