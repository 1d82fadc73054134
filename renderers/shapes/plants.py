"""Plants: potted, palms, bushes, flowers, blades of grass."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import smooth
from renderers.shapes.solids import (
    Solid,
    box,
    cylinder,
    ellipsoid,
    hull,
    join,
    revolve,
    sheet,
    tube,
)


def leaf(length: float, width: float, rise: float, droop: float, steps: int = 6) -> Solid:
    """A curved blade from the origin along +x: it sets out at ``rise`` degrees and bends by droop.

    A single sheet, widest in its middle, folded a little along its rib.
    """
    s = np.linspace(0, 1, steps)
    angle = np.radians(rise - droop * s)
    step = length / (steps - 1)
    x = np.concatenate([[0], np.cumsum(np.cos(angle[:-1]) * step)])
    z = np.concatenate([[0], np.cumsum(np.sin(angle[:-1]) * step)])
    half = width / 2 * np.sin(np.pi * np.clip(s * 0.92 + 0.06, 0, 1)) ** 0.8
    edge = np.stack([x, half, z + half * 0.25], 1)
    other = edge * (1, -1, 1)
    return sheet(np.stack([other, np.stack([x, 0 * x, z], 1), edge], 1))


def scattered(rng: np.random.Generator, count: int, size: float, radii: NDArray,
              hollow: float) -> Solid:  # fmt: skip
    """Small leaves at random places and turns within an ellipsoid about the origin.

    ``hollow`` in [0,1]: how far they keep from the middle.
    """
    way = rng.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    where = way * (hollow + (1 - hollow) * rng.random((count, 1)) ** 0.5) * radii
    a = rng.normal(size=(count, 3))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = np.cross(a, rng.normal(size=(count, 3)))
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    long = size * rng.uniform(0.7, 1.3, (count, 1))
    corners = [where - a * long, where - b * long * 0.4, where + a * long, where + b * long * 0.4]
    vertices = np.stack(corners, 1).reshape(-1, 3)
    first = 4 * np.arange(count)[:, None]
    faces = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    return Solid(vertices, faces)


def pot(p: Draw, height: float) -> Iterable[Solid]:
    """A pot standing on z = 0, earth in it."""
    r = height * p.pot_width
    base = r * p.pot_taper
    if p.chance(0.2):
        yield box(1.7 * r, 1.7 * r, (0, height))
        return
    if p.chance(0.3):
        outside = smooth([(base, 0), (r * 1.1, height * 0.45), (r * 0.9, height * 0.9),
                          (r, height)], 12)  # fmt: skip
    else:
        rim = p.pot_rim
        outside = np.array([(base, 0), (r * 0.95, height * 0.82), (r * (1 + rim), height * 0.82),
                            (r * (1 + rim), height)])  # fmt: skip
    inside = [(r * 0.88, height), (r * 0.85, height * 0.85), (0, height * 0.85)]
    yield revolve(np.concatenate([[(0, 0)], outside, inside]), 24)


def stalk(tip: NDArray[np.float64], base: float, share: float, count: int) -> NDArray[np.float64]:
    """(count,3) a stem from (0, 0, base) that bends out to its tip.

    ``share`` of the way out is covered half-way up.
    """
    middle = np.array([tip[0] * share, tip[1] * share, (base + tip[2]) / 2])
    return smooth(np.stack([(0.0, 0.0, base), middle, tip]), count)


@family(
    "plant",
    variants={"potted": 4, "bush": 3, "palm": 2, "grass": 2.5, "flowers": 2, "shrub": 2,
              "tree": 1.5, "cut_out": 1.5, "succulent": 1},
    pot_height=(0.2, 0.6), pot_width=(0.35, 0.75), pot_taper=(0.55, 0.95), pot_rim=(0.0, 0.12),
    reach=(0.4, 1.0), leaf_width=(0.05, 0.2), rise=(35.0, 85.0), droop=(10.0, 110.0),
    crown=(0.3, 0.6), flat=(0.6, 1.3), stem=(0.3, 1.0), leaf_size=(0.04, 0.12), sway=(-0.15, 0.15),
)  # fmt: skip
def plant(p: Draw) -> Iterable[Solid]:
    """Foliage of single sheets, as real models have it; symmetric about z only roughly."""
    build = {
        "potted": _potted, "bush": _bush, "palm": _palm, "grass": _grass, "flowers": _flowers,
        "shrub": _shrub, "tree": _tree, "cut_out": _cut_out, "succulent": _succulent,
    }[p.variant]  # fmt: skip
    yield from build(p)


def _spray(p: Draw, count: int, reach: float, width: float) -> Iterable[Solid]:
    """Leaves from one point to all sides."""
    for i in range(count):
        blade = leaf(
            reach * p.uniform(0.6, 1.1), width * p.uniform(0.7, 1.2),
            min(p.rise + p.uniform(-25, 20), 89), p.droop * p.uniform(0.6, 1.3),
        )  # fmt: skip
        yield blade.turned("z", 137.5 * i + p.uniform(-20, 20))


def _potted(p: Draw) -> Iterable[Solid]:
    tall = p.pot_height
    yield from pot(p, tall)
    if p.chance(0.5):
        crown = join(_spray(p, p.integer(10, 32), p.reach, p.leaf_width))
        yield crown.at(z=tall * 0.85)
        return
    for _ in range(p.integer(2, 6)):
        up = p.stem * p.uniform(0.3, 1.0) * 0.8
        top = np.array([p.uniform(-0.2, 0.2), p.uniform(-0.2, 0.2), tall * 0.85 + up])
        yield tube(stalk(top, tall * 0.8, 0.3, 6), 0.012, 5)
        yield join(_spray(p, p.integer(5, 9), p.reach * 0.5, p.leaf_width * 0.8)).at(*top)


def _bush(p: Draw) -> Iterable[Solid]:
    count = p.integer(150, 700)
    radii = p.crown * np.array([1.0, 1.0, p.flat])
    crown = scattered(p.rng, count, p.leaf_size, radii, p.uniform(0.0, 0.7))
    if p.chance(0.4):
        floor = -0.5 * radii[2]
        crown = crown.warped(lambda v: np.maximum(v, (-np.inf, -np.inf, floor)))
    yield crown
    if p.chance(0.7):
        yield join(pot(p, p.pot_height)).at(z=-radii[2] * 0.8 - p.pot_height * 0.7)
    else:
        yield cylinder(0.02, (-radii[2] - 0.1, 0), 6)


def _shrub(p: Draw) -> Iterable[Solid]:
    """Twigs with leaves along them, from the ground or a pot."""
    base = 0.0
    if p.chance(0.6):
        yield from pot(p, p.pot_height)
        base = p.pot_height * 0.8
    for i in range(p.integer(6, 16)):
        turn = np.radians(137.5 * i)
        out = p.reach * p.uniform(0.2, 0.6)
        up = p.stem * p.uniform(0.5, 1.1)
        tip = np.array([out * np.cos(turn), out * np.sin(turn), base + up])
        path = stalk(tip, base, 0.35, 7)
        yield tube(path, 0.008, 4)
        for point in path[2:]:
            blade = leaf(p.leaf_size * 3, p.leaf_size * 1.4, p.rise * 0.6, p.droop, 4)
            yield blade.turned("z", p.uniform(0, 360)).at(*point)


def _palm(p: Draw) -> Iterable[Solid]:
    tall = p.stem * 1.4
    base = 0.0
    if p.chance(0.5):
        yield from pot(p, p.pot_height)
        base, tall = p.pot_height * 0.85, tall * 0.6
    top = np.array([p.sway, p.sway * 0.5, base + tall])
    path = stalk(top, base, 0.2, 8)
    yield tube(path, 0.035, 8, scale=np.linspace(1.3, 0.8, 8))
    for i in range(p.integer(8, 16)):
        frond = leaf(p.reach * p.uniform(0.6, 0.9), p.leaf_width * 1.5, p.rise * p.uniform(0.4, 1),
                     60 + p.droop * p.uniform(0.5, 1), 8)  # fmt: skip
        yield frond.turned("z", 137.5 * i).at(*top)


def _grass(p: Draw) -> Iterable[Solid]:
    base = 0.0
    if p.chance(0.6):
        yield from pot(p, p.pot_height)
        base = p.pot_height * 0.85
    for i in range(p.integer(8, 40)):
        blade = leaf(p.reach * p.uniform(0.5, 1.2), p.leaf_width * 0.6,
                     min(60 + p.rise * p.uniform(0, 0.34), 88),
                     p.droop * p.uniform(0, 0.6))  # fmt: skip
        yield blade.turned("z", 137.5 * i).at(p.uniform(-0.04, 0.04), p.uniform(-0.04, 0.04), base)


def _flowers(p: Draw) -> Iterable[Solid]:
    tall = p.pot_height * p.choice((0.0, 1.0, 1.5))
    if tall:
        yield from pot(p, tall)
    for i in range(p.integer(3, 12)):
        turn = np.radians(137.5 * i)
        out, up = p.reach * p.uniform(0.1, 0.5), p.stem * p.uniform(0.7, 1.1)
        tip = np.array([out * np.cos(turn), out * np.sin(turn), tall * 0.9 + up])
        path = stalk(tip, tall * 0.3, 0.3, 8)
        yield tube(path, 0.008, 5)
        size = p.leaf_size * p.uniform(0.8, 1.4)
        if p.chance(0.5):
            yield ellipsoid(size, size, size * 0.8, 8).at(*tip)
        else:
            petal = leaf(size * 1.6, size, 25, 40, 4)
            yield join(petal.turned("z", 60 * k) for k in range(6)).at(*tip)
        if p.chance(0.6):
            blade = leaf(p.reach * 0.35, p.leaf_width * 0.6, p.rise, p.droop, 5)
            yield blade.turned("z", np.degrees(turn) + 40).at(*path[3])


def _tree(p: Draw) -> Iterable[Solid]:
    tall = p.stem
    yield tube(smooth([(0, 0, 0), (p.sway * 0.3, 0, tall * 0.6), (p.sway, 0, tall)], 6), 0.03, 7)
    if p.chance(0.5):
        yield from pot(p, p.pot_height * 0.7)
    for _ in range(p.integer(1, 4)):
        radii = p.crown * np.array([1, 1, p.flat]) * p.uniform(0.5, 0.9)
        crown = scattered(p.rng, p.integer(60, 200), p.leaf_size, radii, 0.4)
        yield crown.at(
            p.sway + p.uniform(-0.2, 0.2), p.uniform(-0.2, 0.2), tall + p.uniform(0, 0.3)
        )


def _cut_out(p: Draw) -> Iterable[Solid]:
    """Foliage painted on boards: an outline, or a fan of leaves, crossed at the stem or not."""
    turn = np.linspace(0, 2 * np.pi, 41)[:-1]
    fan = p.chance(0.4)
    for degrees in (0.0, 90.0)[: p.choice((1, 1, 2))]:
        if fan:
            for slant in np.linspace(-p.rise, p.rise, p.integer(5, 11)):
                blade = leaf(p.reach * p.uniform(0.7, 1.0), p.leaf_width * 1.2, 90.0, 0.0)
                yield blade.turned("x", slant).scaled(x=0.02).turned("z", degrees)
            continue
        r = p.crown * (1 + 0.25 * p.rng.uniform(-1, 1, 40))
        rim = np.stack([r * np.cos(turn), 0 * turn, r * np.sin(turn) * p.flat + p.crown], 1)
        middle = np.broadcast_to((0.0, 0.0, p.crown), rim.shape)
        yield sheet(np.stack([middle, (rim + middle) / 2, rim]), wrap=True).turned("z", degrees)
    if p.chance(0.4):
        yield join(pot(p, p.pot_height)).at(z=-p.pot_height * 0.7)


def _succulent(p: Draw) -> Iterable[Solid]:
    """A cactus or clipped ball in a pot."""
    tall = p.pot_height
    yield from pot(p, tall)
    r = p.crown * 0.6
    if p.chance(0.5):
        lumps = p.rng.normal(size=(160, 3))
        lumps *= (r * p.rng.uniform(0.85, 1.1, (160, 1))) / np.linalg.norm(
            lumps, axis=1, keepdims=True
        )
        yield hull(lumps * (1, 1, p.flat)).at(z=tall + r * p.flat * 0.8)
        return
    yield ellipsoid(r * 0.5, r * 0.5, p.stem * 0.5, 12).at(z=tall + p.stem * 0.35)
    for i in range(p.integer(0, 4)):
        arm = ellipsoid(r * 0.25, r * 0.25, p.stem * 0.22, 10).at(r * 0.6)
        yield arm.turned("z", 90 * i + p.uniform(-20, 20)).at(z=tall + p.stem * p.uniform(0.3, 0.6))
