"""Flat things in the x-z plane: curtains and doors."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import pairwise

import numpy as np

from renderers.shapes.family import Draw, family
from renderers.shapes.solids import Solid, both, box, ellipsoid, extrude, join, rod, sheet


def _drape(p: Draw, edge: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]) -> Solid:
    """Pleated cloth between z = 0 and 1; ``edge`` maps heights to its left and right border."""
    u = np.linspace(0, 1, 14 * p.integer(5, 9))
    z = np.linspace(0, 1, 15)
    left, right = edge(z)
    fold = p.pleat * np.sin(2 * np.pi * u * p.pleats + p.phase)
    fold = np.sign(fold) * np.abs(fold) ** p.crease * p.pleat ** (1 - p.crease)
    swell = 0.55 + 0.45 * p.flare * (1 - z) + 0.45 * (1 - p.flare) * z
    grid = np.zeros((len(z), len(u), 3))
    grid[..., 0] = left[:, None] + (right - left)[:, None] * u
    grid[..., 1] = fold * swell[:, None] + p.drift * np.sin(3 * z + p.phase)[:, None] * p.pleat
    grid[..., 2] = z[:, None]
    return sheet(grid)


@family(
    "curtain",
    variants={"full": 9, "pair": 1, "tied": 3, "pair_tied": 1, "drawn": 3, "blind": 1},
    width=(0.15, 1.8), pleat=(0.004, 0.05), pleats=(5.0, 16.0), crease=(0.5, 1.2),
    phase=(0.0, 6.28), flare=(0.0, 1.0), drift=(0.0, 0.6), tie_height=(0.3, 0.6),
    tie_width=(0.15, 0.4), opening=(0.05, 0.4), rod=(0.008, 0.02), valance=(0.08, 0.2),
)  # fmt: skip
def curtain(p: Draw) -> Iterable[Solid]:
    w = p.width
    if p.variant in ("pair", "tied", "pair_tied"):
        w = 0.4 + 0.6 * w

    def straight(low: float, high: float) -> Solid:
        return _drape(p, lambda z: (0 * z + low, 0 * z + high))

    def tied(low: float, high: float) -> Solid:
        """Gathered towards x = low at the tie, hanging narrow below it."""

        def edge(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            above = np.clip((z - p.tie_height) / (1 - p.tie_height), 0, 1)
            below = np.clip((p.tie_height - z) / p.tie_height, 0, 1)
            open_part = p.tie_width + (1 - p.tie_width) * np.sin(above * np.pi / 2) ** 1.5
            return 0 * z + low, low + (high - low) * (open_part + 0.12 * below)

        return _drape(p, edge)

    if p.variant == "full":
        yield straight(-w / 2, w / 2)
    elif p.variant == "pair":
        yield straight(-w / 2, -p.opening * w / 2)
        yield straight(p.opening * w / 2, w / 2)
    elif p.variant == "drawn":  # pushed to one end of its rod
        end = (0.6 + p.opening) * p.choice((-1.0, 1.0))
        gathered = straight(0.0, p.tie_width * w + 0.1)
        yield gathered if end > 0 else gathered.mirrored("x")
        yield rod((-np.sign(end) * 0.04, 0, 1.01), (end + 0.1, 0, 1.01), p.rod)
        return
    elif p.variant == "blind":
        for z in np.linspace(0, 1, p.integer(12, 30)):
            yield box(w, 0.004, 0.03).turned("x", 60 * p.flare).at(z=z)
    elif p.variant == "tied":
        hanging = tied(0.0, 0.75 * w)
        yield hanging if p.chance(0.5) else hanging.mirrored("x")
    else:
        yield both(tied(-w / 2, -0.01))
    if p.chance(0.35):
        bar = rod((-w / 2 - 0.06, 0, 1.01), (w / 2 + 0.06, 0, 1.01), p.rod)
        yield bar
        if p.chance(0.5):
            yield both(ellipsoid(2 * p.rod, 2 * p.rod, 2 * p.rod, 10).at(w / 2 + 0.06, 0, 1.01))
    if p.variant in ("pair", "pair_tied", "full") and p.chance(0.25):
        yield straight(-w / 2, w / 2).scaled(1.02, 1.4, p.valance).at(z=1 - 0.9 * p.valance)


@family(
    "door",
    variants={"slab": 6, "panelled": 5, "double": 2, "glazed": 1, "arched": 1, "ajar": 1,
              "doorway": 1},
    width=(0.78, 1.05), height=(1.9, 2.3), thickness=(0.015, 0.1), frame=(0.04, 0.12),
    frame_depth=(0.04, 0.25), stile=(0.08, 0.16), relief=(0.008, 0.025), handle_height=(0.44, 0.52),
    handle=(0.03, 0.07), rail=(0.35, 0.6), arch=(0.15, 0.45), open=(20.0, 95.0),
)  # fmt: skip
def door(p: Draw) -> Iterable[Solid]:
    w, h, t = p.width, p.height, p.thickness
    if p.variant == "double":
        w *= 1.45
    elif p.chance(0.15):
        w *= 0.8

    def leaf(x0: float, x1: float, lock: float) -> Solid:
        """One leaf; ``lock`` is ±1 for the side of the handle."""
        style = p.variant
        if style in ("double", "ajar"):
            style = p.choice(("panelled", "slab", "glazed"))
        s = p.stile * (x1 - x0)
        inner = (x0 + s, x1 - s)
        cells = [(s, h * p.rail - s / 2), (h * p.rail + s / 2, h - s)]
        parts = []
        if style == "glazed":
            holes = [[(inner[0], a), (inner[1], a), (inner[1], b), (inner[0], b)] for a, b in cells]
            keep = holes if p.chance(0.5) else holes[1:]
            outline = [(x0, 0), (x1, 0), (x1, h), (x0, h)]
            parts.append(extrude(outline, t, "y", keep))
            if p.chance(0.5):
                parts.append(box(inner, 0.006, cells[1]))
        else:
            parts.append(box((x0, x1), t, (0, h)))
        if style == "panelled":
            columns = p.choice((1, 2, 2))
            edges = np.linspace(*inner, columns + 1)
            for a, b in cells:
                for left, right in pairwise(edges):
                    panel = box((left + 0.02, right - 0.02), t + 2 * p.relief, (a, b))
                    parts.append(panel)
        x, z = (x1 - 0.5 * s if lock > 0 else x0 + 0.5 * s), h * p.handle_height
        if p.chance(0.7):
            if p.chance(0.5):
                parts.append(both(ellipsoid(0.03, 0.03, 0.03, 10).at(x, t / 2 + p.handle, z), "y"))
            else:
                grip = box((x - lock * 0.06 - 0.07, x - lock * 0.06 + 0.07), 0.015, 0.02)
                parts.append(both(grip.at(0, t / 2 + p.handle, z), "y"))
            parts.append(box(0.02, t + 2 * p.handle, 0.02).at(x, 0, z))
        return join(parts)

    def finish_leaf() -> Iterable[Solid]:
        if p.variant == "double":
            yield leaf(-w / 2, -0.004, 1)
            yield leaf(0.004, w / 2, -1)
        elif p.variant == "doorway":  # a frame without a leaf
            yield both(box((w / 2 - 0.02, w / 2), t, (0, h)))
        elif p.variant == "ajar":
            yield leaf(0, w, 1).turned("z", -p.open).at(-w / 2)
        elif p.variant == "arched":
            x = np.linspace(w / 2, -w / 2, 17)
            crown = h - p.arch + p.arch * np.sqrt(np.clip(1 - (2 * x / w) ** 2, 0, 1))
            outline = [(-w / 2, 0), (w / 2, 0), *zip(x, crown, strict=True)]
            yield extrude(outline, t, "y")
            if p.chance(0.6):
                grown = np.array(outline) * (1 + 2 * p.frame / w, 1 + p.frame / h)
                yield extrude(grown, p.frame_depth, "y", [outline])
        else:
            yield leaf(-w / 2, w / 2, 1)

    yield from finish_leaf()
    if p.variant != "arched" and (p.variant in ("ajar", "doorway") or p.chance(0.6)):
        f, d = p.frame, p.frame_depth
        yield both(box((w / 2, w / 2 + f), d, (0, h + f)))
        yield box(w, d, (h, h + f))
        if p.chance(0.2):
            yield box(w + 2 * f, d, (-0.03, 0))
