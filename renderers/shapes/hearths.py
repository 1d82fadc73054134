"""Mantels and range hoods: the wall at +y."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import smooth
from renderers.shapes.solids import Solid, both, box, extrude, sheet


@family(
    "mantel",
    variants={"breast": 4, "arched": 2.5, "fireplace": 3, "surround": 4, "wall": 1,
              "corner_wood": 0.5},
    width=(1.25, 1.75), depth=(0.45, 0.95), height=(0.85, 1.5), board=(0.03, 0.09),
    plate=(0.15, 0.5), rise=(0.05, 0.2), shelf=(0.0, 0.2), shelf_thickness=(0.03, 0.08),
    jamb=(0.1, 0.25), frieze=(0.14, 0.34), hearth=(0.0, 0.3), skirt=(0.08, 0.35),
    thin=(0.12, 0.32),
)  # fmt: skip
def mantel(p: Draw) -> Iterable[Solid]:
    """The width along x, the hearth to −y."""
    if p.variant in ("breast", "arched"):
        yield from _breast(p)
    elif p.variant == "fireplace":
        yield from _fireplace(p)
    else:
        yield from _surround(p)


def _arch(half: float, low: float, high: float, rise: float) -> np.ndarray:
    """A panel's outline from ``low`` to ``high`` whose lower edge is arched by ``rise``."""
    x = np.linspace(-1, 1, 15)
    edge = np.stack([x * half, low + rise * (1 - x**2)], 1)
    return np.concatenate([edge, [(half, high), (-half, high)]])


def _breast(p: Draw) -> Iterable[Solid]:
    """A chimney breast: a box open below, a plate inside it, an arched front edge."""
    half, deep, tall = p.width / 2, p.depth / 2, p.height
    t = p.board
    plate = tall * p.plate
    bottom = plate - p.skirt * tall if p.variant == "arched" else 0.0
    bottom = max(bottom, 0.0)
    closed = p.chance(0.5)
    if closed:
        yield box(2 * half, 2 * deep, (plate, tall))
    else:
        yield box(2 * half, 2 * deep, (tall - t * 0.3, tall))
        yield box(2 * half, (-deep, -deep + t), (plate, tall))
        yield box(2 * half, (deep - t * 0.3, deep), (bottom, tall))
        yield box(2 * half, 2 * deep, (plate - t * 0.3, plate))
    yield both(box((half - t, half), 2 * deep, (bottom, tall)))
    rise = min(p.rise * 1.5 * tall, (plate - bottom) * 0.8)
    yield extrude(_arch(half, bottom, plate, rise), (-deep, -deep + t), "y")
    if p.chance(0.6):
        yield extrude(_arch(half, bottom, plate, rise), (deep - t, deep), "y")
    reach = deep + p.shelf
    if p.shelf > 0.06:
        level = plate if p.chance(0.7) else tall * 0.9
        yield box(2 * half + p.shelf, (-reach, deep * p.choice((-1, 1)) + 0.02),
                  (level, level + p.shelf_thickness))  # fmt: skip
        if p.chance(0.6):
            corbel = np.array(
                [(-deep, level), (-reach * 0.97, level), (-deep, level - 0.35 * tall)]
            )
            corbel[:, 1] = np.maximum(corbel[:, 1], bottom)
            yield both(extrude(corbel, (half - 0.16, half - 0.04), "x"))
    if p.hearth > 0.12:
        front = -deep - p.hearth * 0.6
        if p.chance(0.6):
            yield box(2 * half * 0.98, (front, front + t), (bottom, bottom + p.rise * tall))
            yield box(2 * half * 0.98, (front, -deep), (bottom + p.rise * tall * 0.9,
                                                        bottom + p.rise * tall))  # fmt: skip
        else:
            yield box(2 * half, (front, deep), (bottom - 0.06, bottom))


