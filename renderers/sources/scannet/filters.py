"""The rules that stand for the paper's filtering by hand, as numbers.

"We manually filter out samples containing too many outliers, too few observed points, and the
mislabeled ones" (paper, section 5.1). An instance is judged once, a view after hidden point
removal. Every rejection carries the rule's phrase and the values that broke it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from partialbench.dataset.sources import FEW_POINTS as FEW_POINTS  # instances are judged by it
from partialbench.dataset.sources import RejectedView
from partialbench.errors import InputError
from partialbench.registry import close_matches

OUTSIDE = "too many outliers: points outside the CAD's box"
MISFIT = "the CAD's box does not fit the points in it"
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
        max_outside: at most this share of an object lies beyond the margin, or in dropped pieces.
        max_misfit: how far the extent of an instance's points may be from its CAD's box, as
            ``instances.box_misfit`` gives it: share of the box's half extent.
        max_shear: off-diagonal share of the CAD's stretch above which its pose is no rotation.
        min_agreement: at least this share of the labelled points in the box (walls, floor and
            ceiling aside) carries the class's label.
        min_visible: a view shows at least so many points; the builder holds it to that.
        isolated_neighbour, isolated_factor: a point is isolated when its distance to this
            neighbour is over so many times the median such distance of the view.
        max_isolated: at most this share of a view's points is isolated.
        max_back_facing: at most this share of a view's points belongs to surface that faces away
            from the camera, which hidden point removal let through.
        attempts: a view that breaks a rule is drawn again until it is the so-many-th.
        nearest_m, farthest_m: distance of a standing camera from the object's bounding sphere.
        lowest_m, highest_m: height above the floor at which it is held.
        min_sight: at least this share of the lines from a standing camera to the object's points
            is free of other surfaces of the scan.
    """

    margin_m: float = 0.08
    fragment_gap_m: float = 0.06
    min_fragment: float = 0.03
    min_points: int = 256
    max_outside: float = 0.3
    max_misfit: float = 0.25
    max_shear: float = 0.02
    min_agreement: float = 0.5
    min_visible: int = 128
    isolated_neighbour: int = 6
    isolated_factor: float = 4.0
    max_isolated: float = 0.05
    max_back_facing: float = 0.3
    attempts: int = 50
    nearest_m: float = 0.5
    farthest_m: float = 2.5
    lowest_m: float = 1.2
    highest_m: float = 1.8
    min_sight: float = 0.5

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            whole = isinstance(field.default, int)
            least = 1 if field.name in ("attempts", "isolated_neighbour", "min_visible") else 0
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if not (number and np.isfinite(value) and value >= least) or (
                whole and value != int(value)
            ):
                kind = "whole number" if whole else "number"
                raise InputError(
                    f"rule {field.name} must be a finite {kind} of at least {least}, got {value!r}"
                )
            if whole:
                object.__setattr__(self, field.name, int(value))
        if self.nearest_m > self.farthest_m or self.lowest_m > self.highest_m:
            raise InputError(
                f"rules nearest_m {self.nearest_m:g} and lowest_m {self.lowest_m:g} must not be "
                f"above farthest_m {self.farthest_m:g} and highest_m {self.highest_m:g}"
            )

    @classmethod
    def of(cls, given: Rules | Mapping[str, float] | None) -> Rules:
        """Rules as they are, or the default ones with the given thresholds.

        Raises:
            InputError: a rule of that name does not exist, or its value is out of range.
        """
        if isinstance(given, Rules):
            return given
        given = dict(given or {})
        known = [field.name for field in fields(cls)]
        if unknown := [name for name in given if name not in known]:
            raise InputError(f"no rule named {unknown[0]!r}{close_matches(unknown[0], known)}")
        return cls(**given)  # type: ignore[arg-type]

    def describe(self) -> dict[str, Any]:
        """The thresholds as JSON data."""
        return asdict(self)


def pieces(points: NDArray, edges: NDArray, gap_m: float) -> NDArray[np.int64]:
    """(n,) the number of the connected piece that each point belongs to.

    Args:
        points: (n,3) metres.
        edges: (e,2) pairs of points that the mesh joins; they hold a piece together however far
            apart a decimated mesh has put them.
        gap_m: points nearer than this are of one piece.
    """
    near = cKDTree(points).query_pairs(gap_m, output_type="ndarray")
    n, pairs = len(points), np.concatenate([near, edges])
    graph = coo_array((np.ones(len(pairs), np.bool_), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def in_large_pieces(points: NDArray, edges: NDArray, rules: Rules) -> NDArray[np.bool_]:
    """(n,) whether each point is in a piece of at least ``min_fragment`` of all; as ``pieces``."""
    piece = pieces(points, edges, rules.fragment_gap_m)
    return np.bincount(piece)[piece] >= rules.min_fragment * len(points)


def isolated_share(points: NDArray, rules: Rules) -> float:
    """The share of (n,3) points far from their ``isolated_neighbour``-th neighbour.

    0 for clouds too small to have one.
    """
    if len(points) <= rules.isolated_neighbour:
        return 0.0
    distance = cKDTree(points).query(points, k=[rules.isolated_neighbour + 1])[0][:, 0]
    return float((distance > rules.isolated_factor * np.median(distance)).mean())


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
    isolated = isolated_share(points, rules)
    if isolated > rules.max_isolated:
        return RejectedView(ISOLATED, {"share": round(isolated, 4), "maximum": rules.max_isolated})
    behind = back_facing_share(points, normals, viewpoint)
    if behind > rules.max_back_facing:
        return RejectedView(
            BACK_FACING, {"share": round(behind, 4), "maximum": rules.max_back_facing}
        )
    return None
