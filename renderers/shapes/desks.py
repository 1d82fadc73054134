"""Desks: long along y, the user sits at −x, drawers open to −x."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import numpy as np

from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import Extent, span
from renderers.shapes.solids import Solid, beam, both, box, cylinder, join


def _pedestal(p: Draw, x: Extent, y: Extent, z: tuple[float, float], hollow: bool) -> Solid:
    """A block of drawers with its fronts at −x."""
    (x0, x1), (y0, y1) = span(x), span(y)
    panel = p.panel
    parts = []
    if hollow:
        parts += [
            box((x0, x1), (y0, y0 + panel), z), box((x0, x1), (y1 - panel, y1), z),
            box((x1 - panel, x1), (y0, y1), z), box((x0, x1), (y0, y1), (z[0], z[0] + panel)),
        ]  # fmt: skip
    else:
        parts.append(box((x0, x1), (y0, y1), z))
    edges = np.linspace(*z, p.integer(2, 4) + 1)
    pulled = p.integer(0, len(edges) - 2) if p.chance(0.12) else -1
    for row, (low, high) in enumerate(pairwise(edges)):
        out = p.drawer_out if row == pulled else 0.0
        front = x0 - out
        parts.append(box((front - 0.012, front), (y0 + 0.008, y1 - 0.008),
                         (low + 0.006, high - 0.006)))  # fmt: skip
        handle = box((front - 0.03, front - 0.012), (y1 - y0) * p.grip, 0.016)
        parts.append(handle.at(0, (y0 + y1) / 2, (low + high) / 2))
        if out or hollow:
            floor = box((front, x1 - 0.05), (y0 + 0.02, y1 - 0.02), (low + 0.01, low + 0.016))
            parts.append(floor)
    return join(parts)


def _leg(p: Draw, x: float, y: float, height: float) -> Solid:
    if p.leg_round > 0.5:
        return cylinder(p.leg / 2 * p.leg_taper, (0, height), 12, p.leg / 2).at(x, y)
    return beam((x, y, height), (x, y, 0), p.leg, p.leg, p.leg_taper)


def _hutch(p: Draw, x: tuple[float, float], width: float, z: float) -> Iterable[Solid]:
    """Shelves that stand on the back of the top."""
    x0, x1 = x[1] - 0.25 * (x[1] - x[0]) - 0.05, x[1]
    high = z + p.hutch
    yield both(box((x0, x1), p.panel, (z, high)).at(0, (width - p.panel) / 2), "y")
    yield box((x0, x1), width, (high, high + p.panel))
    if p.chance(0.7):
        yield box((x1 - 0.01, x1), width, (z, high))
    for level in range(p.integer(0, 2)):
        shelf = z + p.hutch * (0.4 + 0.3 * level)
        yield box((x0, x1), width, (shelf, shelf + p.panel))
    for y in np.linspace(-width / 2, width / 2, p.integer(2, 4) + 1)[1:-1]:
        yield box((x0, x1), p.panel, (z, high)).at(0, y)


@family(
    "desk",
    variants={"double_pedestal": 4, "single_pedestal": 4, "writing": 4, "panel": 2, "corner": 2,
              "hutch": 2},
    width=(1.15, 1.9), depth=(0.5, 0.95), height=(0.6, 0.86), top=(0.02, 0.07),
    overhang=(0.0, 0.05), pedestal=(0.2, 0.32), clearance=(0.0, 0.16), panel=(0.015, 0.04),
    leg=(0.035, 0.08), leg_taper=(0.6, 1.0), leg_round=(0.0, 1.0), modesty=(0.25, 0.95),
    grip=(0.2, 0.6), drawer_out=(0.1, 0.3), hutch=(0.3, 0.65), wing=(0.45, 0.95),
)  # fmt: skip
def desk(p: Draw) -> Iterable[Solid]:
    w, d, h = p.width, p.depth, p.height
    under, hollow = h - p.top, p.chance(0.5)
    inner_x, inner_w = d / 2 - p.overhang, w - 2 * p.overhang
    block = inner_w * p.pedestal
    yield box(d, w, (under, h))

    def unit(side: int, low: float) -> Solid:
        y = side * (inner_w - block) / 2
        return _pedestal(p, 2 * inner_x, (y - block / 2, y + block / 2), (low, under), hollow)

    side = p.choice((-1, 1))
    far = inner_w / 2 - p.leg / 2
    legs = [_leg(p, x, -side * far, under) for x in (-inner_x + p.leg / 2, inner_x - p.leg / 2)]
    drawer_low = under - 0.14
    style = p.variant
    if style == "hutch":
        yield from _hutch(p, (-d / 2, d / 2), w, h)
        style = p.choice(("single_pedestal", "double_pedestal", "panel"))

    if style == "double_pedestal":
        yield unit(1, p.clearance)
        yield unit(-1, p.clearance)
        if p.chance(0.5):
            yield box(2 * inner_x, inner_w - 2 * block, (drawer_low + 0.04, under))
    elif style == "single_pedestal":
        yield unit(side, p.clearance if p.chance(0.6) else 0.45 * h)
        if p.chance(0.5):
            yield box(2 * inner_x, p.panel, (0, under)).at(0, -side * (inner_w - p.panel) / 2)
        else:
            yield from legs
        if p.clearance > 0.03:
            yield from (_leg(p, x, side * far, under) for x in (p.leg - inner_x, inner_x - p.leg))
    elif style == "writing":
        yield from legs
        yield from (_leg(p, x, side * far, under) for x in (p.leg / 2 - inner_x,
                                                            inner_x - p.leg / 2))  # fmt: skip
        apron = box(2 * inner_x - 0.02, inner_w - 0.02, (drawer_low, under))
        bare = p.chance(0.35)  # nothing but its place tells it from a table
        if bare:
            yield box(2 * inner_x - 0.02, inner_w - 0.02, (under - 0.05, under))
        elif p.chance(0.6):
            yield apron
            for y in (-1, 0, 1):
                yield box((-inner_x - 0.015, -inner_x), inner_w * 0.3,
                          (drawer_low + 0.01, under - 0.01)).at(0, y * inner_w * 0.32)  # fmt: skip
        else:
            yield unit(side, under - 0.3 * h)
            yield both(box(p.leg * 0.5, inner_w, (under - 0.07, under)).at(inner_x - p.leg / 2))
        if p.chance(0.3):
            yield both(box(2 * inner_x, p.leg * 0.6, (0.1, 0.13)).at(0, far), "y")
    else:  # panel, corner
        yield both(box(2 * inner_x, p.panel, (0, under)).at(0, (inner_w - p.panel) / 2), "y")
        if p.chance(0.5):
            yield unit(side, 0.0)
    if p.chance(0.4 if style == "writing" else 0.75):
        yield box((inner_x - p.panel, inner_x), inner_w, (under * (1 - p.modesty), under))

    if p.variant == "corner":  # the return, towards the user along one side
        reach = p.wing
        at_y = side * (w / 2 - d * 0.4)
        x = (-d / 2 - reach, -d / 2)
        yield box(x, d * 0.8, (under, h)).at(0, at_y)
        if p.chance(0.5):
            across = (at_y - d * 0.36, at_y + d * 0.36)
            end = (x[0] + 0.02, x[0] + block + 0.1)
            yield _pedestal(p, end, across, (p.clearance, under), hollow)
        else:
            yield both(box(p.panel, d * 0.76, (0, under)), "y").at(x[0] + p.panel, at_y)
        yield box(x, p.panel, (under * (1 - p.modesty), under)).at(0, side * (w / 2 - p.panel))