def _fireplace(p: Draw) -> Iterable[Solid]:
    """A chimney breast with a fire's opening, a shelf over it and a hearth before it."""
    half, deep, tall = p.width / 2, p.depth / 2, p.height
    x, top = half * (0.35 + p.jamb), tall * (0.35 + 0.5 * p.plate)
    arch = np.linspace(-1, 1, 11)
    lintel = np.stack([arch * x, top - p.rise * 0.6 * tall * arch**2], 1)
    opening = np.concatenate([[(x, 0), (-x, 0)], lintel])
    frame = [(-half, 0), (half, 0), (half, tall), (-half, tall)]
    yield extrude(frame, (-deep, -deep + p.board), "y", holes=[opening])
    yield both(box((half - p.board, half), (-deep + p.board, deep), (0, tall)))
    yield box(2 * half, (-deep, deep), (tall - p.board, tall))
    if p.chance(0.6):
        yield box(2 * half, (deep - p.board * 0.3, deep), (0, tall))
    box_deep = min(deep * 1.2, 0.4)
    inner, outer = -deep + p.board, -deep + p.board + box_deep
    shift = 0.75 if p.chance(0.7) else 1.0  # the fire box narrows towards its back
    sides = [[(s * x, inner, z), (s * x * shift, outer, z)] for s in (-1, 1) for z in (0, top)]
    yield sheet(np.array([sides[0], sides[1]]))
    yield sheet(np.array([sides[2], sides[3]]))
    yield box(2 * x * shift, (outer, outer + 0.01), (0, top))
    level, out = top + p.frieze * tall * 0.3, p.shelf + 0.05
    yield box(2 * half + out, (-deep - out, -deep + 0.02), (level, level + p.shelf_thickness))
    if p.chance(0.4):
        jamb = half * 0.12
        yield both(box((half - jamb, half + 0.02), (-deep - out * 0.6, -deep), (0, level)))
    if p.chance(0.7):
        yield box(2 * half * (0.8 + p.thin), (-deep - p.hearth - 0.1, deep), (-p.board, 0))


def _surround(p: Draw) -> Iterable[Solid]:
    """Jambs, frieze and shelf around an opening."""
    half, tall = p.width / 2, p.height
    deep = p.thin
    jamb, frieze = p.jamb * p.width, p.frieze * tall
    opening = tall - frieze
    if p.variant == "wall":
        hole = [(-half + jamb, 0), (half - jamb, 0), (half - jamb, opening * 0.7),
                (-half + jamb, opening * 0.7)]  # fmt: skip
        outline = [(-half, -0.02), (half, -0.02), (half, tall), (-half, tall)]
        yield extrude(outline, (-deep * 0.25, deep * 0.25), "y", holes=[hole])
        if p.chance(0.5):
            yield extrude(hole, (deep * 0.1, deep * 0.2), "y")
    else:
        yield both(box((half - jamb, half), deep, (0, opening)))
        yield box(2 * half, deep, (opening, tall))
        if p.chance(0.6):
            yield both(box((half - jamb * 0.85, half - jamb * 0.15), (-deep * 0.6, -deep * 0.5),
                           (0.1, opening)))  # fmt: skip
        if p.chance(0.5):
            yield both(box((half - jamb * 1.05, half + 0.02), deep * 1.2, (0, 0.12 * tall)))
    out = p.shelf * 0.5 + 0.04
    for i in range(p.integer(1, 3)):
        step = out * (1 - 0.3 * i)
        high = tall + p.shelf_thickness * (1 - 0.8 * i)
        yield box(2 * (half + step), (-deep / 2 - step, deep / 2), (high - p.shelf_thickness, high))
    if p.chance(0.35):
        yield box(2 * half * 0.95, (-deep / 2 - p.hearth - 0.1, deep / 2), (-0.05, 0))
    if p.chance(0.45):
        inner = half - jamb
        yield box(2 * inner, (deep * 0.45, deep * 0.5), (0, opening))
        yield both(box((inner - p.board * 0.5, inner), (0, deep * 0.5 + p.hearth), (0, opening)))
    if p.variant == "corner_wood":
        yield box((half, half * 1.6), (-deep / 2, deep * 0.6), (0, tall * 0.9))


