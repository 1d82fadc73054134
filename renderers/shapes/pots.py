"""Flower pots, empty or planted."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from renderers.shapes.crockery import hollow
from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import smooth
from renderers.shapes.plants import leaf, scattered
from renderers.shapes.solids import Solid, box, cylinder, four, join, revolve


def _foliage(p: Draw, spread: float) -> Iterable[Solid]:
    """What grows out of the earth at z = 0."""
    style = p.choice(("rosette", "rosette", "stems", "bush", "tree"))
    if style == "rosette":
        for i in range(p.integer(8, 32)):
            blade = leaf(p.plant * p.uniform(0.6, 1.1), p.leaf * p.uniform(0.5, 1.1),
                         p.uniform(35, 88), p.droop * p.uniform(0.3, 1.2))  # fmt: skip
            yield blade.turned("z", 137.5 * i + p.uniform(-20, 20))
    elif style == "stems":
        for _ in range(p.integer(2, 7)):
            turn, lean, tall = p.uniform(0, 360), p.uniform(0, 25), p.plant * p.uniform(0.7, 1.1)
            stem = [cylinder(0.012, (0, tall), 6)]
            for level in np.linspace(0.35, 1.0, p.integer(3, 7)):
                blade = leaf(0.35 * p.plant, 0.8 * p.leaf, p.uniform(10, 60), 0.5 * p.droop, 5)
                stem.append(blade.turned("z", p.uniform(0, 360)).at(z=tall * level))
            yield join(stem).turned("y", lean).turned("z", turn)
    else:
        high = 0.3 * spread
        if style == "tree":
            high = p.plant * 0.8
            yield cylinder(0.03, (0, high), 8)
        size = spread * p.uniform(0.5, 1.2)
        radii = size * np.array([1.0, 1.0, p.uniform(0.5, 1.1)])
        yield scattered(p.rng, p.integer(80, 300), 0.5 * p.leaf, radii, 0.5).at(z=high + radii[2])


@family(
    "flower_pot",
    variants={"pot": 3, "planted": 9, "bowl": 1, "square": 1, "urn": 2, "slender": 3},
    height=(0.75, 1.35), taper=(0.55, 0.9), rim=(0.02, 0.1), rim_height=(0.08, 0.22),
    wall=(0.03, 0.08), soil=(0.6, 0.92), belly=(-0.03, 0.12), plant=(0.6, 2.2), leaf=(0.08, 0.3),
    droop=(20.0, 120.0), foot=(0.3, 0.6), saucer=(0.7, 1.0), leg=(0.08, 0.2),
)  # fmt: skip
def flower_pot(p: Draw) -> Iterable[Solid]:
    """Rim diameter 1, foliage above."""
    h, r = p.height, 0.5
    kind = p.variant
    if kind == "planted":
        kind = p.choice(("pot", "pot", "pot", "bowl", "square", "slender"))
    t = np.linspace(0, 1, 9)
    if kind == "urn":
        h *= 1.35
        outside = smooth([(p.foot * 0.7, 0), (p.foot * 0.35, 0.14 * h), (0.42 + p.belly, 0.5 * h),
                          (0.4, 0.82 * h), (r, h)], 18)  # fmt: skip
    elif kind == "slender":  # as a vase: only what grows in it tells them apart
        h *= 1.9
        outside = smooth([(0.3 * p.taper, 0), (0.42 + p.belly, 0.35 * h), (0.4, 0.6 * h),
                          (0.4 * p.foot, 0.88 * h), (0.55 * p.foot, h)], 18)  # fmt: skip
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
        yield join(_foliage(p, r)).at(z=soil)
    if kind != "urn" and p.chance(0.2):
        yield revolve([(0, -0.05), (p.saucer * 0.6, -0.05), (p.saucer * 0.65, 0.05)], 36)
    elif kind == "square" and p.chance(0.3):
        yield four(box(0.06, 0.06, (-p.leg, 0)).at(0.2, 0.2))
