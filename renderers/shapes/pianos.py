"""Pianos: the keys at +x, the strings towards −x, the width along y."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import smooth
from renderers.shapes.solids import Solid, beam, both, box, cylinder, extrude, revolve


@family(
    "piano",
    variants={"upright": 5, "console": 2, "grand": 5, "square": 1},
    width=(1.3, 1.55), height=(0.95, 1.4), depth=(0.34, 0.55), shelf=(0.18, 0.36),
    key_level=(0.5, 0.68), length=(1.4, 2.5), case=(0.2, 0.36), lid=(20.0, 42.0),
    tail=(0.25, 0.5), leg=(0.05, 0.11), board=(0.02, 0.06), bench=(0.18, 0.45),
    stand=(0.12, 0.3), waist=(0.45, 0.7),
)  # fmt: skip
def piano(p: Draw) -> Iterable[Solid]:
    """Uprights, low consoles, grands with open or closed lids, square pianos; some with a bench."""
    edge = 0.21
    if p.variant in ("upright", "console"):
        edge = p.shelf
        yield from _upright(p, edge)
    elif p.variant == "grand":
        yield from _grand(p, edge)
    else:
        yield from _square(p, edge)
    if p.chance(0.4):
        half, level = p.width * 0.27, 0.46
        low, high = edge + p.bench - 0.1, edge + p.bench + 0.25
        yield box((low, high), 2 * half, (level - 0.08, level))
        for x in (low + 0.03, high - 0.03):
            yield both(beam((x, half - 0.04, level), (x, half - 0.04, 0), 0.05, 0.05), "y")


def _upright(p: Draw, edge: float) -> Iterable[Solid]:
    half, deep = p.width / 2, p.depth
    tall = p.height * (0.75 if p.variant == "console" else 1.0)
    keys = min(0.6 + 0.15 * (p.key_level - 0.5), tall * 0.72)
    yield box((-deep, 0), 2 * half, (0, tall))
    if p.chance(0.6):
        yield box((-deep - 0.02, 0.04), 2 * half + 0.05, (tall, tall + p.board))
    thick = 0.1 + p.case * 0.3
    yield box((0, edge), 2 * half, (keys - thick, keys))
    if p.chance(0.7):
        yield box((edge * 0.35, edge * 0.95), 2 * half - 0.2, (keys, keys + 0.02))
    cheek = [
        (0, keys - thick), (edge, keys - thick), (edge, keys + 0.03), (edge * 0.3, keys + 0.12),
        (0, keys + 0.15),
    ]  # fmt: skip
    yield both(extrude(cheek, (half - 0.07, half), "y"), "y")
    style = p.choice(("legs", "sides", "none"))
    if style == "legs":
        leg = beam((edge - p.leg, half - p.leg, keys - thick), (edge - p.leg, half - p.leg, 0),
                   p.leg, p.leg, taper=0.7)  # fmt: skip
        yield both(leg, "y")
        yield both(box((0, edge), (half - p.leg * 1.5, half - p.leg * 0.5), (0, 0.08)), "y")
    elif style == "sides":
        yield both(box((0, edge * 0.9), (half - 0.06, half), (0, keys - thick)), "y")
    if p.chance(0.5):
        panel = box((0, 0.02), 2 * half - 0.25, (0.12, keys - thick - 0.05))
        yield panel
    if p.chance(0.4):
        yield beam((0.08, 0, keys + 0.1), (0.02, 0, keys + 0.1 + p.stand), p.width * 0.4, 0.02)
    for y in (-0.09, 0.09):
        if p.chance(0.5):
            yield box((0, 0.12), (y - 0.02, y + 0.02), (0.05, 0.07))


def _rim(p: Draw) -> np.ndarray:
    """A grand's outline in the plane: keys along x = 0, the straight side at −y, the bend at +y."""
    half, long = p.width / 2, p.length
    tail = -half + p.width * p.tail
    bent = smooth([
        (-0.32 * long, half), (-p.waist * 0.75 * long, half * 0.55 + tail * 0.25),
        (-0.82 * long, tail + 0.12), (-0.96 * long, tail - 0.12), (-long, (tail - half) / 2 - 0.1),
        (-0.95 * long, -half + 0.08), (-0.88 * long, -half),
    ], 26)  # fmt: skip
    return np.concatenate([[(0.0, -half), (0.0, half), (-0.2 * long, half)], bent])


def _grand(p: Draw, edge: float) -> Iterable[Solid]:
    rim = _rim(p)
    half = p.width / 2
    low = 0.62
    top = low + p.case
    yield extrude(rim, (low, top))
    yield box((-0.02, edge), 2 * half, (low, low + p.case * 0.45))
    yield both(box((0, edge), (half - 0.07, half), (low, low + p.case * 0.75)), "y")
    lid = extrude(rim * (0.99, 1.0), (0, p.board))
    state = p.choice(("open", "open", "closed", "none"))
    if state == "open":
        front = -0.22 * p.length
        outline = np.concatenate([[(front, -half), (front, half)], rim[rim[:, 0] < front]])
        raised = extrude(outline, (0, p.board)).at(y=half).turned("x", p.lid).at(y=-half, z=top)
        yield raised
        prop = (front - 0.15, half * 0.6, top)
        rise = np.tan(np.radians(p.lid)) * half * 1.5
        yield beam(prop, (front - 0.15, half * 0.5, top + rise), 0.02, 0.02)
        if p.chance(0.5):
            yield box((front, 0), 2 * half, (top, top + p.board))
    elif state == "closed":
        yield lid.at(z=top)
    if p.chance(0.6):
        yield beam((-0.15, 0, top), (-0.22, 0, top + p.stand), p.width * 0.45, 0.02)
    spots = [(-0.15, half - 0.15), (-0.15, -half + 0.15), (-0.82 * p.length, -half * 0.55)]
    round_leg = p.chance(0.5)
    for x, y in spots:
        if round_leg:
            profile = smooth(
                [(p.leg * 0.5, 0), (p.leg * 0.45, 0.2), (p.leg, 0.5), (p.leg * 1.1, low)], 8
            )
            yield revolve(np.concatenate([[(0, 0)], profile]), 12).at(x, y)
        else:
            yield beam((x, y, low), (x, y, 0), p.leg * 1.6, p.leg * 1.6, taper=0.65)
    if p.chance(0.7):
        yield box((-0.3, -0.26), 0.2, (0.08, low))
        yield box((-0.3, -0.1), 0.24, (0.06, 0.12))


def _square(p: Draw, edge: float) -> Iterable[Solid]:
    """A rectangular case on four legs, the keys in a recess or on a ledge."""
    half, deep = p.width / 2, p.length * 0.45
    low = 0.55
    top = low + p.case
    yield box((-deep, 0), 2 * half, (low, top))
    yield box((0, edge), 2 * half * 0.95, (low, low + p.case * 0.4))
    for x in (-deep + 0.1, edge - 0.1):
        yield both(cylinder(p.leg * 0.6, (0, low), 10, top=p.leg).at(x, half - 0.12), "y")
    if p.chance(0.5):
        yield box((-deep, 0.02), 2 * half + 0.03, (top, top + p.board))
