"""Night stands, television stands and wardrobes: cases with drawers, doors and open cells."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import numpy as np

from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import superellipse
from renderers.shapes.solids import Solid, beam, both, box, ellipsoid, extrude, four, join, rod

Span = tuple[float, float]


def carcass(x: Span, y: Span, z: Span, thick: float, back: bool = True) -> Iterable[Solid]:
    """A case of boards, open to −y."""
    yield box(x, y, (z[0], z[0] + thick))
    yield box(x, y, (z[1] - thick, z[1]))
    yield box((x[0], x[0] + thick), y, z)
    yield box((x[1] - thick, x[1]), y, z)
    if back:
        yield box(x, (y[1] - thick * 0.4, y[1]), z)


def front(x: Span, z: Span, y: float, thick: float, gap: float) -> Solid:
    """A drawer's or a door's board before y."""
    return box((x[0] + gap, x[1] - gap), (y - thick, y), (z[0] + gap, z[1] - gap))


def knob(x: float, y: float, z: float, size: float, bar: bool) -> Solid:
    """A round knob or a bar handle, standing out to −y."""
    if bar:
        return box((x - size * 3, x + size * 3), (y - size, y), (z - size * 0.4, z + size * 0.4))
    return ellipsoid(size, size, size, 8).at(x, y - size, z)


def drawer(x: Span, y: Span, z: Span, thick: float, gap: float) -> Iterable[Solid]:
    """A whole drawer: the board before y[0] and the tray behind it."""
    yield front(x, z, y[0], thick, gap)
    tray_x = (x[0] + 2 * gap, x[1] - 2 * gap)
    tray_z = (z[0] + 2 * gap, z[0] + (z[1] - z[0]) * 0.75)
    yield box(tray_x, (y[0], y[1] * 0.9), (tray_z[0], tray_z[0] + thick * 0.4))
    for side in ((tray_x[0], tray_x[0] + thick * 0.4), (tray_x[1] - thick * 0.4, tray_x[1])):
        yield box(side, (y[0], y[1] * 0.9), tray_z)


@family(
    "night_stand",
    variants={"drawers": 4, "mixed": 3, "leggy": 2.5, "door": 1.5, "open": 1.5},
    width=(0.38, 0.74), depth=(0.34, 0.5), height=(0.44, 0.8), board=(0.012, 0.035),
    overhang=(0.0, 0.035), top=(0.012, 0.04), legs=(0.0, 0.14), leg=(0.03, 0.06),
    split=(0.3, 0.62), gap=(0.002, 0.012), handle=(0.008, 0.02), taper=(0.5, 1.1),
    shelf=(0.15, 0.4),
)  # fmt: skip
def night_stand(p: Draw) -> Iterable[Solid]:
    """Built facing −y, then turned to face −x, its width along y."""
    yield join(_night_stand(p)).turned("z", -90)


def _night_stand(p: Draw) -> Iterable[Solid]:
    wide, deep, tall = p.width / 2, p.depth / 2, p.height
    yield box(
        2 * (wide + p.overhang), (-deep - p.overhang, deep + p.overhang * p.choice((0, 1))),
        (tall - p.top, tall),
    )  # fmt: skip
    under = tall - p.top
    floor = p.legs
    if p.variant == "leggy":
        floor = under * (1 - p.split)
    x, y, z = (-wide, wide), (-deep, deep), (floor, under)
    solid = p.chance(0.45)
    if solid and p.variant != "open":
        yield box(x, y, z)
    else:
        yield from carcass(x, y, z, p.board, back=p.variant != "open" or p.chance(0.5))
    bar = p.chance(0.4)
    middle = floor + (under - floor) * p.split
    if p.variant in ("drawers", "leggy"):
        count = 1 if p.variant == "leggy" else p.integer(2, 3)
        levels = np.linspace(floor + p.board, under - p.board * 0.5, count + 1)
    elif p.variant == "mixed":
        yield box(x, y, (middle - p.board, middle))
        levels = np.array([middle, under])
    else:
        levels = np.array([under])
    for low, high in pairwise(levels):
        if solid:
            yield front(x, (low, high), -deep, p.board * 0.6, p.gap + 0.01)
        else:
            yield from drawer(x, y, (low, high), p.board, p.gap)
        yield knob(0, -deep - p.board * 0.6, (low + high) / 2, p.handle, bar)
    if p.variant == "door":
        yield front(x, (floor, under), -deep, p.board, p.gap + 0.01)
        yield knob(wide * 0.7, -deep - p.board, (floor + under) / 2, p.handle, False)
    if p.variant == "open" or (p.variant == "mixed" and p.chance(0.3)):
        level = floor + (under - floor) * p.shelf
        yield box(x, y, (level, level + p.board))
    if floor > 0.02:
        post = p.leg / 2
        top = np.array([wide - post, deep - post, floor])
        yield four(beam(top, top * (1, 1, 0), p.leg, p.leg, taper=p.taper))
        if p.variant == "leggy" and p.chance(0.6):
            level = floor * p.shelf
            yield box(2 * wide - p.leg, 2 * deep - p.leg, (level, level + p.board))
    elif p.chance(0.5):
        yield box(2 * wide + 0.02, 2 * deep + 0.02, (-0.05, 0.0))


@family(
    "tv_stand",
    variants={"cabinet": 5, "glass": 3.5, "unit": 2, "console": 2, "tall": 1.5, "plain": 1.5,
              "bench": 2},
    width=(1.0, 1.9), depth=(0.38, 0.78), height=(0.34, 0.75), board=(0.015, 0.045),
    legs=(0.0, 0.16), columns=(0.22, 0.4), level=(0.3, 0.65), bow=(0.0, 0.3), taper=(0.7, 1.0),
    post=(0.02, 0.07), tower=(0.15, 0.28), gap=(0.002, 0.01), handle=(0.008, 0.02),
)  # fmt: skip
def tv_stand(p: Draw) -> Iterable[Solid]:
    """The width along x, the open or drawered front to −y."""
    wide, deep, tall = p.width / 2, p.depth / 2, p.height
    if p.variant == "glass":
        yield from _glass_stand(p)
        return
    if p.variant == "unit":
        yield from _wall_unit(p)
        return
    if p.variant == "bench":
        yield from _low_table(p)
        return
    if p.variant == "tall":
        wide, tall, deep = wide * 0.6, p.width * (0.5 + 0.4 * p.level), deep * 0.8
    floor = p.legs * (1.0 if p.variant == "console" else p.choice((0.0, 0.0, 0.5)))
    x, y, z = (-wide, wide), (-deep, deep), (floor, tall)
    if p.variant == "plain":
        yield box(x, y, z)
    else:
        yield from carcass(x, y, z, p.board, back=p.chance(0.75))
    if p.chance(0.5):
        yield box(2 * wide + 0.05, 2 * deep + 0.03, (tall, tall + p.board))
    a = wide * 2 * p.columns
    edges = [-wide, -wide + a, wide - a, wide]
    if p.variant == "tall" or p.chance(0.25):
        edges = [-wide, 0.0, wide]
    for edge in edges[1:-1]:
        yield box((edge - p.board / 2, edge + p.board / 2), y, z)
    rows = p.integer(3, 4) if p.variant == "tall" else p.integer(1, 3)
    levels = np.linspace(floor, tall, rows + 1)
    if rows == 2:
        levels[1] = floor + (tall - floor) * p.level
    for left, right in pairwise(edges):
        for low, high in pairwise(levels):
            if low > floor:
                yield box((left, right), y, (low - p.board / 2, low + p.board / 2))
            if p.chance(0.35 if p.variant != "plain" else 0.9):
                yield front((left, right), (low, high), -deep, p.board * 0.7, p.gap + 0.004)
                middle = ((left + right) / 2, -deep - p.board * 0.7, (low + high) / 2)
                yield knob(*middle, p.handle, p.chance(0.5))
    if floor > 0.02:
        yield four(beam(
            (wide - p.post, deep - p.post, floor), (wide - p.post, deep - p.post, 0), p.post,
            p.post, taper=p.taper,
        ))  # fmt: skip


def _glass_stand(p: Draw) -> Iterable[Solid]:
    """Plates carried by posts; the back corners are cut or the front is bowed."""
    wide, deep, tall = p.width / 2, p.depth / 2, p.height
    rounded = p.chance(0.4)
    cut = deep * (0.3 + 1.2 * p.bow)

    def plate(scale: float, z: Span) -> Solid:
        if rounded:
            outline = superellipse(wide * scale, deep, 2.4 + 6 * p.bow)
            outline[:, 1] = np.minimum(outline[:, 1], deep * 0.8)
        else:
            x = wide * scale
            outline = np.array([(-x, -deep * 0.8), (-x * 0.5, -deep), (x * 0.5, -deep),
                                (x, -deep * 0.8), (x, deep - cut), (x - cut, deep),
                                (-x + cut, deep), (-x, deep - cut)])  # fmt: skip
        return extrude(outline, z)

    count = p.choice((2, 3, 3, 3, 4))
    levels = np.linspace(0.04, tall - p.board, count)
    for i, low in enumerate(levels):
        scale = 1.0 if i in (0, count - 1) else p.taper
        yield plate(scale, (low, low + p.board * 0.8))
    radius = p.post / 2
    style = p.choice(("posts", "posts", "column", "sides"))
    if style == "posts":
        corner = (wide * p.taper * 0.75, deep * 0.55)
        yield four(rod((*corner, 0), (*corner, tall - p.board), radius))
    elif style == "column":
        yield both(box((wide * 0.3, wide * 0.3 + p.post), (deep * 0.2, deep * 0.5), (0, tall)))
    else:
        x = wide * p.taper * 0.8
        yield both(box((x, x + p.board), 1.5 * deep, (0, tall - p.board)))


def _low_table(p: Draw) -> Iterable[Solid]:
    """A top on legs or panels, with a shelf or a drawer under it, or a board bent into an arch."""
    wide, deep, tall = p.width / 2, p.depth / 2, p.height
    yield box(2 * wide, 2 * deep, (tall - p.board, tall))
    inside = wide * (p.taper if p.chance(0.5) else 1.0)
    if p.chance(0.5):
        yield both(box((inside - p.board, inside), 2 * deep * p.taper, (0, tall)))
    else:
        yield four(box((inside - p.post, inside), (deep - p.post, deep), (0, tall)))
    if p.chance(0.8):
        level = tall * p.level * 0.7
        yield box(2 * inside, 2 * deep * 0.95, (level, level + p.board))
    if p.chance(0.3):
        yield box(2 * inside, 2 * deep * 0.9, (tall * (1 - p.columns), tall))
    if p.chance(0.3):
        yield box(2 * inside, (deep * 0.9, deep * 0.95), (tall * p.level, tall))


def _wall_unit(p: Draw) -> Iterable[Solid]:
    """Towers beside a low middle, often with a bridge above the screen."""
    wide, deep = p.width / 2, p.depth * 0.35
    tall = p.width * (0.25 + p.level)
    side = p.tower * p.width
    low = tall * 0.3
    rows = p.integer(2, 4)
    for tower in ((-wide, -wide + side), (wide - side, wide)):
        yield from carcass(tower, (-deep, deep), (0, tall), p.board)
        for level in np.linspace(0, tall, rows + 1)[1:-1]:
            yield box(tower, (-deep, deep), (level, level + p.board))
        if p.chance(0.5):
            yield front(tower, (0, tall / rows), -deep, p.board * 0.7, p.gap)
    middle = (-wide + side, wide - side)
    yield from carcass(middle, (-deep * 1.1, deep), (0, low), p.board)
    yield box(p.board, (-deep, deep), (0, low))
    if p.chance(0.6):
        yield from carcass(middle, (-deep * 0.8, deep), (tall - low * 0.6, tall), p.board)
    if p.chance(0.4):
        yield box(middle, (deep - p.board * 0.5, deep), (low, tall))


@family(
    "wardrobe",
    variants={"closed": 4, "cased": 4, "corniced": 2, "open": 1.5, "open_door": 1},
    width=(0.8, 2.3), depth=(0.36, 0.66), height=(1.7, 2.3), board=(0.015, 0.05),
    plinth=(0.03, 0.16), cornice=(0.02, 0.1), flare=(0.0, 0.06), gap=(0.003, 0.015),
    handle=(0.01, 0.025), drawers=(0.12, 0.3), split=(0.35, 0.65), legs=(0.0, 0.14),
    door_angle=(40.0, 110.0),
)  # fmt: skip
def wardrobe(p: Draw) -> Iterable[Solid]:
    """The width along x, the doors to −y."""
    wide, deep, tall = p.width / 2, p.depth / 2, p.height
    x, y = (-wide, wide), (-deep, deep)
    floor = p.legs if p.chance(0.3) else 0.0
    if p.variant == "closed":
        yield box(x, y, (floor, tall))
    else:
        yield from carcass(x, y, (floor, tall), p.board)
    low = floor + p.plinth
    if p.variant != "closed" or p.chance(0.5):
        yield box(x, (-deep, deep), (low, low + p.board))
    doors = max(1, round(p.width / 0.5)) if p.chance(0.8) else 2
    edges = np.linspace(-wide, wide, doors + 1)
    top = tall - p.board
    door_low = low
    if p.chance(0.35):
        door_low = low + p.drawers * tall
        cut = (low + door_low) / 2
        for z in ((low, cut), (cut, door_low)):
            yield front(x, z, -deep, p.board * 0.6, p.gap)
            yield knob(0, -deep - p.board * 0.6, sum(z) / 2, p.handle, True)
    angle = p.door_angle if p.variant == "open_door" else 0.0
    for i, (left, right) in enumerate(pairwise(edges)):
        if p.variant == "open" and p.chance(0.6):
            continue
        door = front((0, right - left), (door_low, top), 0, p.board * 0.6, p.gap)
        if p.chance(0.4):
            inner = (0.08, right - left - 0.08)
            door = join(
                door, front(inner, (door_low + 0.1, top - 0.1), -p.board * 0.6, 0.012, p.gap)
            )
        if i == 0 and angle:
            door = door.turned("z", -angle)
        yield door.at(left, -deep)
        pull = right - 0.06 if i % 2 == 0 else left + 0.06
        if not (i == 0 and angle):
            height = (door_low + top) / 2
            yield box((pull - p.handle / 2, pull + p.handle / 2),
                      (-deep - p.board - p.handle, -deep - p.board * 0.5),
                      (height - 0.08, height + 0.08))  # fmt: skip
    if p.variant in ("cased", "open", "open_door"):
        wall = -wide + 2 * wide * p.split
        yield box((wall, wall + p.board), y, (low, tall))
        yield box((-wide, wall), y, (tall * 0.8, tall * 0.8 + p.board))
        for level in np.linspace(low, tall, p.integer(3, 6))[1:-1]:
            yield box((wall, wide), y, (level, level + p.board))
        if p.width > 1.5:
            wall = -wide * p.split
            yield box((wall, wall + p.board), y, (low, tall * 0.8))
    if p.variant == "corniced":
        step = p.flare + 0.02
        yield box(2 * (wide + step), (-deep - step, deep), (tall, tall + p.cornice))
        yield box(2 * (wide + step), (-deep - step, deep), (floor, floor + p.plinth * 0.8))
    if floor:
        post = 0.03
        yield four(box((-post, post), (-post, post), (0, floor)).at(wide - post, deep - post))
