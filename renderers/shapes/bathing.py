"""Bathtubs: long along y, the basin open to +z."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import smooth, superellipse
from renderers.shapes.solids import Solid, box, cylinder, ellipsoid, four, loft, tube


def _ring(outline: np.ndarray, z: float, dy: float = 0.0) -> np.ndarray:
    return np.insert(outline + np.array([0.0, dy]), 2, z, axis=1)


def _tap(p: Draw, x: float, y: float, z: float) -> Iterable[Solid]:
    path = smooth([(x, y, z), (x, y, z + p.tap), (x, y - 0.06, z + 1.15 * p.tap),
                   (x, y - 0.12, z + 0.9 * p.tap)], 12)  # fmt: skip
    yield tube(path, 0.012)
    for side in (-0.07, 0.07):
        yield cylinder(0.018, (z, z + 0.05), 10).at(x + side, y)


@family(
    "bathtub",
    variants={"apron": 4, "freestanding": 4, "oval_in_box": 3, "corner": 2},
    width=(0.42, 0.8), height=(0.15, 0.42), rim=(0.02, 0.08), depth=(0.62, 0.92),
    floor=(0.55, 0.9), slope=(0.0, 0.16), outer_taper=(0.6, 0.9), corner_power=(2.4, 7.0),
    lip=(0.01, 0.06), tap=(0.06, 0.2), foot=(0.03, 0.09),
)  # fmt: skip
def bathtub(p: Draw) -> Iterable[Solid]:
    w, h = p.width / 2, p.height
    bottom = h * (1 - p.depth) + 0.01
    if p.variant == "freestanding":
        n, power = 40, 2.0 + (p.corner_power - 2.4) * 0.25
        lift = p.foot * p.chance(0.6)
        curve = smooth([(p.outer_taper * 0.9, lift), (p.outer_taper * 1.03, lift + 0.12 * h),
                        (0.97, lift + 0.75 * h), (1.0, lift + h)], 8)  # fmt: skip
        outside = [_ring(superellipse(w * s, 0.5 * (0.3 + 0.7 * s), power, n), z) for s, z in curve]
        lip = superellipse(w + p.lip, 0.5 + p.lip, power, n)
        inside = [
            _ring(superellipse((w - p.rim * 0.5) * s, (0.5 - p.rim * 0.5) * (0.3 + 0.7 * s),
                               power, n), z + 0.02)
            for s, z in curve[::-1]
        ]  # fmt: skip
        if p.chance(0.5):  # one or both ends drawn up
            for ring in (*outside, *inside):
                ring[:, 2] += p.slope * np.clip((ring[:, 2] - lift) / h, 0, 1) * ring[:, 1] ** 2 * 4
        yield loft([*outside, _ring(lip, lift + h), _ring(lip, lift + h + 0.01), *inside])
        if lift:
            yield four(ellipsoid(0.04, 0.04, 0.5 * lift + 0.03, 10).at(0.6 * w, 0.3, 0.5 * lift))
        if p.chance(0.2):
            yield from _tap(p, 0, 0.5 - p.rim, h)
        return

    n = 40
    if p.variant == "corner":
        w = 0.42 + 0.08 * (p.width - 0.42)
        outer = superellipse(w, 0.5, 12, n)
        cut = np.clip(outer[:, 0] - outer[:, 1] - (0.3 + p.lip), 0, None) / 2
        outer = outer + np.stack([-cut, cut], 1)
        inner_power = 2.6
    else:
        outer = superellipse(w, 0.5, 30, n)
        inner_power = 2.2 if p.variant == "oval_in_box" else p.corner_power
    hole = outer if p.variant == "corner" else superellipse(w, 0.5, inner_power, n)
    edge = 1 - p.rim / w * (1.6 if p.variant == "oval_in_box" else 1.0), 1 - p.rim / 0.5 * 1.2
    rings = [_ring(outer, 0), _ring(outer, h)]
    for t in np.linspace(0, 1, 6):
        shrink = 1 - (1 - p.floor) * t**2
        rings.append(_ring(hole * edge * (shrink, 0.5 + 0.5 * shrink), h + (bottom - h) * t,
                           -p.slope * t * 0.5))  # fmt: skip
    yield loft(rings)
    if p.variant == "apron" and p.chance(0.35):  # a recessed panel, or the shell is doubled
        yield box((-w - 0.004, w + 0.004), 0.86, (0.12 * h, 0.8 * h))
    if p.variant != "corner" and p.chance(0.3):
        yield box(2 * (w + p.lip), 1 + 2 * p.lip, (-0.03, 0))
    if p.chance(0.3):
        yield from _tap(p, 0, 0.5 - p.rim * 0.5, h)
