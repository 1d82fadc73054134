"""Sofas: the back at +x, the long side along y."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import circle
from renderers.shapes.solids import Solid, box, extrude, four, rounded_box


def cushion(p: Draw, x: tuple[float, float], y: tuple[float, float], z: tuple[float, float],
            soft: float) -> Solid:  # fmt: skip
    """A seat or back cushion; ``soft`` is its edge radius over its thickness."""
    least = min(b - a for a, b in (x, y, z))
    return rounded_box(x, y, z, soft * least, steps=2) if soft > 0.05 else box(x, y, z)


@family(
    "sofa",
    variants={"block": 4, "legged": 3, "rolled": 2.5, "sectional": 3, "armless": 1, "single": 1.5},
    length=(1.7, 2.6), depth=(0.8, 1.05), seat=(0.34, 0.48), height=(0.62, 0.95),
    arm=(0.08, 0.26), arm_height=(0.02, 0.26), back=(0.1, 0.26), pillow=(0.1, 0.2),
    soft=(0.0, 0.45), legs=(0.0, 0.16), rake=(0.0, 0.2), chaise=(0.45, 0.9),
)  # fmt: skip
def sofa(p: Draw) -> Iterable[Solid]:
    """Base, back, arms, seat and back cushions; a sectional has a chaise towards −x."""
    length = p.length * (0.55 if p.variant == "single" else 1.0)
    depth = p.depth
    x0, x1 = -depth / 2, depth / 2
    floor = max(p.legs, 0.1) if p.variant == "legged" else p.legs * p.choice((0, 0.5))
    arm = 0.0 if p.variant == "armless" else p.arm
    arms = p.choice((0, 1)) if p.variant == "sectional" else 2
    seat_top = p.seat
    base_top = floor + (seat_top - floor) * (0.45 if p.chance(0.8) else 0.8)
    y0, y1 = -length / 2, length / 2
    # base
    yield box((x0, x1), (y0, y1), (floor, base_top))
    # back, raked: its top leans towards +x
    lean = p.rake * (p.height - floor) * 0.6
    outline = np.array([
        (x1 - p.back, floor), (x1, floor), (x1 + lean, p.height), (x1 - p.back + lean, p.height),
    ])  # fmt: skip
    yield extrude(outline, (y0, y1), "y")
    # arms
    top = min(seat_top + p.arm_height, p.height)
    sides = [(y0, 1), (y1, -1)] if arms == 2 else [(y0, 1)] if arms else []
    for edge, inward in sides:
        a, b = sorted((edge, edge + inward * arm))
        if arm == 0:
            continue
        if p.variant == "rolled":
            yield box((x0, x1), (a, b), (floor, top - arm * 0.5))
            centre = np.array([edge + inward * arm * 0.4, top - arm * 0.4])
            roll = circle(arm * 0.62, 16) + centre
            yield extrude(roll, (x0 - 0.01, x1 - p.back * 0.5), "x")
        elif p.soft > 0.25:
            yield rounded_box((x0, x1), (a, b), (floor, top), arm * 0.3)
        else:
            yield box((x0, x1), (a, b), (floor, top))
    # cushions
    inner0 = y0 + (arm if arms else 0)
    inner1 = y1 - (arm if arms == 2 else 0)
    count = 1 if p.variant == "single" else p.integer(2, 4)
    pillow = p.pillow if p.chance(0.75) else 0.0
    seat_edge = x1 - p.back
    step = (inner1 - inner0) / count
    crown = min(p.height + 0.05, seat_top + (p.height - seat_top) * 1.05)
    for i in range(count):
        span = (inner0 + i * step + 0.005, inner0 + (i + 1) * step - 0.005)
        yield cushion(p, (x0 - 0.01, seat_edge), span, (base_top, seat_top), p.soft)
        if pillow:
            part = cushion(p, (seat_edge - pillow, seat_edge), span, (seat_top, crown), p.soft)
            rake = p.rake * 0.6
            base = seat_top

            def leaning(v: np.ndarray, rake: float = rake, base: float = base) -> np.ndarray:
                v[:, 0] += rake * (v[:, 2] - base)
                return v

            yield part.warped(leaning)
    if p.chance(0.25):
        yield from _throw_pillows(p, seat_edge - pillow, inner0, inner1, seat_top)
    if floor > 0.02:
        thick = 0.03 + 0.03 * p.soft
        inset = 0.05
        post = box((-thick, thick), (-thick, thick), (0, floor))
        yield four(post.at(depth / 2 - inset - thick, length / 2 - inset - thick))
    if p.variant == "sectional":
        yield from _chaise(p, x0, y0, y1, floor, base_top)


def _throw_pillows(p: Draw, x: float, y0: float, y1: float, z: float) -> Iterable[Solid]:
    side = 0.4 * (p.height - z) + 0.15
    for y in (y0 + side * 0.55, y1 - side * 0.55):
        part = rounded_box(0.1, side, side, 0.05, steps=2).turned("y", 15)
        yield part.at(x - 0.08, y, z + side / 2)


def _chaise(
    p: Draw, x0: float, y0: float, y1: float, floor: float, base_top: float
) -> Iterable[Solid]:
    wide = (y1 - y0) * (0.28 + 0.1 * p.soft)
    reach = p.chaise * p.depth
    at_end = p.chance(0.5)
    span = (y1 - wide, y1) if at_end else (y0, y0 + wide)
    yield box((x0 - reach, x0), span, (floor, base_top))
    yield cushion(p, (x0 - reach, x0), span, (base_top, p.seat), p.soft)
    if p.chance(0.3):  # a true corner: the chaise has a back of its own along its outer side
        edge = y1 if at_end else y0
        side = (edge - p.back, edge) if at_end else (edge, edge + p.back)
        yield box((x0 - reach, x0 + p.depth), side, (floor, p.height))
