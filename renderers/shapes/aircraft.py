"""Airplanes: nose at −x, fin at +x, wings along y."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import smooth
from renderers.shapes.solids import Solid, body, both, box, cylinder, join, loft, rod

# A symmetric aerofoil, chord 1 from nose to tail, unit thickness; ordered for a loft along +y.
_AEROFOIL = np.array([
    (1.0, 0.0), (0.7, -0.3), (0.3, -0.5), (0.08, -0.35), (0.0, 0.0), (0.08, 0.35), (0.3, 0.5),
    (0.7, 0.3),
])[::-1]  # fmt: skip


def _wing(*sections: tuple[float, float, float, float, float]) -> Solid:
    """A half wing; each section is (leading edge x, y, z, chord, thickness), y rising."""
    rings = np.zeros((len(sections), len(_AEROFOIL), 3))
    for ring, (x, y, z, chord, thick) in zip(rings, sections, strict=True):
        ring[:] = np.array([x, y, z]) + np.insert(_AEROFOIL * (chord, thick), 1, 0.0, axis=1)
    return loft(rings)


def _fin(x: float, z: float, chord: float, tip: float, height: float, sweep: float) -> Solid:
    upright = _wing((x, 0, 0, chord, 0.016), (x + sweep, height, 0, tip, 0.01))
    return upright.turned("x", 90).at(z=z)


def _fuselage(p: Draw, radius: float, nose: float, tail: float) -> Solid:
    """Length 1 from x = −0.5, with a drooped nose and a tail that rises."""
    x = np.array([0, 0.25, 0.6, 1.0, 1, 1, 1])
    size = np.array([0.05, 0.55, 0.88, 1.0, 1.0, 0.62, 0.12])
    at = np.array([*(-0.5 + nose * x[:4]), 0.5 - tail, 0.5 - 0.45 * tail, 0.5])
    lift = np.array([-0.25, -0.12, -0.03, 0, 0, 0.25, 0.6]) * radius
    rows = np.stack([at, radius * size, radius * size * p.section, lift], 1)
    return body(smooth(rows, 25), 18)


def _propeller(x: float, y: float, z: float, radius: float, turn: float) -> Iterable[Solid]:
    yield body([(x - 0.02, 0.003, 0.003, 0), (x, 0.016, 0.016, 0)], 10).at(y=y, z=z)
    yield box(0.006, 2 * radius, 0.025).turned("x", turn).at(x, y, z)


def _jet(x: float, y: float, z: float, radius: float) -> Solid:
    long = radius * 3.6
    rows = [(-0.5, 0.8), (-0.42, 1.0), (0.1, 1.0), (0.5, 0.62)]
    return body([(x + a * long, r * radius, r * radius, z) for a, r in rows], 14).at(y=y)


def _gear(x: float, y: float, top: float, bottom: float, wheel: float) -> Iterable[Solid]:
    yield rod((x, y, top), (x, y, bottom + wheel), 0.006, 6)
    yield cylinder(wheel, 0.018, 14).turned("x", 90).at(x, y, bottom + wheel)


@family(
    "airplane",
    variants={"airliner": 8, "rear_jet": 3, "propeller": 3, "fighter": 4, "biplane": 1},
    span=(0.72, 1.12), radius=(0.048, 0.072), section=(0.95, 1.15), nose=(0.1, 0.22),
    tail=(0.25, 0.4), chord=(0.13, 0.2), taper=(0.22, 0.45), sweep=(0.4, 0.78),
    dihedral=(0.0, 0.14), wing_x=(-0.16, -0.04), fin=(0.13, 0.21), fin_chord=(0.12, 0.2),
    tailplane=(0.13, 0.22), engine=(0.022, 0.036), gear=(0.04, 0.08), canopy=(0.02, 0.04),
)  # fmt: skip
def airplane(p: Draw) -> Iterable[Solid]:
    fighter, biplane = p.variant == "fighter", p.variant == "biplane"
    straight = p.variant in ("propeller", "biplane")
    radius = p.radius * (0.85 if fighter else 1.25 if biplane else 1.0)
    nose = p.nose * (2.0 if fighter else 0.7 if biplane else 1.0)
    yield _fuselage(p, radius, nose, p.tail * (0.6 if fighter else 1.0))

    # wings
    half = p.span / 2 * (0.62 if fighter else 1.15 if straight else 1.0)
    chord = p.chord * (2.3 if fighter else 0.95 if straight else 1.3)
    tip = chord * (0.75 + 0.5 * p.taper if straight else p.taper * (0.5 if fighter else 0.7))
    back = half * (p.sweep * 0.12 if straight else p.sweep * (1.3 if fighter else 1.0))
    low = -0.5 * radius
    high = p.variant == "propeller" and p.chance(0.7)
    z = radius * 0.85 if high else 0.0 if fighter else low
    rise = half * p.dihedral * (0.3 if fighter or straight else 1.0)
    x = p.wing_x + (0.08 if p.variant == "rear_jet" else 0) - (0.1 if straight else 0)
    kink = 0.35
    root = (x, 0.0, z, chord, 0.12 * p.chord)
    outer = (x + back, half, z + rise, tip, 0.02)
    if straight or fighter:
        yield both(_wing(root, outer), "y")
    else:  # the yehudi: the trailing edge runs straight out to the kink
        inner = x + back * kink
        yield both(_wing(root, (inner, half * kink, z + rise * kink,
                                0.62 * chord, 0.015), outer), "y")  # fmt: skip
    if biplane:
        gap = radius * 2.6
        yield both(_wing((x - 0.03, 0, z + gap, chord, 0.02), (x - 0.03, half, z + gap, tip, 0.02)),
                   "y")  # fmt: skip
        for u in (0.35, 0.8):
            for v in (0.15, 0.75):
                yield both(rod((x + v * tip, u * half, z), (x - 0.03 + v * tip, u * half, z + gap),
                               0.005, 6), "y")  # fmt: skip

    # tail
    t_tail = p.variant == "rear_jet" and p.chance(0.8)
    fin_x, fin_sweep = 0.5 - p.fin_chord, (0.35 if straight else 0.85) * p.fin
    fin_z = 0.3 * radius
    fin = _fin(fin_x, fin_z, p.fin_chord, p.fin_chord * 0.5, p.fin, fin_sweep)
    if fighter and p.chance(0.45):
        yield both(fin.turned("x", -15).at(y=radius * 1.1), "y")
    else:
        yield fin
    tail_z = fin_z + p.fin if t_tail else fin_z * 0.8
    tail_x = fin_x + (fin_sweep if t_tail else 0.03)
    plane = p.tailplane * (0.8 if fighter else 1.0)
    if not (fighter and p.chance(0.3)):
        yield both(_wing((tail_x, 0, tail_z, p.fin_chord * 0.75, 0.014),
                         (tail_x + plane * (0.15 if straight else 0.55), plane, tail_z + 0.2 * rise,
                          p.fin_chord * 0.35, 0.01)), "y")  # fmt: skip

    # engines
    if p.variant == "airliner":
        for u in (0.34,) if p.chance(0.7) else (0.3, 0.58):
            ex = x + back * u - 0.3 * chord * 0.3
            ez = z + rise * u - 1.25 * p.engine
            yield both(_jet(ex, u * half, ez, p.engine), "y")
            yield both(box((ex, ex + 0.08), 0.008, (ez, ez + 1.5 * p.engine)).at(y=u * half), "y")
    elif p.variant == "rear_jet":
        yield both(_jet(0.25, radius + p.engine, 0.35 * radius, p.engine), "y")
        yield both(box((0.22, 0.3), (0, radius + p.engine), 0.012).at(z=0.35 * radius), "y")
    elif fighter:
        inlet = p.engine * 1.2
        rows = [(-0.12, 1.0), (0.2, 1.1), (0.5, 0.75)]
        pod = body([(a, inlet * r, inlet * r, -0.2 * radius) for a, r in rows], 12, 3.0)
        yield both(pod.at(y=radius * 0.75), "y")
        if p.chance(0.5):
            yield both(_jet(x + back, half * 0.7, z - 0.03, 0.012), "y")
    elif p.variant == "propeller" and p.chance(0.7):
        ey, turn = 0.3 * half, p.uniform(0, 180)
        rows = [(-0.13, 0.5), (-0.1, 1.0), (0.02, 0.9), (0.14, 0.2)]
        nacelle = body([(x + a, p.engine * r, p.engine * r, z) for a, r in rows], 12)
        yield both(join(nacelle.at(y=ey), _propeller(x - 0.13, ey, z, 2.8 * p.engine, turn)), "y")
    else:
        yield from _propeller(-0.5, 0, -0.2 * radius, 3.6 * p.engine, p.uniform(0, 180))

    # what only some models have
    if fighter or straight:
        yield body([(-0.26, 0.005, 0.005, 0), (-0.2, p.canopy, p.canopy, 0.01),
                    (-0.02, 0.01, 0.01, 0)], 10).at(z=radius * 0.8)  # fmt: skip
    if biplane or p.chance(0.3):
        bottom = -radius - p.gear
        if not biplane:
            yield from _gear(-0.36, 0, -0.5 * radius, bottom, 0.35 * p.gear)
        yield both(join(_gear(x + 0.1, 1.3 * radius, low, bottom, 0.4 * p.gear)), "y")
