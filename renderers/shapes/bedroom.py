"""Beds (headboard at +y) and dressers (long along y, drawers open to −x)."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import numpy as np

from renderers.shapes.family import Draw, family
from renderers.shapes.solids import (
    Solid,
    both,
    box,
    cylinder,
    ellipsoid,
    extrude,
    four,
    join,
    rounded_box,
    sheet,
)


def _pillows(p: Draw, width: float, y: float, z: float) -> Iterable[Solid]:
    each = width * (0.42 if width > 0.5 else 0.75)
    pillow = ellipsoid(each / 2, 0.09, 0.035 + 0.03 * p.softness, 12)
    lean = p.uniform(0, 50)
    for x in (-width / 4, width / 4) if width > 0.5 else (0.0,):
        yield pillow.turned("x", lean).at(x, y - 0.11, z + 0.03 + 0.07 * np.sin(np.radians(lean)))


def _blanket(p: Draw, width: float, z: float) -> Solid:
    """A cover over the mattress that hangs down at the sides and the foot."""
    w, drop = width / 2 + 0.012, p.drape
    across = [(-w, z - drop), (-w, z + 0.01), (0.0, z + 0.015), (w, z + 0.01), (w, z - drop)]
    along = np.linspace(-0.5, p.uniform(0.05, 0.3), 6)
    return sheet([[(x, y, height) for x, height in across] for y in along])


def _headboard(p: Draw, width: float, base: float, top: float, thick: float) -> Iterable[Solid]:
    y = (0.5, 0.5 + thick)
    style = p.choice(("panel", "panel", "slats", "arch", "cushion"))
    if style == "panel":
        board = box(width, thick, (base, top))
    elif style == "slats":
        yield box(width, thick, (top - 0.05, top))
        yield both(box(thick, thick, (base, top)).at((width - thick) / 2, 0.5 + thick / 2))
        bars = p.integer(5, 12)
        for x in np.linspace(-width / 2, width / 2, bars + 2)[1:-1]:
            yield box(0.018, 0.018, (base, top)).at(x, 0.5 + thick / 2)
        board = box(width, thick, (base, base + 0.06))
    elif style == "arch":
        x = np.linspace(-width / 2, width / 2, 13)
        crown = top + 0.25 * (top - base) * np.sqrt(np.clip(1 - (2 * x / width) ** 2, 0, 1))
        outline = [(-width / 2, base), (width / 2, base), *zip(x[::-1], crown[::-1], strict=True)]
        yield extrude(outline, y, "y")
        return
    else:
        board = rounded_box(width, thick * 1.8, (base, top), 0.05)
    yield board.turned("x", -p.rake).at(y=0.5 + thick / 2)


@family(
    "bed",
    variants={"frame": 10, "platform": 6, "divan": 4, "four_poster": 1, "bunk": 1},
    width=(0.5, 1.0), mattress=(0.06, 0.14), base=(0.04, 0.14), clearance=(0.0, 0.12),
    head=(0.06, 0.3), foot=(0.0, 0.14), board=(0.02, 0.06), overhang=(0.0, 0.05),
    softness=(0.1, 1.0), drape=(0.02, 0.2), rake=(0.0, 12.0), post=(0.02, 0.05),
    canopy=(0.5, 0.95), night_table=(0.2, 0.36),
)  # fmt: skip
def bed(p: Draw) -> Iterable[Solid]:
    w = p.width
    low = 0.02 if p.variant == "divan" else p.clearance
    deck = low + p.base
    top = deck + p.mattress
    radius = 0.01 + 0.05 * p.softness

    if p.variant == "bunk":
        w = 0.38 + 0.25 * (p.width - 0.5)
        upper = deck + p.canopy * 0.8 + 0.1
        yield four(box(p.post, p.post, (0, upper + p.mattress + 0.12)).at(w / 2, 0.5))
        for z in (deck, upper):
            yield box(w, 1.0, (z - 0.04, z))
            yield rounded_box(w - 0.02, 0.97, (z, z + p.mattress), radius)
            yield from _pillows(p, w, 0.48, z + p.mattress)
        for z in (upper + p.mattress + 0.02, upper + p.mattress + 0.1):
            yield both(box(0.02, 1.0, 0.03).at(w / 2, 0, z))
            yield both(box(w, 0.02, 0.03).at(0, 0.5, z), "y")
        for y in (-0.45, -0.25):
            yield box(0.02, 0.02, (0, upper)).at(w / 2 + 0.02, y)
        for z in np.linspace(0, upper, 7)[1:]:
            yield box(0.02, 0.2, 0.015).at(w / 2 + 0.02, -0.35, z)
        return

    # mattress, pillows, cover
    yield rounded_box(w, 1.0, (deck, top), radius)
    if p.chance(0.75):
        yield from _pillows(p, w, 0.5, top)
    if p.chance(0.5):
        yield _blanket(p, w, top)

    # frame
    side = w + 2 * p.overhang
    yield box(side, 1 + p.overhang, (low, deck))
    if p.variant == "platform":
        yield box(side * 0.86, 0.88, (0, max(low, 0.02)))
    elif low > 0.03 and p.variant != "divan":
        leg = p.post * 1.3
        yield four(box(leg, leg, (0, low)).at(side / 2 - leg / 2, 0.5 - leg / 2))

    # boards
    board = side + 0.02
    if p.variant != "divan" or p.chance(0.6):
        wide = board * (1.0 if p.chance(0.75) else p.uniform(1.2, 1.5))
        start = 0.0 if p.chance(0.6) else low
        yield from _headboard(p, min(wide, 1.35), start, top + p.head, p.board)
    if p.variant == "frame":
        yield box(board, p.board, (0, deck + 0.02 + p.foot)).at(y=-0.5 - p.board / 2)
    elif p.variant == "four_poster":
        height = top + p.canopy
        yield four(cylinder(p.post, (0, height), 10, p.post * 0.7).at(side / 2, 0.5))
        yield both(box(p.post, 1.0, p.post).at(side / 2, 0, height))
        yield both(box(side, p.post, p.post).at(0, 0.5, height), "y")
        if p.chance(0.4):
            yield sheet([[(-side / 2, y, height), (side / 2, y, height)] for y in (-0.5, 0.5)])
    if p.variant in ("platform", "frame", "divan") and p.chance(0.15):
        size = p.night_table
        table = box(size, size, (0.02, top)).at(side / 2 + size / 2 + 0.02, 0.5 - size / 2)
        yield both(table) if p.chance(0.6) else table


def _drawer(
    p: Draw, x: float, y: tuple[float, float], z: tuple[float, float], depth: float, hollow: bool
) -> Iterable[Solid]:
    """A drawer front standing proud at x, its handle, and its box behind when it is hollow."""
    front = p.proud
    yield box((x - front, x), y, z)
    middle, height = (y[0] + y[1]) / 2, (z[0] + z[1]) / 2
    long = (y[1] - y[0]) * p.handle
    if p.handle_style < 0.5:
        yield box((x - front - 0.025, x - front), (middle - long / 2, middle + long / 2),
                  (height - 0.01, height + 0.01))  # fmt: skip
    elif p.handle_style < 0.85:
        for at in (-1, 1) if y[1] - y[0] > 0.4 else (0,):
            knob = ellipsoid(0.018, 0.018, 0.018, 8)
            yield knob.at(x - front - 0.015, middle + at * long / 2, height)
    if hollow:
        y0, y1 = y[0] + 0.02, y[1] - 0.02
        back, (z0, z1) = x + depth * 0.9, (z[0] + 0.01, z[1] - 0.03)
        yield box((x, back), (y0, y1), (z0, z0 + 0.008))
        for side in (y0, y1):
            yield box((x, back), (side - 0.005, side + 0.005), (z0, z1))
        yield box((back - 0.008, back), (y0, y1), (z0, z1))


@family(
    "dresser",
    variants={"chest": 4, "wide": 3, "legged": 3, "with_mirror": 1, "small": 3},
    width=(0.62, 1.0), height=(0.78, 1.5), depth=(0.36, 0.6), panel=(0.012, 0.04),
    top=(0.012, 0.04), top_overhang=(0.0, 0.04), plinth=(0.02, 0.08), legs=(0.06, 0.2),
    leg_size=(0.025, 0.06), gap=(0.008, 0.025), proud=(0.004, 0.025), handle=(0.12, 0.5),
    handle_style=(0.0, 1.0), mirror=(0.4, 0.7),
)  # fmt: skip
def dresser(p: Draw) -> Iterable[Solid]:
    w, h, d = p.width, p.height, p.depth
    if p.variant in ("wide", "with_mirror"):
        w, h = w + 0.35, 0.62 + 0.3 * (h - 0.78)
    elif p.variant == "small":  # near a night stand's measures
        w, h = 0.75 * w, 0.68 * h
    legged = p.variant == "legged" or (p.variant == "small" and p.chance(0.5))
    base = p.legs if legged else p.plinth
    x, hollow = -d / 2, p.chance(0.5)

    # carcass: solid, or panels round an empty inside
    if hollow:
        yield both(box(d, p.panel, (base, h)).at(0, w / 2 - p.panel / 2), "y")
        yield box((d / 2 - 0.01, d / 2), w, (base, h))
        yield box(d, w, (base, base + p.panel))
    else:
        yield box(d, w, (base, h))
    yield box(d + 2 * p.top_overhang, w + 2 * p.top_overhang, (h, h + p.top))
    if legged:
        leg = box(p.leg_size, p.leg_size, (0, base))
        yield four(leg.at(d / 2 - p.leg_size / 2, w / 2 - p.leg_size / 2))
        if p.chance(0.4):
            yield box((x, x + 0.02), w, (base - 0.05, base))
    else:
        inset = p.uniform(0, 0.04)
        yield box(d - inset, w - inset, (0, base))

    # drawers
    rows = p.integer(2, 4) if p.variant in ("wide", "with_mirror", "small") else p.integer(3, 6)
    edge = np.linspace(base + p.panel, h - 0.01, rows + 1)
    if p.chance(0.4):  # deeper drawers lower down
        edge = base + p.panel + (h - 0.01 - base - p.panel) * np.linspace(0, 1, rows + 1) ** 0.85
    columns = p.integer(2, 3) if p.variant in ("wide", "with_mirror") else p.choice((1, 1, 2))
    split_top = columns == 1 and p.chance(0.4)
    pulled = p.integer(0, rows - 1) if p.chance(0.1) else -1
    for row, (z0, z1) in enumerate(pairwise(edge)):
        n = 2 if split_top and row == rows - 1 else columns
        side = np.linspace(-w / 2 + p.panel, w / 2 - p.panel, n + 1)
        for y0, y1 in pairwise(side):
            out = d * 0.4 if row == pulled else 0.0
            yield join(_drawer(p, x - out, (y0 + p.gap / 2, y1 - p.gap / 2),
                               (z0 + p.gap / 2, z1 - p.gap / 2), d, hollow or out > 0))  # fmt: skip

    if p.variant == "with_mirror":
        back = d / 2 - 0.02
        yield both(box((back, back + 0.02), 0.03, (h, h + p.mirror)).at(0, 0.36 * w), "y")
        yield box((back - 0.01, back + 0.01), 0.68 * w, (h + 0.06, h + p.mirror + 0.04))
