"""The rules that stand for the paper's filtering by hand, as numbers.

"We manually filter out samples containing too many outliers, too few observed points, and the
mislabeled ones" (paper, section 5.1). An instance is judged once, a view after hidden point
removal. Every rejection carries the rule's phrase and the values that broke it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from partialbench.dataset.sources import FEW_POINTS as FEW_POINTS  # instances are judged by it
from partialbench.dataset.sources import RejectedView

ISOLATED_NEIGHBOUR = 6
"""A point is isolated when its distance to its 6th nearest neighbour is far above the median."""
ISOLATED_FACTOR = 4.0

OUTSIDE = "too many outliers: points outside the CAD's box"
FRAGMENTED = "too many outliers: loose fragments"
ISOLATED = "too many outliers: isolated points"
BACK_FACING = "too many outliers: surfaces seen from behind"
DISAGREEMENT = "label disagreement"


@dataclass(frozen=True)
class Rules:
    """Thresholds; each is an option of the source and enters the configuration.

    Attributes:
        margin_m: an instance's points lie within this distance of its CAD's box, metres.
        fragment_gap_m: points farther apart than this, and not joined by the mesh, are not of one
            piece, metres.
        min_fragment: a piece with less than this share of the points in the box belongs to
            something else and is dropped.
        min_points: an instance has at least so many.
        max_outside: at most this share of an instance lies beyond the margin (where an annotated
            object says what belongs to it) or in dropped pieces (where the label does).
        min_agreement: at least this share of the labelled points in the box (walls, floor and
            ceiling aside) carries the class's label.
        max_isolated: at most this share of a view's points is isolated.
        max_back_facing: at most this share of a view's points belongs to surface that faces away
            from the camera, which hidden point removal let through.
    """

    margin_m: float = 0.08
    fragment_gap_m: float = 0.06
    min_fragment: float = 0.03
    min_points: int = 256
    max_outside: float = 0.3
    min_agreement: float = 0.5
    max_isolated: float = 0.05
    max_back_facing: float = 0.3

    def describe(self) -> dict[str, Any]:
        """The thresholds as JSON data."""
        return asdict(self)


def in_large_pieces(points: NDArray, edges: NDArray, rules: Rules) -> NDArray[np.bool_]:
    """(n,) whether each point is in a piece of at least ``min_fragment`` of all.

    Args:
        points: (n,3) metres.
        edges: (e,2) pairs of points that the mesh joins; they hold a piece together however far
            apart a decimated mesh has put them.
    """
    near = cKDTree(points).query_pairs(rules.fragment_gap_m, output_type="ndarray")
    n, pairs = len(points), np.concatenate([near, edges])
    graph = coo_array((np.ones(len(pairs), np.bool_), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    piece = connected_components(graph, directed=False)[1]
    return np.bincount(piece)[piece] >= rules.min_fragment * n


def isolated_share(points: NDArray) -> float:
    """The share of (n,3) points whose 6th neighbour is over four times the median such distance.

    0 for clouds too small to have a 6th neighbour.
    """
    if len(points) <= ISOLATED_NEIGHBOUR:
        return 0.0
    distance = cKDTree(points).query(points, k=[ISOLATED_NEIGHBOUR + 1])[0][:, 0]
    return float((distance > ISOLATED_FACTOR * np.median(distance)).mean())


def back_facing_share(points: NDArray, normals: NDArray, viewpoint: NDArray) -> float:
    """The share of (n,3) points whose surface normal points away from the viewpoint (3,)."""
    return float((np.einsum("ij,ij->i", normals, viewpoint - points) < 0).mean())


def judge_view(
    points: NDArray, normals: NDArray, viewpoint: NDArray, rules: Rules
) -> RejectedView | None:
    """The first rule a view breaks, or None.

    Args:
        points, normals: (n,3) what hidden point removal kept, object frame.
        viewpoint: (3,) camera position in the same frame.
    """
    isolated = isolated_share(points)
    if isolated > rules.max_isolated:
        return RejectedView(ISOLATED, {"share": round(isolated, 4), "maximum": rules.max_isolated})
    behind = back_facing_share(points, normals, viewpoint)
    if behind > rules.max_back_facing:
        return RejectedView(
            BACK_FACING, {"share": round(behind, 4), "maximum": rules.max_back_facing}
        )
    return None