@family(
    "range_hood",
    variants={"chimney": 5, "bell": 4, "boxed": 2.5, "canopy": 1.5, "plate": 1.5},
    width=(0.8, 1.1), depth=(0.42, 0.6), skirt=(0.05, 0.3), slope=(0.1, 0.45), flue=(0.18, 0.75),
    flue_depth=(0.4, 0.75), stack=(0.15, 0.7), curve=(-0.25, 0.5), lip=(0.0, 0.03),
    wall=(0.006, 0.03), notch=(0.2, 0.7), band=(0.02, 0.06),
)  # fmt: skip
def range_hood(p: Draw) -> Iterable[Solid]:
    """The canopy drops towards −y; the flue stands at the wall."""
    half, deep = p.width / 2, p.depth
    skirt, slope, stack = p.skirt, p.slope, p.stack
    flue = half * p.flue
    flue_deep = deep * p.flue_depth
    if p.variant in ("chimney", "plate"):
        skirt, flue, stack = 0.03 + skirt * 0.2, half * (0.2 + 0.3 * p.flue), 0.3 + 0.6 * p.stack
        slope *= 0.5
        flue_deep = min(deep, flue * (1 + p.flue_depth))
    elif p.variant == "bell":
        flue = half * (0.35 + 0.45 * p.flue)
        stack *= 0.5
    elif p.variant == "boxed":
        flue, stack = half * (0.8 + 0.2 * p.flue_depth), stack * 0.5
        slope += 0.3
    elif p.variant == "canopy":
        stack, slope = 0.0, slope * 0.8
    island = p.variant in ("chimney", "plate") and p.chance(0.25)
    shift = (deep - flue_deep) / 2 if island else 0.0
    # canopy: rectangles from the skirt's top to the flue's foot, drawn in along a curve
    if p.variant == "plate":
        yield box(2 * half, (-deep, 0), (0, skirt))
        slope = 0.0
    else:
        f = np.linspace(0, 1, 9)
        bend = f + p.curve * np.sin(np.pi * f) * (0.4 if p.variant == "chimney" else 1.0) * 0.6
        rings = []
        for height, inward in zip(f, bend, strict=True):
            x = half + (flue - half) * inward
            y0 = -deep + (deep - flue_deep - shift) * inward
            y1 = -shift * inward
            z = skirt + slope * height
            rings.append([(-x, y0, z), (x, y0, z), (x, y1, z), (-x, y1, z)])
        yield sheet(np.array(rings), wrap=True)
        bottom = p.chance(0.75)
        if bottom:
            yield box(2 * half, (-deep, 0), (skirt - p.wall, skirt))
        yield from _skirt(p, half, deep, skirt)
    top = skirt + slope
    if stack > 0.02:
        yield box(2 * flue, (-flue_deep - shift, -shift), (top, top + stack))
    else:
        yield box(2 * flue, (-flue_deep - shift, -shift), (top - 0.01, top))
    if p.chance(0.3):
        inner = flue * 0.8
        yield box(2 * inner, (-flue_deep * 0.9 - shift, -shift), (skirt, top + stack * 0.95))
    if p.chance(0.5):
        edge = half + p.lip
        yield box(2 * edge, (-deep - p.lip, 0), (skirt - p.band / 2, skirt + p.band / 2))
    if p.chance(0.3):
        yield box(2 * flue + 0.04, (-flue_deep - shift - 0.02, -shift), (top, top + p.band))


def _skirt(p: Draw, half: float, deep: float, skirt: float) -> Iterable[Solid]:
    """The upright walls below the canopy; on a wooden hood their lower edges are arched."""
    wall = p.wall
    if p.variant == "chimney" or p.chance(0.4):
        yield box(2 * half, (-deep, 0), (0, skirt))
        return
    rise = skirt * p.notch
    arch = smooth([(-half, 0), (-half * 0.85, 0), (-half * 0.6, rise), (0, rise),
                   (half * 0.6, rise), (half * 0.85, 0), (half, 0)], 21)  # fmt: skip
    panel = np.concatenate([arch, [(half, skirt), (-half, skirt)]])
    yield extrude(panel, (-deep, -deep + wall), "y")
    yield both(box((half - wall, half), (-deep, 0), (0, skirt)))
    if p.chance(0.5):
        yield box(2 * half, (-wall, 0), (0, skirt))
