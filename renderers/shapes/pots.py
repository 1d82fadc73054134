"""Flower pots, empty or planted."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from renderers.shapes.crockery import hollow
from renderers.shapes.family import Draw, family
from renderers.shapes.solids import Solid, box, cylinder, revolve, smooth


def _leaf(length: float, width: float, lift: float, bend: float) -> Solid:
    """A blade from the origin along +x, rising by ``lift`` degrees and bending over."""
    t = np.linspace(0, 1, 7)
    angle = np.radians(lift - bend * t)
    step = length / 6
    x = np.concatenate([[0], np.cumsum(np.cos(angle[:-1]) * step)])
    z = np.concatenate([[0], np.cumsum(np.sin(angle[:-1]) * step)])
    half = width * np.sin(np.pi * np.clip(t * 0.92 + 0.06, 0, 1)) ** 0.8
    rows = [[(a, -c, b + 0.3 * c), (a, 0, b), (a, c, b + 0.3 * c)]
            for a, b, c in zip(x, z, half, strict=True)]  # fmt: skip
    return Solid(np.array(rows).reshape(-1, 3), _LEAF_FACES)


_LEAF_FACES = np.array([
    face for i in range(6) for j in range(2) for face in (
        (3 * i + j, 3 * i + j + 1, 3 * i + j + 4), (3 * i + j, 3 * i + j + 4, 3 * i + j + 3))
])  # fmt: skip


def _foliage(p: Draw, z: float, spread: float) -> Iterable[Solid]:
    """What grows out of a pot at height z."""
    style = p.choice(("rosette", "stems", "bush", "tree"))
    count = p.integer(10, 26)
    if style == "rosette":
        for _ in range(count):
            leaf = _leaf(p.plant * p.uniform(0.6, 1.1), p.leaf * spread, p.uniform(35, 88),
                         p.droop * p.uniform(0.3, 1.2))  # fmt: skip
            yield leaf.turned("z", p.uniform(0, 360)).at(z=z)
    elif style == "stems":
        for _ in range(p.integer(3, 7)):
            turn, lean = p.uniform(0, 360), p.uniform(0, 25)
            tall = p.plant * p.uniform(0.7, 1.1)
            parts = [cylinder(0.012, (0, tall), 6)]
            parts += [
                _leaf(0.35 * p.plant, p.leaf * 0.4, 30, p.droop * 0.5)
                .turned("z", p.uniform(0, 360))
                .at(z=tall * k)
                for k in (0.5, 0.7, 0.85, 1.0)
            ]
            for part in parts:
                yield part.turned("y", lean).turned("z", turn).at(z=z)
    else:
        high = z
        if style == "tree":
            high = z + 0.5 * p.plant
            yield cylinder(0.03, (z, high + 0.1), 8)
        for _ in range(3 * count):
            direction = p.rng.normal(size=3)
            x, y, up = direction / np.linalg.norm(direction) * spread * p.uniform(0.6, 1.0)
            leaf = _leaf(0.28, p.leaf * 0.3, p.uniform(-20, 60), 40).turned("z", p.uniform(0, 360))
            yield leaf.at(x, y, high + 0.8 * spread + up * 0.8)


@family(
    "flower_pot",
    variants={"pot": 4, "planted": 6, "bowl": 2, "square": 2, "urn": 2},
    height=(0.75, 1.35), taper=(0.55, 0.9), rim=(0.02, 0.1), rim_height=(0.08, 0.22),
    wall=(0.03, 0.08), soil=(0.6, 0.92), belly=(-0.03, 0.12), plant=(0.7, 1.7), leaf=(0.1, 0.26),
    droop=(20.0, 120.0), foot=(0.3, 0.6), saucer=(0.7, 1.0), leg=(0.08, 0.2),
)  # fmt: skip
def flower_pot(p: Draw) -> Iterable[Solid]:
    """Rim diameter 1, foliage above."""
    h, r = p.height, 0.5
    kind = p.variant
    if kind == "planted":
        kind = p.choice(("pot", "pot", "bowl", "square"))
    t = np.linspace(0, 1, 9)
    if kind == "urn":
        h *= 1.35
        outside = smooth([(p.foot * 0.7, 0), (p.foot * 0.35, 0.14 * h), (0.42 + p.belly, 0.5 * h),
                          (0.4, 0.82 * h), (r, h)], 18)  # fmt: skip
    elif kind == "bowl":
        h *= 0.65
        outside = np.stack([r * (p.taper * 0.8 + (1 - p.taper * 0.8) * np.sin(t * np.pi / 2)),
                            h * t], 1)  # fmt: skip
    else:
        base = r * p.taper
        outside = np.stack([base + (r - base) * t + p.belly * np.sin(np.pi * t), h * t], 1)
    if kind == "pot" and p.chance(0.7):
        step = h - p.rim_height
        outside = outside[outside[:, 1] < step - 0.02]
        outside = np.concatenate([outside, [(r - 0.02, step), (r + p.rim, step), (r + p.rim, h)]])
    facets = 4 if kind == "square" else 36
    if p.chance(0.25):
        solid = revolve(np.concatenate([[(0, 0)], outside]), facets)
    else:
        solid = revolve(hollow(outside, p.wall, 0.05), facets)
    yield solid.turned("z", 45)
    soil = h * p.soil
    if p.variant == "planted" or p.chance(0.3):
        at = float(np.interp(soil, outside[:, 1], outside[:, 0])) * 0.95
        yield cylinder(at, (soil - 0.01, soil), facets).turned("z", 45)
    if p.variant == "planted":
        yield from _foliage(p, soil, 0.5)
    if kind != "urn" and p.chance(0.2):
        yield revolve([(0, -0.05), (p.saucer * 0.6, -0.05), (p.saucer * 0.65, 0.05)], 36)
    elif kind == "square" and p.chance(0.3):
        for x in (-0.2, 0.2):
            for y in (-0.2, 0.2):
                yield box(0.06, 0.06, (-p.leg, 0)).at(x, y)
