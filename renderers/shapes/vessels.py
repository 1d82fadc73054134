"""Bottles: closed vessels with a neck, upright along z."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import smooth
from renderers.shapes.solids import Solid, box, cylinder, revolve, tube


@family(
    "bottle",
    variants={"wine": 4, "beer": 3, "soda": 3, "jar": 2, "flask": 1, "jug": 1},
    height=(2.4, 4.2), shoulder=(0.5, 0.8), slope=(0.08, 0.26), neck=(0.2, 0.42),
    lip=(1.04, 1.35), lip_height=(0.02, 0.05), heel=(0.02, 0.07), punt=(0.0, 0.06),
    waist=(0.0, 0.16), waist_height=(0.3, 0.6), flatten=(0.45, 0.8), cap=(0.03, 0.08),
    wall=(0.03, 0.07), label=(1.005, 1.04),
)  # fmt: skip
def bottle(p: Draw) -> Iterable[Solid]:
    """A profile of diameter 1 and the drawn height, wine bottles with long necks."""
    h, r = p.height, 0.5
    neck, shoulder = r * p.neck, p.shoulder
    slope = p.slope
    if p.variant == "wine":
        h, slope, shoulder = h * 1.05, slope * 0.7, shoulder * 0.98
    elif p.variant == "beer":
        shoulder, slope = shoulder * 0.82, slope * 1.35
    elif p.variant == "jar":
        h, neck, shoulder, slope = h * 0.72, r * (0.6 + 0.9 * p.neck), 0.6 + 0.3 * shoulder, 0.08
    elif p.variant == "soda":
        neck = r * (0.3 + 0.3 * p.neck)
    top = min(shoulder + slope, 0.95)
    curve = smooth([(r, shoulder), (r * 0.93, shoulder + 0.18 * (top - shoulder)),
                    ((r + neck) / 2, (shoulder + top) / 2), (neck, top)], 9)  # fmt: skip
    if p.variant == "soda":
        waist = 1 - p.waist * 1.3
        low = [(r, 0.14), (r * waist, p.waist_height), (r, min(p.waist_height + 0.2, shoulder))]
        side = smooth([(r * 0.86, 0.0), *low, (r, shoulder)], 16)
    elif p.variant == "beer":
        side = np.array([(r - p.heel, 0.0), (r, p.heel), (r * (1 - 0.5 * p.waist), shoulder * 0.6)])
    else:
        side = np.array([(r - p.heel, 0.0), (r * 0.995, p.heel * 0.7), (r, p.heel * 1.5)])
    rim = 1 - p.lip_height
    mouth = [(neck, rim), (neck * p.lip, rim), (neck * p.lip, 1.0)]
    outside = np.array([(0, p.punt), *side, *curve, *mouth])
    scale = np.array([1.0, h])
    inside: list[tuple[float, float]] = []
    capped = p.variant in ("soda", "jar", "jug") or p.chance(0.4)
    if p.chance(0.35):  # a wall with an inner surface
        inner = outside[1:-2][::-1] * (1 - 2 * p.wall, 1)
        inside = [(neck * (1 - 2 * p.wall), 1.0), *map(tuple, inner)]
        inside.append((0, p.punt + 0.03))
    elif capped or p.chance(0.5):
        inside = [(0, 1.0)]
    solid = revolve(np.array([*outside, *inside]) * scale, 32)
    flat = p.variant == "flask" or (p.variant == "jar" and p.chance(0.2))
    if flat:
        sections = 4 if p.chance(0.3) else 32
        if sections == 4:
            solid = revolve(np.array([*outside, *inside]) * scale, 4).turned("z", 45)
        solid = solid.scaled(p.flatten, 1.0, 1.0)
    yield solid
    if capped:
        wide = neck * (1.12 if p.variant == "jar" else p.lip * 1.05)
        yield cylinder(wide, (h * (0.99 - p.cap * 0.5), h * (1 + p.cap * 0.7)), 24)
    if p.chance(0.35) and not flat:
        z = shoulder * h * np.array([0.3, 0.75])
        yield revolve([(r * p.label, z[0]), (r * p.label, z[1])], 32)
    if p.variant == "jug":
        if p.chance(0.5):  # a handle from shoulder to neck
            zs = h * np.array([shoulder * 0.6, shoulder * 0.8, top, rim])
            out = r * np.array([0.95, 1.3, 1.1, p.neck * 1.1])
            yield tube(smooth(np.stack([0 * zs, out, zs], 1), 14), 0.05)
        else:  # a spray head
            yield box(0.14, (-0.5, 0.25), (h * 1.02, h * 1.02 + 0.16))
            yield box(0.06, 0.06, (-0.3, 0)).turned("x", -25).at(0, -0.3, h * 1.04)
