"""Vases: turned vessels from goblets to bottles, some square."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import smooth
from renderers.shapes.solids import Solid, both, revolve, tube


@family(
    "vase",
    variants={"urn": 4, "bottle": 2.5, "trumpet": 2, "cylinder": 2, "ball": 1.5, "goblet": 1.2,
              "gourd": 1, "lidded": 1, "flared": 1, "pot": 1},
    height=(0.8, 2.8), belly=(0.4, 0.56), belly_level=(0.35, 0.75), foot=(0.4, 0.85),
    neck=(0.25, 0.75), neck_level=(0.7, 0.92), lip=(0.8, 1.7), wall=(0.02, 0.07),
    pinch=(0.55, 1.0), wave=(0.0, 0.06), rim=(0.0, 0.05), handle=(0.15, 0.35), twist=(0.0, 60.0),
)  # fmt: skip
def vase(p: Draw) -> Iterable[Solid]:
    """A thin or a double-walled vessel, open above unless it has its lid on."""
    tall = p.height
    if p.variant == "ball":
        tall = 2 * p.belly * (0.75 + 0.35 * p.neck_level)
    elif p.variant == "pot":
        tall = 2 * p.belly * (0.5 + 0.5 * p.neck_level)
    outside = smooth(_outline(p), 30)
    outside[:, 0] = np.maximum(outside[:, 0], 0.03)
    if p.wave > 0.04:
        outside[:, 0] *= 1 + p.wave * 0.5 * np.sin(outside[:, 1] * 40)
    outside[:, 1] *= tall
    profile = [np.array([(0.0, 0.0)]), outside]
    if p.rim > 0.025:
        edge = outside[-1]
        profile.append(np.array([edge * (1.08, 1), edge * (1.08, 1) + (0, p.rim)]))
    if p.variant != "lidded" and p.chance(0.45):
        inside = outside[:1:-1] - (p.wall * 0.5, 0)
        inside[:, 0] = np.maximum(inside[:, 0], 0.015)
        inside[:, 1] = np.maximum(inside[:, 1], p.wall)
        profile += [inside, np.array([(0.0, p.wall)])]
    angular = p.chance(0.16)
    sides = p.choice((4, 4, 6, 8)) if angular else 32
    vessel = revolve(np.concatenate(profile), sides)
    if sides == 4:
        vessel = vessel.turned("z", 45).scaled(1.1, 1.1, 1.0)
    if angular and p.chance(0.25):
        turn = np.radians(p.twist)

        def twisted(v: np.ndarray) -> np.ndarray:
            a = turn * v[:, 2] / tall
            x, y = v[:, 0].copy(), v[:, 1].copy()
            v[:, 0], v[:, 1] = x * np.cos(a) - y * np.sin(a), x * np.sin(a) + y * np.cos(a)
            return v

        vessel = vessel.warped(twisted)
    yield vessel
    if p.variant in ("urn", "bottle") and p.chance(0.2):
        r = p.belly
        reach, level = r + p.handle * 0.6, p.belly_level * p.neck_level
        knots = [(r * p.neck, 0, 0.93), (reach, 0, 0.88), (reach, 0, 0.65), (r * 0.9, 0, level)]
        path = smooth(np.array(knots) * (1, 1, tall), 10)
        yield both(tube(path, 0.03))


def _outline(p: Draw) -> list[tuple[float, float]]:
    """Radius and height of the outside at its turning points, from foot to lip, height 1."""
    r = p.belly
    neck = r * p.neck
    level, top = p.belly_level * p.neck_level, p.neck_level
    foot = (r * p.foot, 0.0)
    if p.variant == "urn":
        return [foot, (r * (p.foot + 1) / 2, level * 0.5), (r, level),
                (r * 0.85, (level + top) / 2), (neck, top), (neck * p.lip, 1)]  # fmt: skip
    if p.variant == "bottle":
        level *= 0.7
        slim, shoulder = neck * 0.5, level + (1 - level) * 0.35
        return [foot, (r, level * 0.6), (r * 0.97, level), (slim * 1.3, shoulder),
                (slim, (shoulder + 1) / 2), (slim * (0.6 + 0.4 * p.lip), 1)]  # fmt: skip
    if p.variant == "trumpet":
        low = r * p.foot * 0.8
        return [(low, 0), (low * p.pinch, 0.25 + 0.3 * p.rim), (low * 1.1, 0.6), (r * 0.75, 0.85),
                (r, 1)]  # fmt: skip
    if p.variant == "cylinder":
        r *= 0.85
        return [(r * (0.6 + 0.4 * p.foot), 0), (r * p.pinch, 0.35), (r * (p.pinch + 1) / 2, 0.7),
                (r * (0.7 + 0.25 * p.lip), 1)]  # fmt: skip
    if p.variant == "ball":
        return [(r * p.foot * 0.7, 0), (r * 0.95, 0.28), (r, 0.5), (r * 0.85, 0.78),
                (neck * 1.1, 0.97), (neck * (0.8 + 0.3 * p.lip), 1)]  # fmt: skip
    if p.variant == "goblet":
        stem = r * 0.15 / p.pinch
        return [foot, (r * p.foot * 0.8, 0.05), (stem, 0.15 + p.rim), (stem, 0.35),
                (r * 0.8, 0.5 + p.rim), (r, 0.75), (r * (0.6 + 0.3 * p.lip), 1)]  # fmt: skip
    if p.variant == "gourd":
        upper = r * (0.5 + 0.4 * p.neck)
        return [foot, (r, level * 0.55), (r * 0.9, level * 0.8), (upper * 0.75, level),
                (upper, (level + top) / 2), (upper * p.pinch * 0.6, top),
                (upper * p.pinch * 0.5 * p.lip, 1)]  # fmt: skip
    if p.variant == "lidded":
        return [foot, (r * (p.foot + 1) / 2, level * 0.5), (r, level), (r * 0.7, top * 0.85),
                (r * 0.75, top * 0.9), (neck * 0.7, top + 0.03), (0.05, 0.95), (0.06, 0.98),
                (0.03, 1)]  # fmt: skip
    if p.variant == "flared":
        return [(r, 0), (r * 0.8 * p.pinch, 0.2), (neck * 0.9, 0.55), (neck * 0.6, 0.9),
                (neck * (0.3 + 0.4 * p.lip), 1)]  # fmt: skip
    return [foot, (r * (0.9 + 0.1 * p.foot), level * 0.6), (r, level), (r * 0.8, top * 0.9),
            (r * (0.65 + 0.2 * p.neck), top), (r * (0.5 + 0.4 * p.lip), 1)]  # fmt: skip
