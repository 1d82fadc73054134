"""Bowls and cups: open vessels, thin or with both faces of their wall; a mug's handle is at +x."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import smooth
from renderers.shapes.solids import Solid, cylinder, ellipsoid, extrude, revolve, tube


def hollow(outside: NDArray[np.float64], wall: float, floor: float) -> NDArray[np.float64]:
    """An outer profile with its inner face added: up outside, over the rim, down inside."""
    inside = outside[::-1] - (wall, 0)
    inside = inside[(inside[:, 0] > 0) & (inside[:, 1] > floor + outside[0, 1])]
    inside = np.concatenate([inside, [(0, floor + outside[0, 1])]])
    return np.concatenate([[(0, outside[0, 1])], outside, inside])


@family(
    "bowl",
    variants={"round": 5, "flared": 3, "footed": 4, "basin": 4, "closing": 3, "square": 1},
    height=(0.34, 1.15), foot=(0.25, 0.6), foot_height=(0.03, 0.12), belly=(0.35, 0.75),
    wall=(0.015, 0.06), floor=(0.02, 0.08), rim=(0.0, 0.1), rim_height=(0.01, 0.06),
    closing=(0.7, 0.95), oval=(0.6, 0.95), power=(1.6, 3.2), stem=(0.15, 0.45),
)  # fmt: skip
def bowl(p: Draw) -> Iterable[Solid]:
    h = p.height
    t = np.linspace(0, 1, 12)
    power = {"basin": 5.0, "flared": 1.2}.get(p.variant, p.power)
    if p.variant == "closing":
        outside = smooth([(p.foot * 0.8, 0), (0.8, 0.12), (1.0, p.belly), (p.closing, 1.0)], 16)
        h = 0.5 + 0.9 * h
    else:
        start = p.foot if p.variant in ("basin", "square", "flared") else p.foot * 0.4
        r = start + (1 - start) * t ** (0.5 if p.variant == "flared" else 1.0)
        z = t**power if p.variant != "flared" else t ** (0.8 + 0.5 * p.belly)
        if p.variant in ("round", "footed"):  # an arc that meets the rim upright
            r = start + (1 - start) * np.sin(t * np.pi / 2)
            z = (1 - np.cos(t * np.pi / 2)) ** (power / 2)
        elif p.variant == "basin":
            h *= 0.7
            r = np.minimum(1, start * 1.4 + (1 - start) * t * 0.5)
            z = t
        outside = np.stack([r, z], 1)
    outside = outside * (1, h)
    if p.rim > 0.05:
        brim = outside[-1] + np.array([(p.rim, 0.0), (p.rim, p.rim_height)])
        outside = np.concatenate([outside, brim])
    facets = 40 if p.variant != "square" else 4
    thin = p.chance(0.35)
    profile = np.concatenate([[(0, 0)], outside]) if thin else hollow(outside, p.wall, p.floor)
    yield revolve(profile, facets).turned("z", 45).scaled(1.0, p.oval if p.chance(0.15) else 1.0)
    if p.variant == "footed":
        low = -p.foot_height * (1 if p.chance(0.7) else 4)
        ring = [(p.foot * 0.9 + p.stem * 0.2, low), (p.stem + 0.1, low * 0.4), (p.foot * 0.7, 0.03)]
        yield revolve([(0, low), *ring], 32)


@family(
    "cup",
    variants={"mug": 7, "tumbler": 7, "teacup": 2, "goblet": 3},
    height=(0.65, 1.6), taper=(0.5, 1.1), belly=(-0.05, 0.1), wall=(0.02, 0.07),
    floor=(0.02, 0.1), handle=(0.2, 0.36), handle_span=(0.4, 0.7), handle_thickness=(0.03, 0.06),
    handle_at=(0.45, 0.58), heel=(0.01, 0.08), foot=(0.5, 0.85), stem=(0.05, 0.1),
    stem_height=(0.25, 0.5), saucer=(0.75, 1.0),
)  # fmt: skip
def cup(p: Draw) -> Iterable[Solid]:
    """Rim diameter 1."""
    h, r = p.height, 0.5
    if p.variant == "goblet":
        h *= 1.3
        at = h * p.stem_height
        outside = smooth([(p.stem, at), (0.36, at + 0.15 * (h - at)), (r, at + 0.6 * (h - at)),
                          (r * (0.6 + 0.4 * p.taper), h)], 16)  # fmt: skip
        yield revolve(hollow(outside, p.wall * 0.6, p.floor), 36)
        yield revolve([(0, 0), (p.foot * r, 0), (p.foot * r, 0.02), (p.stem, 0.06), (p.stem * 0.8,
                       0.5 * at), (p.stem, at + 0.01)], 28)  # fmt: skip
        return
    if p.variant == "teacup":
        h *= 0.7
        base = r * (0.35 + 0.25 * p.foot)
        outside = smooth([(base, 0), (0.85 * r, 0.3 * h), (0.97 * r, 0.7 * h), (r, h)], 14)
    else:
        if p.variant == "tumbler":
            h *= 1.3
        base = r * (p.taper if p.variant == "tumbler" else 0.5 + 0.5 * p.taper)
        t = np.linspace(0, 1, 10)
        side = base + (r - base) * t + p.belly * np.sin(np.pi * t)
        outside = np.stack([side, t * h], 1)
        outside[0, 0] -= p.heel
        outside[1, 1] = p.heel + 0.02
    facets = 40 if p.chance(0.92) else p.choice((6, 8, 12))
    if p.chance(0.2):
        yield revolve(np.concatenate([[(0, 0)], outside]), facets)
    else:
        yield revolve(hollow(outside, p.wall, p.floor), facets)
    if p.variant in ("mug", "teacup"):
        middle, half = h * p.handle_at, h * p.handle_span / 2
        x = float(np.interp(middle, *outside.T[::-1]))
        out = x + p.handle
        if p.chance(0.75):
            knee = x + 0.6 * p.handle
            curve = smooth([(x - 0.02, 0, middle + half * 0.9), (knee, 0, middle + half),
                            (out, 0, middle + 0.2 * half), (knee, 0, middle - 0.8 * half),
                            (x - 0.03, 0, middle - half)], 18)  # fmt: skip
            yield tube(curve, p.handle_thickness).scaled(1.0, p.choice((1.0, 1.6)), 1.0)
        else:  # a square handle
            thick = p.handle_thickness
            outer = [(x - 0.03, middle - half), (out, middle - half), (out, middle + half),
                     (x - 0.03, middle + half)]  # fmt: skip
            low, high, end = middle - half + thick, middle + half - thick, out - thick
            inner = [(x - 0.02, low), (end, low), (end, high), (x - 0.02, high)]
            yield extrude(outer, 1.5 * thick, "y", [inner])
    if p.variant == "teacup" and p.chance(0.4):
        yield revolve([(0, -0.03), (0.3, -0.03), (p.saucer, 0.06)], 36)
    if p.chance(0.06):
        yield ellipsoid(0.02, 0.02, 0.5 * h, 8).turned("x", 20).at(0.1, 0, 0.9 * h)
    if p.variant == "tumbler" and p.chance(0.15):
        yield cylinder(r * 1.03, (h, h + 0.06), 36)
