"""Toilets and sinks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import rounded_rectangle, smooth, superellipse
from renderers.shapes.solids import (
    Solid,
    box,
    cylinder,
    extrude,
    four,
    loft,
    revolve,
    rod,
    rounded_box,
    sheet,
    tube,
)


def egg(
    x: float, front: float, back: float, power: float, segments: int = 28
) -> NDArray[np.float64]:
    """(segments,2) oval about the origin: half width x, reaching ``front`` to −y, ``back`` to +y.

    The front is a half ellipse, the back a half superellipse of the given power.
    """
    outline = superellipse(x, 1.0, power, segments)
    round_one = superellipse(x, 1.0, 2.0, segments)
    ahead = round_one[:, 1] < 0
    outline[ahead] = round_one[ahead]
    return outline * np.where(outline[:, 1:] < 0, (1, front), (1, back))


def _stack(levels: Sequence[tuple[float, NDArray]], caps: bool = True) -> Solid:
    """Outlines (n,2) at heights, joined from bottom to top."""
    rings = np.stack([np.column_stack([o, np.full(len(o), z)]) for z, o in levels])
    return loft(rings, caps)


@family(
    "toilet",
    variants={"tank": 6, "lid_up": 1.5, "wall": 3, "one_piece": 1.5, "cistern": 0.7},
    width=(0.17, 0.24), front=(0.24, 0.4), rim=(0.3, 0.44), foot=(0.4, 0.98),
    foot_length=(0.55, 0.95), waist=(0.55, 0.95), tank_width=(0.17, 0.27), tank_depth=(0.15, 0.22),
    tank_height=(0.26, 0.42), tank_taper=(0.85, 1.0), lid=(0.015, 0.06), back=(0.14, 0.26),
    square=(2.2, 6.0), bowl=(0.1, 0.22),
)  # fmt: skip
def toilet(p: Draw) -> Iterable[Solid]:
    """The tank at +y, the bowl towards −y."""
    x, front, back, rim = p.width, p.front, p.back, p.rim
    wall = p.variant == "wall"
    low = rim * 0.28 if wall and p.chance(0.5) else 0.0

    def level(f: float, wide: float, reach: float, behind: float) -> tuple[float, NDArray]:
        return low + f * (rim - low), egg(x * wide, front * reach, back * behind, p.square)

    foot, reach = p.foot, p.foot_length
    waist = min(p.waist, 0.95)
    yield _stack([
        level(0, foot, reach * 0.7, 0.95), level(0.12, foot * 0.97, reach * 0.66, 0.95),
        level(0.4, max(foot * waist, 0.3), reach * waist * 0.75, 0.9),
        level(0.65, 0.5 + 0.4 * foot, 0.8, 0.9), level(0.85, 0.93, 0.95, 0.97),
        level(1.0, 1.0, 1.0, 1.0),
    ], caps=False)  # fmt: skip
    # rim and bowl: outer edge, inner edge, down to the drain
    inner = [(rim, 1.0, 1.0), (rim, 0.72, 0.78), (rim - p.bowl * 0.5, 0.62, 0.66),
             (rim - p.bowl, 0.2, 0.2)]  # fmt: skip
    yield _stack([(z, egg(x * w, front * r, back * w * 0.8 if w < 1 else back, p.square))
                  for z, w, r in inner], caps=False)  # fmt: skip
    yield from _seat(p, x, front, rim)
    if p.variant == "wall":
        if p.chance(0.4):
            yield box(2 * x * 0.9, (back, back + 0.03), (low, rim + p.tank_height * 0.2))
        return
    y0 = back - p.tank_depth * 0.3
    depth, wide = p.tank_depth, p.tank_width
    z0, z1 = rim + 0.005, rim + p.tank_height
    if p.variant == "cistern":  # high on the wall, with its pipe
        z0, z1, wide = z0 + p.tank_height, z1 + p.tank_height, wide * 0.7
        yield rod((0, y0 + depth / 2, rim * 0.8), (0, y0 + depth / 2, z0), 0.025, 8)
    elif p.variant == "one_piece":
        z0, z1, wide = rim * 0.4, rim + p.tank_height * 0.75, max(x * 0.95, wide * 0.8)
    corner = 0.02 + 0.02 * p.foot
    bottom = rounded_rectangle(2 * wide * p.tank_taper, (y0, y0 + depth * 0.92), corner)
    top = rounded_rectangle(2 * wide, (y0, y0 + depth), corner)
    yield _stack([(z0, bottom), (z1, top)])
    brim = rounded_rectangle(2 * wide + 0.02, (y0 - 0.01, y0 + depth + 0.01), corner)
    yield _stack([(z1, brim), (z1 + 0.035, brim)])
    if p.chance(0.4):
        lever = (wide * 0.7, y0 - 0.015, z1 - 0.05)
        yield rod(lever, (wide * 0.35, y0 - 0.03, z1 - 0.06), 0.01, 6)
    if p.chance(0.4):
        yield box(x * 0.9, (back * 0.2, y0 + depth * 0.8), (0, rim * 0.98))


def _seat(p: Draw, x: float, front: float, rim: float) -> Iterable[Solid]:
    outer = egg(x * 1.04, front * 1.03, p.back * 0.7, 3.0)
    if p.variant == "lid_up":
        hole = egg(x * 0.62, front * 0.7, p.back * 0.4, 2.5)
        yield extrude(outer, (rim, rim + 0.02), holes=[hole])
        lid = extrude(outer, (0, 0.02)).at(y=-p.back * 0.7).turned("x", -95 + 10 * p.foot)
        yield lid.at(y=p.back * 0.6, z=rim + 0.03)
    elif p.chance(0.7):
        yield extrude(outer, (rim, rim + p.lid))
    else:
        hole = egg(x * 0.62, front * 0.7, p.back * 0.4, 2.5)
        yield extrude(outer, (rim, rim + 0.025), holes=[hole])


def basin(x: tuple[float, float], y: tuple[float, float], top: float, depth: float,
          corner: float, draft: float) -> Solid:  # fmt: skip
    """An open bowl hanging from ``top``: its walls drawn in by ``draft`` towards the floor."""
    cx, cy = (x[0] + x[1]) / 2, (y[0] + y[1]) / 2
    wide, long = x[1] - x[0], y[1] - y[0]
    levels = []
    for f, shrink in ((0.0, 1.0), (0.75, 1 - draft * 0.7), (0.95, 1 - draft), (1.0, 0.9 - draft)):
        o = rounded_rectangle(wide * shrink, long * shrink, corner * min(wide, long) * shrink)
        levels.append(
            np.column_stack([o[:, 0] + cx, o[:, 1] + cy, np.full(len(o), top - f * depth)])
        )
    walls = sheet(np.stack(levels[::-1]), wrap=True)
    drain = np.stack([levels[-1], levels[-1] * 0 + levels[-1].mean(axis=0)])
    floor = sheet(drain[::-1], wrap=True)
    return Solid(
        np.concatenate([walls.vertices, floor.vertices]),
        np.concatenate([walls.faces, floor.faces + len(walls.vertices)]),
    )


def faucet(reach: float, height: float, thickness: float, arched: bool) -> Solid:
    """A tap standing at the origin, its spout towards −y."""
    if arched:
        path = [(0, 0, 0), (0, 0, height * 0.7), (0, -reach * 0.2, height * 0.95),
                (0, -reach * 0.6, height), (0, -reach, height * 0.75)]  # fmt: skip
    else:
        path = [(0, 0, 0), (0, 0, height * 0.5), (0, -reach * 0.1, height * 0.6),
                (0, -reach, height * 0.7)]  # fmt: skip
    return tube(smooth(path, 12), thickness)


@family(
    "sink",
    variants={"drop_in": 4, "double": 2, "cabinet": 4, "pedestal": 1, "legs": 0.6, "vessel": 1},
    width=(0.7, 1.2), depth=(0.42, 0.7), bowl=(0.14, 0.3), corner=(0.05, 0.45), draft=(0.02, 0.2),
    offset=(-0.3, 0.3), rim=(0.008, 0.05), tap_height=(0.08, 0.35), tap_reach=(0.1, 0.24),
    margin=(0.012, 0.12), splash=(0.0, 0.12), cabinet=(0.5, 0.9), share=(0.4, 0.85),
)  # fmt: skip
def sink(p: Draw) -> Iterable[Solid]:
    """The wall and the tap at +y, the width along x."""
    if p.variant == "pedestal":
        yield from _pedestal_sink(p)
        return
    wide, long, rim = p.width, p.depth, p.rim
    if p.variant in ("legs", "vessel"):
        wide = min(wide, long * 1.4)
    y = (-long / 2 + p.margin * 0.6, long / 2 - p.margin * 1.5)
    if p.variant == "double":
        gap = 0.03
        middle = wide * p.offset * 0.3
        edge = wide / 2 - p.margin * 0.6
        spans = [(-edge, middle - gap), (middle + gap, edge)]
    else:
        inner = (wide - 2 * p.margin) * (p.share if p.chance(0.6) else 1.0)
        middle = p.offset * 2 * (wide - 2 * p.margin - inner) / 2 / 0.6
        spans = [(middle - inner / 2, middle + inner / 2)]
    holes = [rounded_rectangle(s, y, p.corner * min(s[1] - s[0], y[1] - y[0])) for s in spans]
    yield extrude(rounded_rectangle(wide, long, 0.03), (-rim, 0), holes=holes)
    deep = p.bowl * (0.6 if p.variant == "cabinet" else 1.0)
    for s in spans:
        yield basin(s, y, 0.0, deep, p.corner, p.draft)
        if p.chance(0.4):
            yield cylinder(0.03, (-deep - 0.05, -deep), 12).at((s[0] + s[1]) / 2, 0)
    if p.chance(0.6):
        tap = faucet(p.tap_reach, p.tap_height, 0.014, p.chance(0.6))
        yield tap.at(middle if p.variant == "double" else sum(spans[0]) / 2, y[1] + p.margin * 0.4)
    if p.variant == "cabinet":
        tall = p.cabinet * p.choice((0.6, 1.0))
        yield box(wide * 0.97, (-long * 0.47, long * 0.5), (-tall, -rim))
        if p.chance(0.5):
            yield box(wide * 0.9, (-long * 0.4, long * 0.42), (-tall, -tall + 0.08))
        for side in (-1, 1):
            door = (side * wide * 0.24 - wide * 0.22, side * wide * 0.24 + wide * 0.22)
            yield box(door, (-long * 0.49, -long * 0.47), (-tall * 0.85, -0.06))
    if p.variant == "legs":
        yield from _tub_on_legs(p, wide, long, rim)
    if p.variant == "vessel":
        yield box(wide, long, (-p.bowl * 1.1, -p.bowl * 1.02))
    if p.splash > 0.05 and p.variant != "vessel":
        yield box(wide, (long / 2 - 0.02, long / 2), (0, p.splash))


def _tub_on_legs(p: Draw, wide: float, long: float, rim: float) -> Iterable[Solid]:
    yield rounded_box(wide, long, (-p.bowl * 1.1, -rim), 0.02)
    post = box((-0.025, 0.025), (-0.025, 0.025), (-p.cabinet, -p.bowl))
    yield four(post.at(wide / 2 - 0.05, long / 2 - 0.05))


def _pedestal_sink(p: Draw) -> Iterable[Solid]:
    x, front = p.width * 0.3, p.depth * 0.5
    outline = egg(x, front, front * 0.7, 4.0)
    yield _stack([(-p.bowl, outline * 0.45), (-p.bowl * 0.5, outline * 0.85), (0, outline)], False)
    hollow = [(0, outline), (0, outline * 0.85), (-p.bowl * 0.45, outline * 0.7),
              (-p.bowl * 0.7, outline * 0.2)]  # fmt: skip
    yield _stack(hollow, False)
    r = 0.3 * x + 0.02
    column = [(0, -p.cabinet), (r * 1.3, -p.cabinet), (r * 0.8, -p.cabinet * 0.7),
              (r, -p.bowl * 0.8), (0, -p.bowl * 0.8)]  # fmt: skip
    yield revolve(column).at(y=front * 0.1)
    yield box(2 * x * 0.9, (front * 0.55, front * 0.75), (-p.bowl * 0.6, p.splash))
    yield faucet(p.tap_reach, p.tap_height * 0.6, 0.014, p.chance(0.5)).at(y=front * 0.6)
