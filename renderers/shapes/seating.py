"""Chairs: the back at +y, the sitter looks to −y."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import rounded_rectangle, smooth
from renderers.shapes.solids import (
    Solid,
    beam,
    both,
    box,
    cylinder,
    ellipsoid,
    extrude,
    join,
    ring,
    rod,
    rounded_box,
    sheet,
    tube,
)


def _bar(p: Draw, start: tuple, end: tuple, size: float, taper: float = 1.0) -> Solid:
    """Round or square stock, the same throughout one chair."""
    if p.roundness > 0.5:
        return rod(start, end, size / 2, 10, taper)
    return beam(start, end, size, size, taper)


def _back(p: Draw, width: float, low: float, high: float) -> Iterable[Solid]:
    """An upright back in the plane y = 0 between two heights."""
    t = p.back_thickness
    style = p.choice(("panel", "panel", "slats", "ladder", "frame", "rounded", "curved"))
    if style == "panel":
        yield box(width, t, (low, high))
    elif style == "rounded":
        yield rounded_box(width, t * 1.6, (low, high), t)
    elif style == "curved":
        bend = p.curve * width
        x = np.linspace(-width / 2, width / 2, 9)
        y = -bend * (2 * x / width) ** 2
        front = [[(a, b, z) for a, b in zip(x, y, strict=True)] for z in (low, high)]
        yield sheet(front)
        yield sheet(front).at(y=t)
    else:
        post = max(t, 0.03)
        yield both(_bar(p, (width / 2 - post / 2, 0, low), (width / 2 - post / 2, 0, high), post))
        rail = 0.16 * (high - low)
        yield box(width, t * 0.8, (high - rail, high))
        if style == "slats":
            yield box(width, t * 0.8, (low + 0.05, low + 0.05 + 0.5 * rail))
            for x in np.linspace(-width / 2, width / 2, p.integer(3, 8) + 2)[1:-1]:
                yield _bar(p, (x, 0, low + 0.05), (x, 0, high), 0.025)
        elif style == "ladder":
            for z in np.linspace(low, high - rail, p.integer(2, 4) + 1)[:-1]:
                yield box(width, t * 0.6, (z, z + 0.7 * rail))
        elif p.chance(0.5):
            inner = low + 0.35 * (high - low)
            yield box(width - 2 * post, t * 0.4, (inner, high - rail))


def _arms(p: Draw, width: float, seat: float, depth: float, style: str) -> Iterable[Solid]:
    x, z = width / 2 + p.leg * 0.3, seat + p.arm
    front, back = -depth / 2 + 0.08, depth / 2
    yield both(box(p.arm_width, (front - 0.05, back + 0.02), (z, z + 0.03)).at(x))
    if style == "post":
        yield both(_bar(p, (x, front, seat - 0.03), (x, front, z), p.leg * 0.8))
    elif style == "loop":
        path = smooth([(x, -0.1, seat), (x, front, seat + 0.3 * p.arm), (x, front, z),
                       (x, back, z)], 14)  # fmt: skip
        yield both(tube(path, p.leg * 0.4))
    else:
        yield both(box(p.arm_width * 0.5, (front, back), (seat, z)).at(x))


def _legs(p: Draw, width: float, depth: float, seat: float) -> Iterable[Solid]:
    x, y = width / 2 - p.leg / 2, depth / 2 - p.leg / 2
    out = seat * np.tan(np.radians(p.splay))
    for sx in (-1, 1):
        for sy in (-1, 1):
            top = (sx * x, sy * y, seat)
            yield _bar(p, top, (sx * (x + 0.5 * out), sy * (y + out), 0), p.leg, p.leg_taper)
    if p.chance(0.45):
        z, spread = seat * p.stretcher, out * (1 - p.stretcher)
        yield both(_bar(p, (x, -y - spread, z), (x, y + spread, z), p.leg * 0.6))
        if p.chance(0.6):
            yield _bar(p, (-x, 0, z), (x, 0, z), p.leg * 0.6)
    if p.chance(0.4):
        yield both(box(2 * x, p.leg * 0.6, (seat - 0.09, seat)).at(0, y), "y")
        yield both(box(p.leg * 0.6, 2 * y, (seat - 0.09, seat)).at(x))


def _swivel(p: Draw, seat: float, reach: float) -> Iterable[Solid]:
    yield cylinder(0.03, (0.1, seat), 12)
    yield cylinder(0.05, (0.1, 0.4 * seat), 12)
    if p.chance(0.75):
        spoke = beam((0, 0, 0.14), (reach, 0, 0.07), 0.05, 0.04, 0.7)
        wheel = cylinder(0.035, 0.04, 10).turned("x", 90).at(reach, 0, 0.035)
        yield ring(join(spoke, wheel), p.choice((4, 5, 5)), 90)
    else:
        yield cylinder(reach, (0, 0.03), 28, reach * 0.8)


def _cantilever(p: Draw, width: float, depth: float, seat: float) -> Iterable[Solid]:
    x, front, back = width / 2, -depth / 2, depth / 2
    path = [(x, back, 0), (x, front + 0.05, 0), (x, front, 0.05), (x, front - 0.02, seat - 0.05),
            (x, front + 0.05, seat), (x, back, seat)]  # fmt: skip
    if p.chance(0.5):  # a sled: the loop comes up again at the back
        path = [(x, back - 0.02, seat), *path]
    yield both(tube(np.array(path), p.leg * 0.4))
    yield _bar(p, (-x, back, 0), (x, back, 0), p.leg * 0.8)


@family(
    "chair",
    variants={"four_legs": 9, "swivel": 4, "cantilever": 2, "folding": 1, "club": 3, "shell": 2},
    width=(0.42, 0.6), depth=(0.42, 0.58), seat=(0.4, 0.52), seat_thickness=(0.02, 0.1),
    back=(0.36, 0.58), back_gap=(0.0, 0.16), back_width=(0.82, 1.02), back_thickness=(0.02, 0.06),
    rake=(2.0, 18.0), leg=(0.025, 0.055), leg_taper=(0.6, 1.0), splay=(0.0, 9.0),
    stretcher=(0.2, 0.55), arm=(0.16, 0.26), arm_width=(0.03, 0.07), roundness=(0.0, 1.0),
    curve=(0.04, 0.25), base=(0.24, 0.33),
)  # fmt: skip
def chair(p: Draw) -> Iterable[Solid]:
    w, d, seat = p.width, p.depth, p.seat
    top = seat + p.seat_thickness

    if p.variant == "club":  # upholstered, to the floor or on stub legs
        low = p.choice((0.0, 0.06, 0.12))
        seat, top, side = 0.28, 0.42 + 0.1 * p.stretcher, 0.8 * p.arm_width + 0.06
        w, d = w * 1.15, d * 1.15
        yield rounded_box(w, d, (low, seat), 0.03)
        yield rounded_box(w - 0.02, d - 0.02, (seat, top), 0.05)
        yield both(rounded_box(side, d + 0.1, (low, top + 0.7 * p.arm), 0.04).at(w / 2 + side / 2,
                                                                              0.05))  # fmt: skip
        back = rounded_box(w + side, 0.1 + p.back_thickness, (low, top + 0.8 * p.back), 0.05)
        yield back.turned("x", -0.6 * p.rake).at(y=d / 2 + 0.05)
        if low:
            yield both(both(cylinder(p.leg * 0.6, (0, low), 10).at(w / 2, d / 2), "x"), "y")
        return
    if p.variant == "folding":
        x = w / 2
        yield both(_bar(p, (x, -d * 0.55, 0), (x, d * 0.55, top + p.back), 0.7 * p.leg))
        yield both(_bar(p, (x - 0.03, d * 0.6, 0), (x - 0.03, -d * 0.3, seat), 0.7 * p.leg))
        yield box(w - 0.06, d, (seat, seat + 0.5 * p.seat_thickness))
        for z in (0.12, 0.75):  # rails between the legs, at heights along the front frame
            at = d * (1.1 * z - 0.55), z * (top + p.back) * p.stretcher
            yield _bar(p, (-x, *at), (x, *at), 0.02)
        slope = np.degrees(np.arctan2(1.1 * d, top + p.back))
        panel = box(w, 0.02, (-0.35 * p.back, 0)).turned("x", -slope)
        yield panel.at(0, 0.55 * d, top + p.back)
        return

    # seat
    if p.variant == "shell":
        n = 13
        profile = smooth([(-0.5 * d, seat - 0.02), (-0.3 * d, seat), (0.25 * d, seat - 0.01),
                          (0.48 * d, seat + 0.12), (0.55 * d + 0.1, seat + p.back)], n)  # fmt: skip
        u = np.linspace(-1, 1, 9)
        lift = np.linspace(0.02, p.curve * 0.4, n)
        grid = [[(0.5 * w * a, y - 0.3 * k * a * a * (z > seat + 0.1), z + k * a * a)
                 for a in u] for (y, z), k in zip(profile, lift, strict=True)]  # fmt: skip
        yield sheet(grid)
        yield sheet(grid).at(z=-0.4 * p.back_thickness)
    else:
        shape = p.choice(("box", "box", "cushion", "rounded", "round"))
        if shape == "round":
            yield cylinder(0.5 * w, (seat, top), 28).scaled(1.0, d / w)
        elif shape == "rounded":
            yield extrude(rounded_rectangle(w, d, 0.12), (seat, top))
        elif shape == "cushion":
            yield rounded_box(w, d, (seat, top + 0.03), 0.05)
        else:
            yield box(w, d, (seat, top))
        gap = p.back_gap if p.chance(0.6) else 0.0
        back = join(_back(p, w * p.back_width, gap, p.back))
        if gap and p.variant != "four_legs":
            back = join(back, _bar(p, (0, 0.01, -0.02), (0, 0.01, gap + 0.1), 0.05))
        elif gap:
            side = w * p.back_width / 2 - 0.02
            back = join(back, both(_bar(p, (side, 0, 0), (side, 0, gap + 0.02), 0.03)))
        yield back.turned("x", -p.rake).at(0, d / 2 - p.back_thickness / 2, top)

    # what it stands on
    if p.variant == "swivel" or (p.variant == "shell" and p.chance(0.3)):
        yield from _swivel(p, seat, p.base)
    elif p.variant == "cantilever":
        yield from _cantilever(p, w, d, seat)
    else:
        yield from _legs(p, w, d, seat)
    if p.chance(0.45) and p.variant != "shell":
        style = p.choice(("post", "post", "loop", "loop", "panel"))
        yield from _arms(p, w, top, d, style)
    if p.variant == "swivel" and p.chance(0.2):
        yield ellipsoid(0.1, 0.04, 0.07, 10).at(0, d / 2 + 0.05, top + p.back + 0.08)
