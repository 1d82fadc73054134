"""Hidden point removal of a scanned instance, and the rules that judge each view of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.sources import RejectedView, View
from renderers.hpr import HprOccluder, hidden_point_removal, paper_radius
from renderers.normals import towards_camera, unit_normals
from renderers.sources.scannet.filters import Rules, judge_view
from renderers.sources.scannet.reader import ScanInstance

SCAN_GAMMA = 2.5
"""Best F against ray casting on scans (docs/ps15.md), which have more points to an object than the
clouds that ``hpr.DEFAULT_GAMMA`` is for."""


class ScanHprOccluder:
    """An ``Occluder`` for `ScanInstance`: HPR of its points, then ``filters.judge_view``.

    Args:
        gamma, radius: size of HPR's sphere, as ``hpr.HprOccluder`` takes them; gamma is
            ``SCAN_GAMMA`` where neither is given.
        rules: thresholds, as ``filters.Rules.of`` takes them; the views' own are used.
        normals: whether views have the normals of the scan's mesh.

    Attributes:
        attempts: how often the builder draws a view before it is given up.
        min_visible: points a view shows at least, for the builder.

    Raises:
        InputError: gamma and radius are both given, or one is out of range.
    """

    def __init__(
        self,
        gamma: float | None = None,
        radius: float | None = None,
        rules: Rules | Mapping[str, float] | None = None,
        normals: bool = False,
    ) -> None:
        gamma = SCAN_GAMMA if gamma is None and radius is None else gamma
        self.hpr = HprOccluder(gamma, radius)
        self.normals = normals
        self.rules = Rules.of(rules)
        self.attempts = self.rules.attempts
        self.min_visible = self.rules.min_visible

    def views(
        self,
        shape: ScanInstance,
        poses: list[tuple[NDArray, NDArray]],
        rngs: list[np.random.Generator],
    ) -> list[View | RejectedView]:
        """One result per pose; hidden point removal draws nothing, ``rngs`` are not used."""
        normals = unit_normals(shape.normals, shape.points) if self.normals else None
        return [self._view(shape, np.asarray(R), np.asarray(t), normals) for R, t in poses]

    def describe(self) -> dict[str, Any]:
        """Method, radius and thresholds, as JSON data."""
        normals = {"normals": "of the scan's mesh"} if self.normals else {}
        rules = self.rules.describe()
        return {**self.hpr.describe(), "name": "scan-hpr", "rules": rules, **normals}

    def _view(
        self, shape: ScanInstance, R: NDArray, t: NDArray, normals: NDArray | None
    ) -> View | RejectedView:
        viewpoint = -R.T @ t
        radius = self.hpr.radius
        if radius is None:
            radius = paper_radius(shape.points, viewpoint, self.hpr.gamma)
        seen = hidden_point_removal(shape.points, viewpoint, radius)
        points = shape.points[seen].astype(np.float64)
        if rejected := judge_view(points, shape.normals[seen], viewpoint, self.rules):
            return rejected
        in_camera = (points @ R.T + t).astype(np.float32)
        return View(
            points=in_camera,
            R_camera_object=R,
            t_camera_object=t,
            K=np.zeros((3, 3)),
            visible_fraction=len(seen) / len(shape.points),
            n_visible=len(seen),
            normals=None if normals is None else towards_camera(normals[seen], in_camera, R),
            symmetry=shape.symmetry,
        )
