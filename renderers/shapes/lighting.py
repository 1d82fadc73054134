"""Lamps: upright along z; arms reach out along y."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import smooth
from renderers.shapes.solids import Solid, box, cylinder, ellipsoid, join, revolve, ring, rod, tube


def _shade(p: Draw, height: float, radius: float) -> Solid:
    """A shade standing on z = 0, open at both ends, or a closed globe."""
    upper = radius * p.shade_taper
    style = p.choice(("cone", "cone", "cone", "drum", "dome", "globe", "square", "bell"))
    if style == "globe":
        return ellipsoid(radius * 0.9, radius * 0.9, height * 0.5, 24).at(z=height * 0.5)
    if style == "drum":
        side = [(radius * 0.85, 0), (radius * 0.85, height)]
    elif style == "dome":
        t = np.linspace(0, np.pi / 2, 8)
        side = list(zip(radius * np.cos(t), height * 0.8 * np.sin(t), strict=True))
    elif style == "bell":
        side = list(smooth([(radius, 0), (0.72 * radius, 0.35 * height), (upper, height)], 9))
    else:
        side = [(radius, 0), (upper, height)]
    facets = 4 if style == "square" else p.choice((32, 32, 32, 6, 8))
    profile = np.array(side, float)
    if p.chance(0.35):  # both faces of a thin wall
        profile = np.concatenate([profile, profile[::-1] * 0.97 + (0, 0.015 * height)])
    shade = revolve(profile, facets)
    return shade.turned("z", 45) if facets == 4 else shade


def _base(p: Draw, radius: float, thick: float) -> Iterable[Solid]:
    style = p.choice(("disc", "disc", "dome", "step", "square", "tripod"))
    if style == "disc":
        yield cylinder(radius, (0, thick), 28, radius * 0.92)
    elif style == "dome":
        yield revolve([(0, 0), (radius, 0), (radius, 0.4 * thick), (radius * 0.7, 1.2 * thick),
                       (radius * 0.2, 2 * thick), (0, 2 * thick)], 28)  # fmt: skip
    elif style == "step":
        yield cylinder(radius, (0, thick * 0.6), 28)
        yield cylinder(radius * 0.7, (thick * 0.6, thick * 1.4), 28)
    elif style == "square":
        yield box(1.7 * radius, 1.7 * radius, (0, thick))
    else:
        for i in range(3):
            foot = rod((0, 0, 2.5 * thick + 0.05), (radius * 1.1, 0, 0.01), 0.02, 8)
            yield foot.turned("z", 90 + 120 * i)


def _turned_stem(p: Draw, low: float, high: float, width: float) -> Solid:
    """A turned or vase-shaped stem."""
    style = p.choice(("vase", "baluster", "column", "balls"))
    length = high - low
    if style == "vase":
        belly = 0.25 + 0.4 * p.belly
        points = [(0.5, 0), (1.0, belly), (0.4, 0.82), (0.25, 1.0)]
    elif style == "baluster":
        points = [(0.9, 0), (0.35, 0.15), (1.0 * p.belly + 0.3, 0.4), (0.3, 0.75), (0.5, 0.9),
                  (0.2, 1.0)]  # fmt: skip
    elif style == "column":
        points = [(0.5, 0), (0.42, 0.5), (0.35, 1.0)]
    else:
        z = np.linspace(0, 1, 13)
        points = list(zip(0.25 + 0.5 * np.sin(z * np.pi * 3) ** 2, z, strict=True))
    curve = smooth(points, 22) * (width, length)
    return revolve([(0, 0), *np.maximum(curve, (0.008, 0)), (0, length)], 20).at(z=low)


@family(
    "lamp",
    variants={"table": 6, "floor": 3, "arc": 2, "desk": 4, "pendant": 1, "paper": 1, "wall": 1,
              "branched": 1},
    height=(1.3, 2.0), shade=(0.28, 0.52), shade_height=(0.3, 0.62), shade_taper=(0.25, 0.9),
    base=(0.16, 0.36), base_thickness=(0.02, 0.08), stem=(0.012, 0.035), stem_width=(0.08, 0.24),
    belly=(0.1, 0.9), finial=(0.01, 0.07), reach=(0.4, 1.1), head=(0.12, 0.24),
    elbow=(0.15, 0.5), sag=(0.02, 0.4), cord=(0.2, 0.9),
)  # fmt: skip
def lamp(p: Draw) -> Iterable[Solid]:
    h = p.height
    if p.variant in ("table", "floor"):
        tall = p.variant == "floor"
        shade_h = p.shade_height * (0.75 if tall else 1.1)
        radius = p.shade * (0.8 if tall else 1.05)
        stem_top = h - shade_h
        yield from _base(p, p.base * (0.9 if tall else 1.0), p.base_thickness)
        if tall or p.chance(0.3):
            yield cylinder(p.stem, (0, stem_top + 0.5 * shade_h), 12)
            if p.chance(0.5):
                yield _turned_stem(p, 0.0, stem_top * p.elbow * 1.4, 2 * p.stem + 0.04)
        else:
            yield _turned_stem(p, p.base_thickness, stem_top, p.stem_width)
            yield cylinder(p.stem, (stem_top, stem_top + 0.6 * shade_h), 12)
        yield _shade(p, shade_h, radius).at(z=stem_top)
        if p.chance(0.6):
            yield ellipsoid(0.03, 0.03, p.finial + 0.02, 10).at(z=h + p.finial)
        if p.chance(0.3):
            yield ellipsoid(0.06, 0.06, 0.09, 12).at(z=stem_top + 0.4 * shade_h)
        return
    if p.variant == "pendant":
        yield cylinder(0.5 * p.base, (h, h + p.base_thickness), 24)
        yield cylinder(p.stem * 0.6, (h - p.cord, h), 8)
        yield _shade(p, p.shade_height, p.shade).at(z=h - p.cord - p.shade_height * 0.95)
        return
    if p.variant == "paper":
        r = p.head * 1.2
        yield from _base(p, p.base * 0.7, p.base_thickness)
        facets = p.choice((4, 24))
        yield cylinder(p.stem, (0, 0.2 * h), 10)
        yield revolve([(0, 0.15 * h), (r, 0.15 * h), (r * (0.6 + 0.5 * p.shade_taper), h), (0, h)],
                      facets)  # fmt: skip
        return

    if p.variant == "wall":  # the plate at +x, the arm towards −x
        out = 0.5 * p.reach
        yield box((out, out + 0.04), p.base, (0, 1.3 * p.base))
        yield tube(smooth([(out, 0, 0.5 * p.base), (0.4 * out, 0, 0.3 * p.base - p.sag * 0.3),
                           (0, 0, 0.5 * p.base)], 12), p.stem)  # fmt: skip
        yield _shade(p, p.shade_height, 0.8 * p.shade).at(z=0.5 * p.base)
        return
    if p.variant == "branched":
        yield from _base(p, p.base, p.base_thickness)
        yield cylinder(p.stem, (0, 0.9 * h), 10)
        arm = smooth(
            [(0, 0, 0.6 * h), (0, 0.2 * p.reach, 0.62 * h), (0, 0.4 * p.reach, 0.75 * h)], 9
        )
        shade = _shade(p, 0.7 * p.shade_height, p.head)
        yield ring(join(tube(arm, 0.7 * p.stem), shade.at(*arm[-1])), p.integer(2, 5), 90)
        if p.chance(0.5):
            yield shade.at(z=0.9 * h)
        return

    # arc and desk lamps: the base at −y, the head at +y
    yield from _base(p, p.base * 0.85, p.base_thickness)
    if p.variant == "arc":
        drop = h - p.sag
        path = smooth([(0, 0, 0), (0, 0, 0.6 * h), (0, 0.25 * p.reach, 0.93 * h),
                       (0, 0.65 * p.reach, h), (0, p.reach, drop)], 28)  # fmt: skip
        end, tilt = path[-1], p.uniform(0, 40)
    else:
        h *= 0.45 + 0.4 * p.elbow / 0.5
        middle = (0, -p.elbow * 0.9, 0.55 * h)
        path = np.array([(0, 0, 0.02), middle, (0, p.reach * 0.7, 0.95 * h)])
        end, tilt = path[-1], p.uniform(10, 60)
        yield ellipsoid(0.035, 0.035, 0.035, 10).at(*middle)
    yield tube(path, p.stem)
    head = _shade(p, p.head * 1.5, p.head)
    yield head.at(z=-p.head * 1.5).turned("x", tilt).at(end[0], end[1], end[2] + 0.02)
