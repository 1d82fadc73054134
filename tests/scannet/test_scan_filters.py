from __future__ import annotations

import numpy as np
import pytest

from renderers.sources.scannet import filters
from renderers.sources.scannet.filters import (
    Rules,
    back_facing_share,
    in_large_pieces,
    isolated_share,
    judge_view,
)


def grid(count: int = 20, step: float = 0.05) -> np.ndarray:
    """A square sheet at z = 0, (count², 3)."""
    x, y = np.meshgrid(np.arange(count) * step, np.arange(count) * step)
    return np.stack([x.ravel(), y.ravel(), np.zeros(count * count)], axis=1)


APART = np.zeros((0, 2), int)
UP = np.array([[0.0, 0, 1]])


def test_isolated_points_are_counted():
    far = np.array([[5.0, 0, 0], [0, 6, 0], [0, 0, 7], [8, 8, 8]])
    assert isolated_share(grid(), Rules()) == 0
    assert isolated_share(np.concatenate([grid(), far]), Rules()) == pytest.approx(4 / 404)
    assert isolated_share(far, Rules()) == 0  # too few for a neighbourhood


def test_small_pieces_are_dropped():
    """Of 400 + 8 + 30 points, 3 % is 13: the 8 go, the 30 stay."""
    small = grid()[:8] + np.array([3, 0, 0])
    large = grid()[:30] + np.array([0, 0, 3])
    kept = in_large_pieces(np.concatenate([grid(), small, large]), APART, Rules())
    np.testing.assert_array_equal(kept, np.repeat([True, False, True], [400, 8, 30]))


def test_a_gap_below_the_limit_does_not_part_a_piece():
    near = np.concatenate([grid(), grid()[:8] + np.array([1.0, 0, 0])])
    assert in_large_pieces(near, APART, Rules()).all()


def test_a_mesh_edge_holds_a_piece_together():
    """Eight points 3 m away, in a row of edges that reaches the sheet, stay."""
    tail = grid()[:8] + np.array([3, 0, 0])
    chain = np.stack([np.arange(399, 407), np.arange(400, 408)], axis=1)
    points = np.concatenate([grid(), tail])
    assert in_large_pieces(points, chain, Rules()).all()
    assert in_large_pieces(points, chain[1:], Rules()).sum() == 400


def test_surfaces_seen_from_behind():
    normals = np.repeat(UP, 400, axis=0)
    assert back_facing_share(grid(), normals, np.array([0.5, 0.5, 2])) == 0
    assert back_facing_share(grid(), normals, np.array([0.5, 0.5, -2])) == 1


@pytest.mark.parametrize(
    ("points", "normals", "eye", "reason"),
    [
        (grid(), np.repeat(UP, 400, axis=0), (0, 0, 2), None),
        (grid(), np.repeat(UP, 400, axis=0), (0, 0, -2), filters.BACK_FACING),
        (
            np.concatenate([grid(), np.arange(90).reshape(30, 3) + 5.0]),
            np.repeat(UP, 430, axis=0),
            (0, 0, 200),
            filters.ISOLATED,
        ),
    ],
)
def test_each_rule_turns_away_its_own_case(points, normals, eye, reason):
    rejected = judge_view(points, normals, np.array(eye, float), Rules())
    assert (rejected.reason if rejected else None) == reason
    if rejected:
        assert "maximum" in rejected.details
