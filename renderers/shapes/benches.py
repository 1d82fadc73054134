"""Benches: long along y, the back (where there is one) at +x."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import smooth
from renderers.shapes.solids import (
    Solid,
    beam,
    both,
    box,
    cylinder,
    extrude,
    join,
    rod,
    rounded_box,
    tube,
)


def _seat(p: Draw, depth: float, length: float, low: float) -> Iterable[Solid]:
    """A board, slats or a cushion from −depth/2 to depth/2 in x."""
    t = p.seat_thickness
    style = p.choice(("board", "board", "slats", "slats", "cushion"))
    if style == "board":
        yield box(depth, length, (low, low + t))
    elif style == "cushion":
        yield box(depth, length, (low, low + 0.5 * t))
        yield rounded_box(depth, length, (low + 0.5 * t, low + 1.5 * t), 0.02)
    else:
        count = p.integer(3, 7)
        pitch = depth / count
        for i in range(count):
            x = -depth / 2 + (i + 0.5) * pitch
            yield box(pitch * (1 - p.slat_gap), length, (low, low + 0.5 * t)).at(x)


def _back(p: Draw, length: float, height: float) -> Iterable[Solid]:
    """In the plane x = 0, from z = 0 up."""
    t = 0.4 * p.seat_thickness + 0.008
    style = p.choice(("board", "rails", "rails", "balusters"))
    if style == "board":
        yield box(t, length, (0.25 * height, height))
    elif style == "rails":
        count = p.integer(2, 5)
        pitch = height / count
        for i in range(count):
            yield box(t, length, (pitch * (i + p.slat_gap), pitch * (i + 1)))
    else:
        yield box(t, length, (height * 0.88, height))
        for y in np.linspace(-length / 2, length / 2, p.integer(8, 18)):
            yield box(t * 0.6, t, (0, height)).at(0, y * 0.98)


def _supports(p: Draw, depth: float, length: float, seat: float) -> Iterable[Solid]:
    x, y, leg = depth / 2 - p.leg / 2, length / 2 * (1 - p.inset), p.leg
    style = p.choice(("legs", "legs", "slab", "trestle", "hoop", "block"))
    if style == "legs":
        out = seat * np.tan(np.radians(p.splay))
        for sx in (-1, 1):
            for sy in (-1, 1):
                end = (sx * (x + 0.4 * out), sy * (y + out), 0)
                yield beam((sx * x, sy * y, seat), end, leg, leg, 0.8)
        if p.chance(0.4):
            yield both(box(leg * 0.5, 2 * y, (seat - 0.08, seat)).at(x))
            yield both(box(2 * x, leg * 0.5, (0.1, 0.14)).at(0, y), "y")
    elif style == "slab":
        yield both(box(depth * 0.95, leg, (0, seat)).at(0, y), "y")
        if p.chance(0.4):
            yield box(leg * 0.5, 2 * y, (0.3 * seat, 0.5 * seat))
    elif style == "trestle":
        for s in (-1, 1):
            yield box(0.35 * depth, leg, (0, seat)).at(0, s * y)
            yield box(depth * 0.9, leg * 1.2, (0, 0.12 * seat)).at(0, s * y)
        yield box(0.3 * leg, 2 * y, (0.35 * seat, 0.5 * seat))
    elif style == "hoop":
        path = [(x, 0, seat), (x, 0, 0.02), (-x, 0, 0.02), (-x, 0, seat)]
        yield both(tube(np.array(path), leg * 0.4).at(0, y), "y")
    else:
        yield box(depth * 0.9, length * (1 - 0.5 * p.inset), (0, seat))


@family(
    "bench",
    variants={"backless": 6, "park": 5, "settle": 2, "scrolled": 1},
    length=(1.15, 2.1), depth=(0.3, 0.66), seat=(0.28, 0.48), seat_thickness=(0.03, 0.1),
    slat_gap=(0.1, 0.35), leg=(0.04, 0.09), inset=(0.0, 0.22), splay=(0.0, 14.0),
    back=(0.22, 0.45), rake=(3.0, 20.0), arm=(0.16, 0.28), arm_width=(0.04, 0.09),
    scroll=(0.1, 0.3),
)  # fmt: skip
def bench(p: Draw) -> Iterable[Solid]:
    d, length, seat = p.depth, p.length, p.seat
    top = seat + p.seat_thickness
    if p.variant == "scrolled":  # one band, its ends rolled up
        y = length / 2
        line = smooth([(-y - 0.06, seat + p.scroll), (-y, seat + 0.7 * p.scroll), (-0.75 * y, seat),
                       (0, seat + 0.02), (0.75 * y, seat), (y, seat + 0.7 * p.scroll),
                       (y + 0.06, seat + p.scroll)], 30)  # fmt: skip
        outline = np.concatenate([line, (line + np.array([0, p.seat_thickness]))[::-1]])
        yield extrude(outline, d, "x")
        yield from _supports(p, d, 1.5 * y, seat)
        return

    yield from _seat(p, d, length, seat)
    yield from _supports(p, d, length, seat)
    if p.variant == "backless":
        if p.chance(0.2):
            yield both(box(d, 0.05, (top, top + 0.5 * p.arm)).at(0, length / 2 - 0.02), "y")
        return

    back = join(_back(p, length, p.back)).turned("y", p.rake)
    yield back.at(d / 2, 0, top)
    # posts that carry the back down to the seat, and arms
    lean = (d / 2 + p.back * np.sin(np.radians(p.rake)), p.back * np.cos(np.radians(p.rake)))
    for y in np.linspace(-1, 1, p.integer(2, 4)) * (length / 2 - 0.04):
        yield beam((d / 2, y, seat), (lean[0], y, top + lean[1]), 0.04, 0.03)
    if p.variant == "settle":
        yield both(box(d, 0.04, (0, top + p.arm)).at(0, length / 2), "y")
        yield both(box(d + 0.04, p.arm_width, (top + p.arm, top + p.arm + 0.03)).at(0, length / 2),
                   "y")  # fmt: skip
    elif p.chance(0.6):
        y, z = length / 2 - 0.03, top + p.arm
        yield both(rod((-d / 2 + 0.04, y, seat), (-d / 2 + 0.04, y, z), 0.02, 8), "y")
        yield both(box((-d / 2, d / 2 + 0.03), p.arm_width, (z, z + 0.03)).at(0, y), "y")
    if p.chance(0.1):
        yield cylinder(0.03, (0, seat), 10)
