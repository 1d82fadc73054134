"""Hidden point removal of a scanned instance, the rules that judge a view of it, occluders."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.others import POOL, Others, require_share
from partialbench.dataset.sources import RejectedView, View
from partialbench.errors import InputError
from renderers.hpr import HprOccluder, hidden_point_removal, paper_radius
from renderers.normals import towards_camera, unit_normals
from renderers.sources.scannet.filters import FEW_POINTS, Rules, judge_view
from renderers.sources.scannet.reader import ScanInstance
from renderers.sources.scannet.sight import spread

SCAN_GAMMA = 2.5
"""Best F against ray casting on scans (docs/ps15.md), which have more points to an object than the
clouds that ``hpr.DEFAULT_GAMMA`` is for."""
PLACED_BY = 256
"""Points of an object by which occluders are placed; what they hide is asked of every point."""


class ScanHprOccluder:
    """An ``Occluder`` for `ScanInstance`: HPR of its points, then ``filters.judge_view``.

    Args:
        gamma, radius: size of HPR's sphere, as ``hpr.HprOccluder`` takes them; gamma is
            ``SCAN_GAMMA`` where neither is given.
        rules: thresholds, as ``filters.Rules.of`` takes them; the views' own are used.
        normals: whether views have the normals of the scan's mesh.
        occluders: share of the points in view that other scanned objects hide, in the mean; see
            ``occlusion``. Rules judge a view before that, so that it has the pose that it has
            without them.
        variant: the Mitsuba variant by which occluders' surfaces are traced, as
            ``mitsuba_depth.MitsubaOccluder`` takes it; without occluders nothing is traced.

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
        occluders: float = 0.0,
        variant: str | None = None,
    ) -> None:
        gamma = SCAN_GAMMA if gamma is None and radius is None else gamma
        self.hpr = HprOccluder(gamma, radius)
        self.normals = normals
        self.rules = Rules.of(rules)
        self.attempts = self.rules.attempts
        self.min_visible = self.rules.min_visible
        require_share(occluders)
        if variant is not None and not occluders:
            raise InputError(
                f"the Mitsuba variant {variant!r} does not apply: scans are seen by hidden point "
                f"removal, and only occluders are traced"
            )
        self.occluders = occluders
        self.variant = "auto" if variant is None else variant

    def views(
        self,
        shape: ScanInstance,
        poses: list[tuple[NDArray, NDArray]],
        rngs: list[np.random.Generator],
        others: Others | None = None,
    ) -> list[View | RejectedView]:
        """One result per pose; hidden point removal draws nothing, ``rngs`` are not used.

        Args:
            others: what stands before the object, if ``occluders``: `ScanInstance` each.

        Raises:
            InputError: there are no others, or none has a surface.
        """
        normals = unit_normals(shape.normals, shape.points) if self.normals else None
        # Hidden point removal reports equal points once; some writers repeat a vertex a face.
        distinct = len(np.unique(shape.points, axis=0))
        views = [
            self._view(shape, np.asarray(R), np.asarray(t), normals, distinct) for R, t in poses
        ]
        if not self.occluders:
            return views
        pool = self._tracers(others)
        assert others is not None
        return [
            view if isinstance(view, RejectedView) else self._occluded(view, pool, rng)
            for view, rng in zip(views, others.rngs, strict=True)
        ]

    def settle(self) -> str:
        """The Mitsuba variant in use; ``InputError`` when the one asked for does not work here."""
        from renderers.variants import pick_variant

        self.variant = pick_variant(self.variant)
        return self.variant

    def describe(self) -> dict[str, Any]:
        """Method, radius and thresholds, as JSON data."""
        normals = {"normals": "of the scan's mesh"} if self.normals else {}
        before: dict[str, Any] = {}
        if self.occluders:
            before = {
                "occluders": float(self.occluders), "pool": POOL, "variant": self.settle()
            }  # fmt: skip
        rules = self.rules.describe()
        return {**self.hpr.describe(), "name": "scan-hpr", "rules": rules, **normals, **before}

    def _view(
        self, shape: ScanInstance, R: NDArray, t: NDArray, normals: NDArray | None, distinct: int
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
            visible_fraction=len(seen) / distinct,
            n_visible=len(seen),
            normals=None if normals is None else towards_camera(normals[seen], in_camera, R),
            symmetry=shape.symmetry,
        )

    def _tracers(self, others: Others | None) -> list[Any]:
        """Of the others' scanned surfaces; Mitsuba is imported here, as nothing else needs it."""
        from renderers.tracing import make_tracer
        from renderers.variants import activate

        meshes = [other for other in (others.shapes if others else []) if len(other.faces)]
        if not meshes:
            raise InputError(
                f"occluders={self.occluders:g} needs other scanned objects with a surface to put "
                f"before an object, and there is none"
            )
        variant = self.settle()
        activate(variant, 1)
        return [make_tracer(variant, mesh.points, mesh.faces) for mesh in meshes]

    def _occluded(
        self, view: View, pool: list[Any], rng: np.random.Generator
    ) -> View | RejectedView:
        """What is left of a view when some of the pool stand before it."""
        from renderers import occlusion
        from renderers.visibility import sight_lines

        if view.n_visible < self.min_visible:  # as without occluders: another pose is drawn
            details = {"visible": view.n_visible, "minimum": self.min_visible}
            return RejectedView(FEW_POINTS, details)
        directions, ends = sight_lines(view.points, np.zeros(3))
        shown = occlusion.Lines(spread(directions, PLACED_BY), spread(ends, PLACED_BY))
        before = occlusion.arrange(shown, view.t_camera_object, self.occluders, pool, rng)
        if before is None:
            return RejectedView(occlusion.NO_ROOM, final=True)
        kept = occlusion.unhidden(before, pool, np.eye(3), directions, ends)
        if not kept.any():
            return RejectedView(occlusion.ALL_HIDDEN, final=True)
        return replace(
            view,
            points=view.points[kept],
            normals=None if view.normals is None else view.normals[kept],
            visible_fraction=view.visible_fraction * float(kept.mean()),
            n_visible=int(kept.sum()),
            occluded_fraction=1 - float(kept.mean()),
        )
