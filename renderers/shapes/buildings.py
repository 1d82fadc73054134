"""Stairs and tents."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import smooth
from renderers.shapes.solids import (
    Solid,
    beam,
    box,
    cylinder,
    extrude,
    join,
    ring,
    rod,
    sheet,
    tube,
)


@family(
    "stairs",
    variants={"straight": 5, "open": 2, "spiral": 3, "angled": 3, "landing": 1, "return": 1},
    tread=(0.22, 0.32), riser=(0.14, 0.21), width=(0.7, 1.5), slab=(0.02, 0.2), rail=(0.8, 1.05),
    bar=(0.02, 0.05), turn=(150.0, 380.0), inner=(0.06, 0.6), split=(0.35, 0.65),
    landing=(0.8, 1.4), stringer=(0.03, 0.09), steps=(7.0, 18.0),
)  # fmt: skip
def stairs(p: Draw) -> Iterable[Solid]:
    """Flights along x, up or down it; steps as wide as ``width`` along y."""
    count = int(p.steps)
    if p.variant == "spiral":
        solid = join(_spiral(p, count))
    elif p.variant in ("straight", "open", "landing"):
        solid = join(_straight(p, count))
    else:
        solid = join(_turning(p, count))
    if p.chance(0.5):
        solid = solid.mirrored("x")
    if p.chance(0.5):
        solid = solid.mirrored("y")
    yield solid


def _profile(p: Draw, count: int, under: str) -> NDArray[np.float64]:
    """The side of a flight that climbs towards +x: "ground", "slab" or "steps" below."""
    t, r = p.tread, p.riser
    top = np.array([((i + k) * t, (i + 1) * r) for i in range(count) for k in (0, 1)])
    if under == "ground":
        return np.concatenate([[(0, 0)], top, [(count * t, 0)]])
    thick = max(p.slab, 0.03)
    if under == "slab":
        return np.concatenate([[(0, 0)], top, [(count * t, count * r - r - thick), (t, -0.0)]])
    low = top[::-1] + np.array([thick * 0.5, -thick])
    return np.concatenate([[(0, 0)], top, low[:-1], [(thick * 0.5, 0)]])


def flight(p: Draw, count: int, style: str) -> Iterable[Solid]:
    """Steps climbing towards +x from the origin."""
    t, r, half = p.tread, p.riser, p.width / 2
    if style == "open":
        for i in range(count):
            yield box((i * t - 0.02, i * t + t), 2 * half, ((i + 1) * r - p.bar, (i + 1) * r))
        s = p.stringer
        ends = ((0, 0), (count * t, count * r))
        for y in (-half + s, half - s) if p.chance(0.7) else (0.0,):
            (x0, z0), (x1, z1) = ends
            yield beam((x0, y, z0), (x1, y, z1 - r * 0.5), s, s * 2)
    else:
        yield extrude(_profile(p, count, style), 2 * half, "y")


def railing(p: Draw, start: NDArray, end: NDArray, panel: bool) -> Iterable[Solid]:
    """A hand rail from start to end, on posts or a panel."""
    up = np.array([0, 0, p.rail])
    yield rod(start + up, end + up, p.bar, 8)
    if panel:
        grid = np.array([[start + up * 0.1, end + up * 0.1], [start + up, end + up]])
        yield sheet(grid)
        return
    count = max(2, round(float(np.linalg.norm(end - start)) / 0.3))
    for f in np.linspace(0, 1, count):
        foot = start + (end - start) * f
        yield rod(foot, foot + up, p.bar * 0.5, 6)


def _straight(p: Draw, count: int) -> Iterable[Solid]:
    style = "open" if p.variant == "open" else p.choice(("steps", "steps", "slab", "ground"))
    count = count + p.choice((0, 6))
    run, rise, half = count * p.tread, count * p.riser, p.width / 2
    yield from flight(p, count, style)
    rails = p.choice((0, 0, 1, 2))
    panel = p.chance(0.3)
    for y in (-half, half)[:rails]:
        yield from railing(p, np.array([0, y, p.riser]), np.array([run, y, rise]), panel)
    if p.variant == "landing":
        yield box((run, run + p.landing * 1.5), 2 * half * p.choice((1, 2)), (rise - 0.1, rise))
        yield box((run + p.landing * 0.5, run + p.landing * 0.7), 0.2, (0, rise - 0.1))


def _turning(p: Draw, count: int) -> Iterable[Solid]:
    """Two flights at a right angle, or back beside the first."""
    style = p.choice(("steps", "slab", "ground", "open"))
    first = max(3, round(count * p.split))
    second = max(3, count - first)
    half = p.width / 2
    rise = first * p.riser
    lower = join(flight(p, first, style))
    upper = join(flight(p, second, style))
    run = first * p.tread
    if p.variant == "angled":
        # the first flight climbs towards +y, the second towards +x
        yield lower.turned("z", 90).at(y=-half - run)
        yield box(2 * half, 2 * half, (rise - 0.1, rise))
        yield upper.at(x=half, z=rise)
        path = [
            ((half, -half - run, 0.1), (half, -half, rise)),
            ((half, half, rise), (half + second * p.tread, half, rise + second * p.riser)),
        ]
    else:
        yield lower.at(y=-half)
        yield box((run, run + 2 * half), 4 * half, (rise - 0.1, rise))
        yield upper.mirrored("x").at(x=run, y=half, z=rise)
        path = [
            ((0, 0, 0.1), (run, 0, rise)),
            ((run, 0, rise), (run - second * p.tread, 0, rise + second * p.riser)),
        ]
    if p.chance(0.6):
        for start, end in path:
            yield from railing(p, np.array(start), np.array(end), p.chance(0.5))
    if style == "ground" and p.chance(0.7):
        yield (
            box(2 * half, 2 * half, (0, rise))
            if p.variant == "angled"
            else box((run, run + 2 * half), 4 * half, (0, rise))
        )


def _spiral(p: Draw, count: int) -> Iterable[Solid]:
    """Wedge steps about a column or about an open eye."""
    count = round(count * 1.4)
    eye = p.inner if p.chance(0.5) else 0.08
    outer = eye + p.width
    step = np.radians(p.turn) / count
    rise = p.riser * p.choice((0.8, 1.0))
    thick = max(0.03, p.slab * 0.5)
    joined = p.chance(0.5)
    for i in range(count):
        a, b = i * step, (i + 1.15) * step
        corners = [(eye, a), (eye, b), (outer, b), (outer, (a + b) / 2), (outer, a)]
        wedge = [(r * np.cos(t), r * np.sin(t)) for r, t in corners]
        low = i * rise - (rise if joined else 0.0)
        yield extrude(wedge, (low, i * rise + thick))
    top = count * rise
    if eye < 0.1:
        yield cylinder(0.07, (-0.1, top + p.rail * p.choice((0, 1))), 12)
    if p.chance(0.65):
        turn = np.linspace(0, step * count, 40)
        helix = np.stack([outer * np.cos(turn), outer * np.sin(turn), turn / step * rise], 1)
        up = np.array([0, 0, p.rail])
        yield tube(helix + up, p.bar, 6)
        if p.chance(0.5):
            for foot in helix[::3]:
                yield rod(foot, foot + up, p.bar * 0.5, 5)
        else:
            yield sheet(np.stack([helix, helix + up]))


@family(
    "tent",
    variants={"ridge": 3, "dome": 2.5, "tunnel": 2, "house": 2.5, "marquee": 1.5, "canopy": 1,
              "wedge": 1, "yurt": 1.2, "pyramid": 0.8},
    length=(0.9, 2.1), height=(0.42, 1.0), wall=(0.15, 0.6), peak=(0.3, 0.85), sag=(0.0, 0.2),
    hip=(0.0, 0.35), eave=(0.0, 0.08), porch=(0.15, 0.5), flap=(0.15, 0.4), pole=(0.01, 0.03),
    power=(1.7, 3.0), skew=(-0.2, 0.2),
)  # fmt: skip
def tent(p: Draw) -> Iterable[Solid]:
    """The ridge along x; cloth is a single sheet."""
    half, deep, tall = p.length / 2, 0.5, p.height
    ground = p.chance(0.65)
    if p.variant == "ridge":
        yield from _ridge(p, half, deep, tall)
    elif p.variant == "wedge":
        top = half * p.skew * 2
        high, low = -half * p.peak + top, half * 0.3
        rim = np.array([
            (-half, -deep, 0), (half, -deep * 0.7, 0), (half, deep * 0.7, 0), (-half, deep, 0),
        ])  # fmt: skip
        ridge = np.array([
            (high, -0.1, tall), (low, -0.05, tall * 0.8),
            (low, 0.05, tall * 0.8), (high, 0.1, tall),
        ])  # fmt: skip
        middle = (rim + ridge) / 2
        middle[:, 2] += p.sag * 0.3
        yield sheet(np.stack([rim, middle, ridge]), wrap=True)
        yield sheet(np.stack([ridge[:2], ridge[[3, 2]]]))
    elif p.variant == "dome":
        f = np.linspace(0, 1, 9)
        sides = p.choice((4, 6, 24))
        if p.chance(0.3):
            half = deep
        turn = np.linspace(0, 2 * np.pi, sides, endpoint=False) + np.pi / sides
        grow = 1 / np.cos(np.pi / sides)
        radius = (1 - f**p.power) ** (1 / p.power)
        rings = np.stack([
            half * grow * radius[:, None] * np.cos(turn),
            deep * grow * radius[:, None] * np.sin(turn),
            np.broadcast_to(tall * f[:, None], (9, sides)),
        ], -1)  # fmt: skip
        yield sheet(rings, wrap=True)
    elif p.variant == "tunnel":
        a = np.linspace(0, np.pi, 17)
        c, s = np.cos(a), np.sin(a)
        bow = np.stack([np.sign(c) * np.abs(c) ** (2 / p.power) * deep,
                        s ** (2 / p.power) * tall], 1)  # fmt: skip
        xs = np.linspace(-half, half, 7)
        shrink = 1 - p.hip * np.abs(np.linspace(-1, 1, 7)) ** 3
        yield sheet(np.stack([np.column_stack([np.full(17, x), bow * k])
                              for x, k in zip(xs, shrink, strict=True)]))  # fmt: skip
        for x, k in ((-half, shrink[0]), (half, shrink[-1])):
            if p.chance(0.8):
                yield extrude(bow * k, (x - 0.002, x + 0.002), "x")
    elif p.variant == "house":
        yield from _house(p, half, deep, tall)
    elif p.variant == "pyramid":
        sides = p.choice((4, 4, 6, 8))
        turn = np.linspace(0, 2 * np.pi, sides, endpoint=False) + np.pi / sides
        f = np.linspace(0, 1, 7)[:, None]
        radius = deep / np.cos(np.pi / sides) * (1 - f) ** (1 + p.sag)
        yield sheet(np.stack([radius * np.cos(turn), radius * np.sin(turn),
                              np.broadcast_to(tall * f, (7, sides))], -1), wrap=True)  # fmt: skip
        half = deep
    else:
        if p.variant == "yurt":
            half = deep
        yield from _marquee(p, half, deep, tall)
        ground = ground and p.variant != "canopy"
    if ground:
        spread = 1 + (p.porch * 1.5 if p.chance(0.2) else 0.0)
        yield box(2 * half * spread, 2 * deep * spread, (-0.01, 0))
    if p.chance(0.25):
        for side in (-1, 1):
            peg = (side * (half + p.porch * 0.5), deep * 1.1, 0)
            yield rod((side * half * 0.9, deep * 0.3, tall * 0.8), peg, 0.006, 5)


def _ridge(p: Draw, half: float, deep: float, tall: float) -> Iterable[Solid]:
    low = p.wall * 0.3 * tall * p.choice((0, 1))
    top = half * (1 - p.hip)
    s = np.linspace(0, 1, 6)[:, None]
    for side in (-1, 1):
        foot = np.array(
            [(-half, side * deep, low), (0, side * deep, low), (half, side * deep, low)]
        )
        ridge = np.array([(-top, 0, tall), (0, 0, tall), (top, 0, tall)])
        rows = foot + (ridge - foot) * s[:, :, None]
        rows[..., 2] -= p.sag * tall * np.sin(np.pi * s)
        yield sheet(rows)
        if low:
            yield sheet(np.stack([foot * (1, 1, 0), foot]))
    for side in (-1, 1):
        if p.chance(0.75):
            foot_y = np.array([-deep, deep])
            corners = np.array([(side * half, y, low) for y in foot_y])
            peak = np.array([(side * top, 0, tall)] * 2)
            yield sheet(np.stack([corners, (corners * 0.5 + peak * 0.5), peak]))
    yield rod((-half - 0.02, 0, 0), (-top, 0, tall + 0.03), p.pole)
    yield rod((half + 0.02, 0, 0), (top, 0, tall + 0.03), p.pole)


def _house(p: Draw, half: float, deep: float, tall: float) -> Iterable[Solid]:
    """Upright walls under a gabled or hipped roof, sometimes with a porch."""
    wall = tall * (0.3 + 0.6 * p.wall)
    corners = np.array([(-half, -deep), (half, -deep), (half, deep), (-half, deep)])
    lean = 1 + p.flap * 0.4
    base = np.column_stack([corners * lean, np.zeros(4)])
    eaves = np.column_stack([corners, np.full(4, wall)])
    yield sheet(np.stack([base, eaves]), wrap=True)
    over = np.column_stack([corners * (1 + p.eave * 2), np.full(4, wall)])
    top = half * (1 - p.hip * 1.5)
    ridge = np.array([(-top, 0, tall), (top, 0, tall), (top, 0, tall), (-top, 0, tall)])
    yield sheet(np.stack([over, (over + ridge) / 2, ridge]), wrap=True)
    if p.chance(0.4):
        side = p.choice((-1, 1)) * 1.0
        reach = deep + p.porch
        posts = (-half * 0.5, half * 0.5)
        inner = [(x, side * deep, wall * 0.95) for x in posts]
        outer = [(x, side * reach, wall * 0.85) for x in posts]
        yield sheet([inner, outer])
        for x in posts:
            yield rod((x, side * reach, 0), (x, side * reach, wall * 0.85), p.pole)


def _marquee(p: Draw, half: float, deep: float, tall: float) -> Iterable[Solid]:
    """A roof drawn up to a peak, on posts; a marquee has walls."""
    sides = p.choice((12, 24)) if p.variant == "yurt" else p.choice((4, 4, 6, 8))
    wall = tall * (0.35 + 0.6 * p.wall)
    turn = np.linspace(0, 2 * np.pi, sides, endpoint=False) + np.pi / sides
    grow = 1 / np.cos(np.pi / sides)
    rim = np.stack([half * grow * np.cos(turn), deep * grow * np.sin(turn)], 1)
    f = np.linspace(0, 1, 8)
    shrink, lift = (1 - f) ** (1 + 2 * p.sag), wall + (tall - wall) * f
    rings = np.stack([np.broadcast_to(lift[:, None], (8, sides))] * 3, axis=-1)
    rings[..., :2] = rim * shrink[:, None, None]
    yield sheet(rings, wrap=True)
    drop = wall - p.flap * 0.2
    edge = np.column_stack([rim, np.full(sides, wall)])
    yield sheet(np.stack([edge - (0, 0, wall - drop), edge]), wrap=True)
    for corner in rim:
        yield rod((*corner, 0), (*corner, wall), p.pole, 6)
    if p.variant != "canopy":
        drawn_in = 1 - p.eave if p.variant == "yurt" else 1.0
        foot = edge * (drawn_in, drawn_in, 0)
        yield sheet(np.stack([foot, edge * (drawn_in, drawn_in, 1)]), wrap=True)
    elif p.chance(0.3):
        yield ring(rod((half * 0.1, 0, 0), (half * 0.1, 0, tall), p.pole), 1)
    if p.chance(0.3):
        peak = smooth([(0, 0, tall), (0, 0, tall * 1.06), (0, 0, tall * 1.12)], 4)
        yield tube(peak, p.pole)
