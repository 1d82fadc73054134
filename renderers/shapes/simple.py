"""Cones: the traffic cone and the plain geometric solid."""

from __future__ import annotations

from collections.abc import Iterable

from renderers.shapes.family import Draw, family
from renderers.shapes.solids import Solid, box, revolve


@family(
    "cone",
    variants={"traffic": 3, "plain": 2, "hollow": 1},
    height=(0.6, 1.5), radius=(0.2, 0.5), tip=(0.01, 0.3), flange=(1.1, 1.6),
    flange_thickness=(0.02, 0.08), bulge=(-0.06, 0.06), band=(1.0, 1.06), band_height=(0.3, 0.7),
)  # fmt: skip
def cone(p: Draw) -> Iterable[Solid]:
    yield revolve([(0, 0), (p.radius, 0), (p.radius * p.tip, p.height), (0, p.height)])
    if p.variant == "traffic":
        side = 2 * p.radius * p.flange
        yield box(side, side, (-p.flange_thickness, 0))
