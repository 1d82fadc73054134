"""Bookshelves (open to −y) and glass boxes: panels, shelves and partitions."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import numpy as np

from renderers.shapes.family import Draw, family
from renderers.shapes.solids import Solid, both, box, four


def _books(
    p: Draw, x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]
) -> Iterable[Solid]:
    """A row of books in a cell; the row ends somewhere."""
    at, end = x[0], x[0] + (x[1] - x[0]) * p.uniform(0.4, 1.0)
    room = z[1] - z[0]
    while True:
        thick = p.uniform(0.6, 1.6) * p.book
        if at + thick > end:
            return
        deep = (y[1] - y[0]) * p.uniform(0.6, 0.9)
        tall = room * p.uniform(0.6, 0.92)
        yield box((at, at + thick * 0.95), (y[1] - deep, y[1]), (z[0], z[0] + tall))
        at += thick


@family(
    "bookshelf",
    variants={"upright": 8, "grid": 3, "low": 1, "open": 2, "stepped": 1, "cupboard": 1},
    width=(0.5, 1.1), height=(1.1, 2.0), depth=(0.22, 0.48), panel=(0.012, 0.04),
    shelf=(0.012, 0.04), recess=(0.0, 0.04), plinth=(0.0, 0.09), crown=(0.0, 0.04),
    back=(0.004, 0.02), book=(0.025, 0.06), fill=(0.2, 1.0), foot=(0.03, 0.12),
    cupboard=(0.25, 0.45), step=(0.35, 0.8),
)  # fmt: skip
def bookshelf(p: Draw) -> Iterable[Solid]:
    w, h, d = p.width, p.height, p.depth
    if p.variant == "low":
        w, h = w + 0.7, 0.45 * h
    elif p.variant == "grid":
        w, h = w + 0.3, 0.75 * h
    low = p.foot if p.variant == "open" else p.plinth
    y = (-d / 2, d / 2)
    inner = w - 2 * p.panel

    # carcass
    if p.variant == "open":
        yield four(box(p.panel * 1.5, p.panel * 1.5, (0, h)).at(w / 2, d / 2))
    else:
        yield both(box(p.panel, y, (0, h)).at((w - p.panel) / 2))
        if low > 0.02:
            yield box(inner, (y[0] + 0.02, y[1]), (0, low))
    if p.chance(0.75) and p.variant != "open":
        yield box(w, (y[1] - p.back, y[1]), (low, h))
    yield box(w + 2 * p.crown, d + p.crown, (h, h + p.shelf))

    # shelves and partitions
    rows = {"low": p.integer(2, 3), "grid": p.integer(3, 5)}.get(p.variant, p.integer(3, 7))
    columns = p.choice((1, 1, 1, 2))
    if p.variant in ("low", "grid"):
        columns = p.integer(2, 5)
    levels = np.linspace(low, h, rows + 1)
    if p.chance(0.4):  # shelves grow lower towards the top
        levels = low + (h - low) * np.linspace(0, 1, rows + 1) ** 0.85
    front = y[0] + (0.0 if p.variant == "open" else p.recess)
    uprights = np.linspace(-inner / 2, inner / 2, columns + 1)
    stocked = p.chance(0.35)
    for row, (z0, z1) in enumerate(pairwise(levels)):
        wide = inner
        if p.variant == "stepped":
            wide = inner * (1 - (1 - p.step) * row / max(rows - 1, 1))
        yield box(wide, (front, y[1]), (z0, z0 + p.shelf))
        for x in uprights[1:-1]:
            if abs(x) < wide / 2:
                yield box(p.panel, (front, y[1]), (z0, z1)).at(x)
        if stocked:
            for x0, x1 in pairwise(uprights):
                if p.chance(p.fill):
                    cell = (max(x0 + p.panel, -wide / 2), min(x1 - p.panel, wide / 2))
                    yield from _books(p, cell, (front, y[1]), (z0 + p.shelf, z1))
    if p.variant == "cupboard":
        z = (low + 0.005, low + (h - low) * p.cupboard)
        leaf = box((0.003, inner / 2), (y[0] - 0.02, y[0]), z)
        yield both(leaf)
        yield both(box((0.02, 0.04), (y[0] - 0.045, y[0] - 0.02), ((z[0] + z[1]) / 2, z[1] - 0.04)))


def _shell(x: float, y: float, z: tuple[float, float], wall: float, lid: bool) -> Iterable[Solid]:
    """Four walls, a floor and perhaps a lid, each a thin slab."""
    yield both(box(wall, y, z).at((x - wall) / 2))
    yield both(box(x, wall, z).at(0, (y - wall) / 2), "y")
    yield box(x, y, (z[0], z[0] + wall))
    if lid:
        yield box(x, y, (z[1] - wall, z[1]))


@family(
    "glass_box",
    variants={"plain": 6, "divided": 7, "grid": 1, "vitrine": 2, "cased": 2},
    length=(1.0, 2.0), width=(0.4, 1.25), height=(0.34, 1.05), wall=(0.01, 0.045),
    partition=(0.01, 0.03), stand=(0.05, 0.25), edge=(0.02, 0.06), shelf=(0.3, 0.7),
    lid=(0.0, 0.05), post=(0.02, 0.05),
)  # fmt: skip
def glass_box(p: Draw) -> Iterable[Solid]:
    x, y, h = p.length, min(p.width, p.length), p.height
    open_top = p.chance(0.15)
    yield from _shell(x, y, (0, h), p.wall, not open_top)
    if p.chance(0.25):
        yield box(x + 2 * p.lid, y + 2 * p.lid, (h, h + p.wall + 0.01))
        yield box(x + 2 * p.lid, y + 2 * p.lid, (-p.wall - 0.01, 0))
    if p.variant in ("divided", "grid"):
        nx, ny = (p.integer(3, 4), p.integer(2, 4)) if p.variant == "grid" else p.choice(
            ((2, 1), (3, 1), (3, 1), (4, 1), (1, 2), (2, 2)))  # fmt: skip
        for at in np.linspace(-x / 2, x / 2, nx + 1)[1:-1]:
            yield box(p.partition, y, (0, h)).at(at)
        for at in np.linspace(-y / 2, y / 2, ny + 1)[1:-1]:
            yield box(x, p.partition, (0, h)).at(0, at)
        if p.variant == "grid":
            for at in np.linspace(0, h, p.integer(2, 4) + 1)[1:-1]:
                yield box(x, y, (at, at + p.partition))
    elif p.variant == "vitrine":  # a frame of posts, on feet, with a shelf
        yield four(box(p.post, p.post, (-p.stand, h)).at(x / 2, y / 2))
        for z in (0.0, h):
            yield both(box(x, p.post, p.post).at(0, y / 2, z), "y")
            yield both(box(p.post, y, p.post).at(x / 2, 0, z))
        if p.chance(0.6):
            yield box(x, y, (h * p.shelf, h * p.shelf + p.partition))
    elif p.variant == "cased":  # bands of metal along the twelve edges
        e = p.edge
        for z in (e / 2, h - e / 2):
            yield both(box(x + 0.01, e, e).at(0, (y - e) / 2, z), "y")
            yield both(box(e, y + 0.01, e).at((x - e) / 2, 0, z))
        yield four(box(e, e, (0, h)).at((x - e) / 2, (y - e) / 2))
