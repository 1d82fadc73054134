"""Cones: traffic cones and the plain solid."""

from __future__ import annotations

from collections.abc import Iterable

from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import circle
from renderers.shapes.solids import Solid, box, extrude, revolve, ring


@family(
    "cone",
    variants={"traffic": 5, "plain": 5, "party": 1},
    height=(0.55, 1.7), radius=(0.36, 0.6), traffic_radius=(0.24, 0.42), tip=(0.02, 0.32),
    flange=(1.12, 1.9), flange_thickness=(0.015, 0.1), bulge=(-0.05, 0.05), band=(1.005, 1.05),
    band_height=(0.3, 0.7), wall=(0.02, 0.06),
)  # fmt: skip
def cone(p: Draw) -> Iterable[Solid]:
    h = p.height
    if p.variant == "plain":
        facets = p.choice((48, 48, 48, 24, 8))
        middle = (p.radius * (0.5 + p.bulge * 0.4), h / 2)
        side = [(p.radius, 0), middle, (0, h)]
        yield revolve([(0, 0), *side] if p.chance(0.7) else side, facets)
        if p.chance(0.1):
            yield revolve([(p.radius * 1.03, -0.03), (p.radius * 1.03, 0)], facets)
        return
    if p.variant == "party":
        h = 0.9 + 0.4 * h
        r = p.radius * 0.8
        yield revolve([(r, 0), (0.01, h)], 40)
        yield revolve([(r - p.wall, 0), (0.0, h * (1 - p.wall / r))], 40)
        return

    h = 0.8 + 0.5 * h
    r, t = p.traffic_radius, p.flange_thickness
    top = r * p.tip
    at_middle = (r + top) / 2 + p.bulge * 0.5
    outside = [(r, t), (at_middle, t + h / 2), (top, t + h)]
    if p.chance(0.5):  # hollow, with a hole at the tip
        w = min(p.wall, 0.8 * top)
        yield revolve([*outside, (top - w, t + h), (at_middle - w, t + h / 2), (r - w, t)], 40)
    else:
        yield revolve([*outside, (0, t + h)], 40)
    for z in (p.band_height,) if p.chance(0.5) else (p.band_height * 0.6, p.band_height + 0.15):
        sleeve = [
            (r + (top - r) * u + p.bulge * 2 * min(u, 1 - u), t + h * u) for u in (z, z + 0.1)
        ]
        yield revolve(sleeve, 40).scaled(p.band, p.band)
    foot = r * p.flange
    shape = p.choice(("square", "square", "round", "octagon"))
    if shape == "square":
        yield box(2 * foot, 2 * foot, (0, t))
        if p.chance(0.3):
            yield ring(box((foot * 0.7, foot), 0.1, (-0.03, 0)), 4)
    else:
        yield extrude(circle(foot * 1.05, 8 if shape == "octagon" else 40), (0, t))
