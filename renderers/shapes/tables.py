"""Tables and stools: a plate on legs, on a column, on trestles, on panels."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import Extent, circle, rounded_rectangle, smooth, superellipse
from renderers.shapes.solids import (
    Solid,
    beam,
    box,
    cylinder,
    extrude,
    four,
    join,
    revolve,
    ring,
    rod,
    sheet,
    tube,
)

LEG_STYLES = ("square", "square", "square", "round", "turned", "sheet")


def plate(shape: str, x: float, y: float, z: Extent, corner: float = 0.1) -> Solid:
    """A flat top: "box", "soft" (round corners), "boat" (bowed sides) or "oval" (round, x = y)."""
    if shape == "box":
        return box(x, y, z)
    if shape == "soft":
        return extrude(rounded_rectangle(x, y, corner * min(x, y)), z)
    return extrude(superellipse(x / 2, y / 2, 2.0 if shape == "oval" else 3.5, 40), z)


def leg(style: str, foot: ArrayLike, head: ArrayLike, thickness: float, taper: float) -> Solid:
    """One leg from foot to head; ``taper`` is the foot's thickness over the head's."""
    foot, head = np.asarray(foot, np.float64), np.asarray(head, np.float64)
    if style == "round":
        return rod(head, foot, thickness / 2, taper=taper)
    if style == "turned":
        heights = [0, 0.04, 0.12, 0.3, 0.55, 0.75, 0.8, 0.84, 1]
        radii = [taper, 1.1, 0.6, 0.7, 1.15, 0.7, 1.2, 0.8, 1.1]
        profile = np.stack([np.array(radii) * thickness / 2, np.array(heights)], 1)
        profile = np.concatenate([[(0, 0)], smooth(profile, 16), [(0, 1)]])
        shear = head - foot

        def along(v: np.ndarray) -> np.ndarray:
            return foot + v * (1, 1, 0) + v[:, 2:] * shear

        return revolve(profile, 10).warped(along)
    if style == "sheet":
        return beam(head, foot, thickness * 0.4, thickness * 1.6, taper=taper)
    return beam(head, foot, thickness, thickness, taper=taper)


def star_foot(count: int, reach: float, height: float, thickness: float) -> Solid:
    """Arched feet around a column: each runs out from the column at ``height`` to the floor."""
    path = smooth([(0, 0, height), (reach * 0.5, 0, height * 0.75), (reach, 0, thickness / 2)], 6)
    return ring(tube(path, thickness / 2, segments=6), count, 45.0 if count == 4 else 0.0)


@family(
    "table",
    variants={"legs": 6, "shelf": 2.5, "pedestal": 2, "trestle": 2, "panels": 1.5, "frame": 1.5,
              "side": 2},
    width=(0.36, 0.85), height=(0.26, 0.6), top=(0.012, 0.06), thickness=(0.025, 0.075),
    taper=(0.5, 1.1), inset=(0.0, 0.12), splay=(-0.02, 0.06), apron=(0.03, 0.13),
    level=(0.1, 0.5), corner=(0.05, 0.4), slim=(0.7, 1.4), overhang=(0.0, 0.22),
)  # fmt: skip
def table(p: Draw) -> Iterable[Solid]:
    """The long side runs along y."""
    length, width, height = 1.0, p.width, p.height
    if p.variant == "side":
        length, width, height = 0.6, 0.6 * min(1.0, p.width * 1.4), 0.6 * p.slim
    shape = p.choice(("box", "box", "box", "box", "soft", "boat"))
    if p.chance(0.6 if p.variant == "pedestal" else 0.12):
        shape = "oval"
        width = length if p.chance(0.75) else max(width, 0.6)
        height = max(height, 0.35)
    under = height - p.top
    yield plate(shape, width, length, (under, height), p.corner)
    inside = 0.29 if shape == "oval" else 0.0
    x = width * (0.5 - inside / 2) - p.thickness / 2 - p.inset * width
    y = length * (0.5 - inside / 2) - p.thickness / 2 - p.inset * length * 0.7 - p.overhang * 0.15
    if p.variant in ("legs", "shelf", "side"):
        yield from _on_legs(p, shape, x, y, under)
    elif p.variant == "pedestal":
        yield from _on_pedestal(p, shape, width, length, under)
    elif p.variant == "trestle":
        yield from _on_trestles(p, width, length, under)
    elif p.variant == "panels":
        yield from _on_panels(p, x, y, width, under)
    else:
        yield from _on_frame(p, x, y, under)


def _on_legs(p: Draw, shape: str, x: float, y: float, under: float) -> Iterable[Solid]:
    style = p.choice(LEG_STYLES)
    foot = (x + p.splay, y + p.splay, 0)
    yield four(leg(style, foot, (x, y, under), p.thickness, p.taper))
    if p.chance(0.65):
        depth = min(p.apron, under * 0.4)
        bar = p.thickness * 0.3
        yield box((x - bar, x + bar), 2 * y, (under - depth, under))
        yield box((-x - bar, -x + bar), 2 * y, (under - depth, under))
        yield box(2 * x, (y - bar, y + bar), (under - depth, under))
        yield box(2 * x, (-y - bar, -y + bar), (under - depth, under))
        if p.chance(0.3):
            yield box(2 * x, 2 * y, (under - depth, under - depth * 0.95))
    level = under * p.level
    if p.variant == "shelf" or (p.variant == "side" and p.chance(0.6)):
        thick = max(p.top * 0.7, 0.012)
        shelf = "oval" if shape == "oval" else "box"
        yield plate(shelf, 2 * x + p.thickness, 2 * y + p.thickness, (level, level + thick))
    elif p.chance(0.3):
        bar = p.thickness * 0.5
        yield box((x - bar / 2, x + bar / 2), 2 * y, (level, level + bar))
        yield box((-x - bar / 2, -x + bar / 2), 2 * y, (level, level + bar))
        yield box(2 * x, bar, (level, level + bar))


def _on_pedestal(p: Draw, shape: str, width: float, length: float, under: float) -> Iterable[Solid]:
    radius = p.thickness * p.slim
    reach = width * (0.24 + p.inset)
    column = p.choice(("straight", "turned", "drum"))
    if column == "straight":
        part = cylinder(radius, (0, under))
    elif column == "turned":
        profile = [(1.8, 0.02), (1.2, 0.15), (0.7, 0.3), (1.3, 0.5), (0.7, 0.75), (1.6, 1)]
        points = smooth(np.array(profile) * (radius, under), 18)
        part = revolve(np.concatenate([[(0, 0)], points, [(0, under)]]))
    else:
        part = cylinder(reach * 0.7, (0, under), top=reach * p.slim * 0.6)
    foot = p.choice(("star", "disc", "square"))
    if foot == "star":
        legs = star_foot(p.choice((3, 4, 4, 5)), reach * 1.2, under * 0.25, p.thickness * 0.8)
        part = join(part, legs)
    elif foot == "disc":
        part = join(part, cylinder(reach, (0, p.top), top=reach * p.taper))
    else:
        part = join(part, box(2 * reach, 2 * reach, (0, p.top * 1.5)))
    if length > 1.5 * width and shape != "oval":
        yield part.at(y=length * 0.27)
        yield part.at(y=-length * 0.27)
    else:
        yield part


def _on_trestles(p: Draw, width: float, length: float, under: float) -> Iterable[Solid]:
    y = length * (0.36 - 0.6 * p.inset)
    half, bar = width * 0.4, p.thickness * 0.8
    kind = p.choice(("cross", "spread", "foot"))
    for side in (-y, y):
        if kind == "cross":
            yield beam((-half, side, 0), (half * 0.8, side, under), bar, bar)
            yield beam((half, side, 0), (-half * 0.8, side, under), bar, bar)
        elif kind == "spread":
            yield beam((-half, side, 0), (-half * 0.35, side, under), bar, bar)
            yield beam((half, side, 0), (half * 0.35, side, under), bar, bar)
            level = under * (0.3 + p.level)
            yield box(half * 1.4, (side - bar / 2, side + bar / 2), (level, level + bar))
        else:
            yield box(2 * half, (side - bar, side + bar), (0, bar))
            yield box(half * p.slim, (side - bar / 2, side + bar / 2), (0, under))
            yield box(2 * half, (side - bar, side + bar), (under - bar, under))
    level = under * (0.25 + p.level)
    yield box(bar * 0.6, 2 * y, (level, level + bar * 1.4))


def _on_panels(p: Draw, x: float, y: float, width: float, under: float) -> Iterable[Solid]:
    thick = p.thickness * 0.6
    along_y = p.chance(0.75)
    for side in (-1, 1):
        if along_y:
            yield box(2 * x, (side * y - thick / 2, side * y + thick / 2), (0, under))
        else:
            yield box((side * x - thick / 2, side * x + thick / 2), 2 * y, (0, under))
    if p.chance(0.6):
        level = under * p.level
        yield box(2 * x, 2 * y, (level, level + p.top))
    if p.chance(0.4):
        yield box(thick, 2 * y, (under * p.level, under))


def _on_frame(p: Draw, x: float, y: float, under: float) -> Iterable[Solid]:
    """Two closed frames of bar, as under a metal coffee table."""
    bar = p.thickness * 0.5
    square = circle(bar * 0.7, 4)
    for side in (-y, y):
        for low in (0.0, under - bar):
            yield box(2 * x, (side - bar / 2, side + bar / 2), (low, low + bar))
    yield four(box((x - bar, x), (y - bar / 2, y + bar / 2), (0, under)))
    if p.chance(0.5):
        yield box((x - bar, x), 2 * y, (0, bar))
        yield box((-x, -x + bar), 2 * y, (0, bar))
    elif p.chance(0.5):
        yield extrude(square, (-y, y), "y").at(z=bar / 2)
    if p.chance(0.4):
        level = under * p.level
        yield box(2 * x, 2 * y, (level, level + bar * 0.5))


@family(
    "stool",
    variants={"legs": 3.5, "three_legs": 1, "pedestal": 2.5, "star": 1, "backed": 1.5, "hoop": 1,
              "shell": 1.2},
    width=(0.3, 0.56), height=(0.5, 0.95), seat=(0.02, 0.12), depth=(0.8, 1.0),
    thickness=(0.02, 0.06), splay=(0.0, 0.09), rest=(0.18, 0.45), foot=(0.35, 0.6),
    taper=(0.6, 1.1), crown=(0.0, 0.03), back=(0.12, 0.3),
)  # fmt: skip
def stool(p: Draw) -> Iterable[Solid]:
    """Seats on tall legs or a column; the symmetry about z is the class's, not every part's."""
    wide, height = p.width, p.height
    rounded = p.variant in ("three_legs", "pedestal", "star", "hoop") or p.chance(0.35)
    under = height - p.seat
    if p.variant == "shell":
        yield from _shell(p, under)
    elif rounded:
        r = wide / 2
        yield revolve([
            (0, under), (r * 0.9, under), (r, under + p.seat * 0.3), (r, height - p.seat * 0.2),
            (r * 0.9, height), (0, height + p.crown),
        ])  # fmt: skip
        x = y = wide * 0.3
    else:
        shape = p.choice(("box", "soft"))
        yield plate(shape, wide, wide * p.depth, (under, height), 0.15)
        x, y = wide / 2 - p.thickness / 2, wide * p.depth / 2 - p.thickness / 2
    if p.variant in ("pedestal", "star", "shell"):
        yield from _stool_column(p, under)
    elif p.variant == "hoop":
        yield from _stool_hoops(p, under)
    else:
        yield from _stool_legs(p, x, y, under)
    if p.variant == "backed":
        bar = p.thickness * 0.7
        top = height + p.back
        yield box((x - bar, x), 2 * y, (top - p.back * p.choice((0.35, 0.6)), top))
        for side in (-y, y):
            yield box((x - bar, x), (side - bar / 2, side + bar / 2), (height, top))


def _stool_legs(p: Draw, x: float, y: float, under: float) -> Iterable[Solid]:
    style = p.choice(("square", "square", "round", "turned"))
    count = 3 if p.variant == "three_legs" else 4
    level = p.rest * under
    out = p.splay * (1 - p.rest)
    if count == 3:
        reach = np.hypot(x, y)
        yield ring(leg(style, (reach + p.splay, 0, 0), (reach, 0, under), p.thickness, p.taper), 3)
        turn = np.linspace(0, 2 * np.pi, 25)[:-1]
        hoop = np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1) * (reach + out)
        yield tube(hoop, p.thickness * 0.3, closed=True).at(z=level)
        return
    yield four(leg(style, (x + p.splay, y + p.splay, 0), (x, y, under), p.thickness, p.taper))
    bar = p.thickness * 0.6
    a, b = x + out, y + out
    for side in (-1, 1):
        yield box((side * a - bar / 2, side * a + bar / 2), 2 * b, (level, level + bar))
        lift = level + (bar * 2 if p.chance(0.5) else 0)
        yield box(2 * a, (side * b - bar / 2, side * b + bar / 2), (lift, lift + bar))


def _shell(p: Draw, under: float) -> Iterable[Solid]:
    """A bent seat whose back rises at +x."""
    half = p.width * 0.45
    path = smooth([
        (-half, under - p.seat * 0.5), (-half * 0.8, under), (half * 0.5, under),
        (half * 0.9, under + 0.04), (half * 1.05, under + p.back),
    ], 14)  # fmt: skip
    y = np.linspace(-half, half, 7) * p.depth
    bowl = (y / half) ** 2 * p.crown
    surface = np.stack([
        np.broadcast_to(path[:, :1], (14, 7)), np.broadcast_to(y, (14, 7)), path[:, 1:] + bowl,
    ], -1)  # fmt: skip
    yield sheet(surface)
    yield sheet(surface[:, ::-1] - np.array([0, 0, 0.3 * p.seat]))


def _stool_column(p: Draw, under: float) -> Iterable[Solid]:
    radius = p.thickness * p.choice((0.6, 0.9, 2.0))
    reach = p.width * p.foot
    if p.variant == "star":
        yield cylinder(radius, (under * 0.12, under))
        yield star_foot(p.choice((3, 4, 5)), reach * 1.1, under * 0.2, p.thickness)
    else:
        yield cylinder(radius, (0, under), top=radius * p.taper)
        flat = p.thickness * p.choice((0.5, 1.0, 2.5))
        yield revolve([(0, 0), (reach, 0), (reach, flat * 0.5), (radius, flat), (0, flat)])
    if p.chance(0.5):
        turn = np.linspace(0, 2 * np.pi, 25)[:-1]
        hoop = np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1) * reach * 0.8
        yield tube(hoop, p.thickness * 0.3, closed=True).at(z=under * p.rest)
        yield rod((-reach * 0.8, 0, under * p.rest), (reach * 0.8, 0, under * p.rest), 0.01)


def _stool_hoops(p: Draw, under: float) -> Iterable[Solid]:
    """Bent bar: four or two uprights between hoops."""
    bar = p.thickness * 0.4
    turn = np.linspace(0, 2 * np.pi, 29)[:-1]
    unit = np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1)
    low, high = p.width * 0.5 + p.splay, p.width * 0.42
    yield tube(unit * low, bar, closed=True).at(z=bar)
    level = under * p.rest
    yield tube(unit * (low + (high - low) * p.rest), bar, closed=True).at(z=level)
    yield ring(rod((low, 0, bar), (high, 0, under), bar), p.choice((2, 3, 4)))
