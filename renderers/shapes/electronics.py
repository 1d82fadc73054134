"""Laptops, monitors, radios and game consoles."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import rounded_rectangle, smooth
from renderers.shapes.solids import (
    Solid,
    beam,
    both,
    box,
    cylinder,
    ellipsoid,
    extrude,
    join,
    loft,
    ring,
    rod,
    rounded_box,
    tube,
)


@family(
    "laptop",
    variants={"slim": 5, "thick": 3, "convertible": 1, "docked": 0.4},
    width=(1.05, 1.75), base=(0.02, 0.05), lid=(0.012, 0.035), angle=(88.0, 128.0),
    lid_height=(0.8, 1.08), corner=(0.0, 0.06), hinge=(0.0, 0.04), bezel=(0.02, 0.08),
    keys=(0.4, 0.65), pad=(0.15, 0.35), setback=(0.0, 0.06),
)  # fmt: skip
def laptop(p: Draw) -> Iterable[Solid]:
    """The hinge along x at +y, the screen standing behind the keys."""
    wide, deep = p.width, 1.0
    thick = p.base * (2.4 if p.variant == "thick" else 1.0)
    lid = p.lid * (1.6 if p.variant == "thick" else 1.0)
    yield extrude(rounded_rectangle(wide, deep, p.corner + 0.001), (0, thick))
    key_deep = deep * p.keys
    if p.chance(0.6):
        yield box(wide * 0.88, (deep * 0.42 - key_deep, deep * 0.42), (thick, thick + 0.006))
    if p.chance(0.5):
        yield box(wide * p.pad, (-deep * 0.45, deep * 0.3 - key_deep), (thick, thick + 0.003))
    tall = deep * p.lid_height
    panel = extrude(rounded_rectangle(wide, (0, tall), p.corner + 0.001), (0, lid))
    glass = box(wide - 2 * p.bezel, (p.bezel, tall - p.bezel), (lid, lid + 0.004))
    screen = join(panel, glass) if p.chance(0.6) else panel
    # A panel lying over the keys, folded up about its rear edge.
    upright = screen.turned("x", 180 - p.angle).at(y=deep / 2 - p.setback, z=thick)
    yield upright
    if p.hinge > 0.015:
        yield both(rod((wide * 0.25, 0, 0), (wide * 0.4, 0, 0), p.hinge * 0.6).at(
            y=deep / 2 - p.setback, z=thick))  # fmt: skip
    if p.variant == "convertible":
        yield box(wide * 0.2, (deep / 2 - 0.06, deep / 2), (thick, thick + 0.04))
    if p.variant == "docked":
        yield box((wide * 0.55, wide * 1.2), (-deep / 2, deep * 0.2), (0, 0.01))


@family(
    "monitor",
    variants={"desk": 5, "television": 3, "tube": 1.5, "panel": 0.7, "framed": 1.2},
    width=(0.9, 1.15), height=(0.58, 0.95), thickness=(0.02, 0.12), neck=(0.03, 0.22),
    neck_width=(0.06, 0.22), base=(0.25, 0.65), base_depth=(0.2, 0.5), bulge=(0.0, 0.09),
    tilt=(-2.0, 10.0), bezel=(0.02, 0.07), plate=(0.01, 0.04), depth=(0.45, 0.85),
)  # fmt: skip
def monitor(p: Draw) -> Iterable[Solid]:
    """The screen faces −x, its width along y."""
    half, tall, thick = p.width / 2, p.height, p.thickness
    if p.variant == "tube":
        yield from _tube(p)
        return
    if p.variant == "television":
        tall, thick = tall * 0.85, thick * 0.8
    screen = box((-thick / 2, thick / 2), 2 * half, (0, tall))
    parts = [screen]
    if p.chance(0.6):
        face = (-thick / 2 - 0.006, -thick / 2)
        parts.append(box(face, 2 * (half - p.bezel), (p.bezel, tall - p.bezel)))
    if p.bulge > 0.015:
        back = (thick / 2, thick / 2 + p.bulge)
        inner = half * (0.45 + 5 * p.bulge)
        parts.append(box(back, 2 * min(inner, half * 0.95), (tall * 0.12, tall * 0.85)))
    if p.chance(0.2):
        speaker = box((-thick / 2, thick / 2), 0.1, (0, tall))
        parts += [speaker.at(y=half + 0.05), speaker.at(y=-half - 0.05)]
    tilted = join(parts).at(z=-tall / 2).turned("y", p.tilt).at(z=tall / 2)
    if p.variant == "panel":
        yield tilted
        return
    yield tilted.at(z=p.neck)
    behind = thick / 2 + p.bulge * 0.6
    w = p.neck_width * (0.6 if p.variant == "television" else 1.0)
    if p.variant == "framed":
        reach = p.base_depth * 0.9
        for side in (-half * 0.55, half * 0.55):
            yield beam((0, side, p.neck + 0.02), (-reach, side * 1.15, 0), 0.03, 0.02)
            yield beam((0, side, p.neck + 0.02), (reach, side * 1.15, 0), 0.03, 0.02)
        return
    if p.variant == "desk":
        rise = tall * (0.2 + 1.2 * p.bulge + 2 * p.plate)
        yield box((behind, behind + 0.05), w, (0, p.neck + rise))
        if p.chance(0.6):
            yield box((thick / 2, behind + 0.03), w * 1.2, (p.neck + rise - 0.1, p.neck + rise))
        middle = behind * 0.5
    else:
        yield box((-0.03, 0.03), w, (0, p.neck + 0.02))
        middle = 0.0
    long, deep = p.base, p.base_depth
    style = p.choice(("oval", "oval", "box", "soft"))
    if style == "oval":
        disc = cylinder(1.0, (0, p.plate), 32).scaled(deep / 2, long / 2, 1.0)
        yield disc.at(x=middle)
    elif style == "box":
        yield box((middle - deep / 2, middle + deep / 2), long, (0, p.plate))
    else:
        yield extrude(rounded_rectangle(deep, long, 0.08), (0, p.plate)).at(x=middle)


def _tube(p: Draw) -> Iterable[Solid]:
    """A cathode-ray tube: a deep case that narrows to the back."""
    half, tall, deep = p.width / 2, p.height, p.depth * 0.9
    low = p.neck * 0.5
    frame = 0.12 + p.thickness

    def outline(x: float, scale: float, rise: float) -> np.ndarray:
        o = rounded_rectangle(2 * half * scale, (low + tall * rise, low + tall), 0.05)
        return np.column_stack([np.full(len(o), x), o])

    top = 1 - 0.3 * p.tilt / 10
    rings = [outline(0, 1.0, 0), outline(frame, 1.0, 0)]
    for f in (0.3, 0.6, 1.0):
        x = frame + (deep - frame) * f
        scale = 1 - (0.25 + p.bulge * 3) * f
        ring_points = outline(x, scale, 0.12 * f)
        middle = low + tall / 2
        ring_points[:, 2] = middle + (ring_points[:, 2] - middle) * (1 - 0.35 * f * top)
        rings.append(ring_points)
    yield loft(np.stack(rings))
    yield box((-0.01, 0), 2 * (half - p.bezel), (low + p.bezel, low + tall - p.bezel))
    if p.chance(0.7):
        yield box((frame * 0.5, deep * 0.7), p.base * 1.4, (0, p.plate))
        yield cylinder(0.1, (0, low + 0.05)).at(x=deep * 0.4)


@family(
    "radio",
    variants={"portable": 3, "table": 4, "receiver": 2.5, "pill": 1.5, "boombox": 1.2,
              "handheld": 1.2, "clock": 1, "arched": 1, "stack": 0.7},
    width=(0.8, 1.3), height=(0.3, 0.78), depth=(0.22, 0.55), corner=(0.0, 0.3), panel=(0.3, 0.6),
    knob=(0.03, 0.08), handle=(0.04, 0.18), antenna=(0.2, 0.65), lean=(-50.0, 50.0),
    speaker=(0.25, 0.48), dial=(0.1, 0.3), foot=(0.0, 0.04),
)  # fmt: skip
def radio(p: Draw) -> Iterable[Solid]:
    """The dial faces −y, the width along x."""
    half, tall, deep = p.width / 2, p.height, p.depth
    if p.variant == "receiver":
        tall, deep = tall * 0.55, p.width * (0.5 + 1.5 * p.panel)
    elif p.variant == "clock":
        tall, deep = tall * 0.7, deep * 1.2
    elif p.variant == "handheld":
        half, tall = half * 0.55, tall * 1.6
    elif p.variant == "table":
        tall, deep = tall * 0.75, p.width * (0.25 + p.panel)
    elif p.variant == "arched":
        half, tall = half * 0.75, tall * 1.15
    front = -deep / 2
    if p.variant == "pill":
        outline = rounded_rectangle(2 * half, (0, tall), tall * (0.25 + p.corner * 0.8), steps=6)
        yield extrude(outline, deep, "y")
    elif p.variant == "clock":
        wedge = [(front, 0), (-front, 0), (-front * 0.9, tall), (front * (0.3 + p.panel), tall)]
        yield extrude(wedge, 2 * half, "x")
    elif p.variant == "arched":
        across = np.linspace(-1, 1, 17)
        curve = np.stack([across * half, tall * (1 - 0.35 * np.abs(across) ** 2.5)], 1)
        outline = np.concatenate([[(half, 0), (-half, 0)], curve])
        yield extrude(outline, deep, "y")
    elif p.variant == "stack":  # a tuner between two boxes
        middle, side = half * (0.3 + p.panel), half * (1.3 - p.panel) / 2
        yield box(2 * middle, deep, (0, tall))
        yield both(box((middle, middle + side), deep * 1.1, (0, tall * 1.05)))
    elif p.corner > 0.12 and p.variant not in ("receiver", "table"):
        yield rounded_box(2 * half, deep, (0, tall), p.corner * min(tall, deep) * 0.6)
    else:
        yield box(2 * half, deep, (0, tall))
    reach = p.knob * 0.7
    grille = min(p.speaker * tall, half * 0.4)
    round_ones = 2 if p.variant == "boombox" or p.chance(0.3) else 1
    disc = cylinder(grille, (0, 0.02), 20).turned("x", 90)
    for side in (-1, 1)[:round_ones]:
        if p.variant != "receiver":
            yield disc.at(side * (half - grille * 1.15), front, tall / 2)
    dial = cylinder(p.knob, (0, reach), 14).turned("x", 90)
    for i in range(p.integer(1, 3)):
        yield dial.at(half * 0.75 - i * p.knob * 2.5, front, tall * (0.3 + 0.1 * p.panel))
    yield box((-half * p.panel, half * p.panel), (front - 0.015, front),
              (tall * (0.85 - p.dial), tall * 0.85))  # fmt: skip
    if p.chance(0.6):  # a row of keys
        pitch = 2 * half * 0.8 / 10
        low = tall * p.choice((0.06, 0.84))
        for i in range(p.integer(4, 10)):
            x = -half * 0.8 + pitch * i
            yield box((x, x + pitch * 0.7), (front - reach, front), (low, low + tall * 0.1))
    if p.chance(0.4):  # the chassis and the speaker's magnet, seen where a case has gaps
        yield box(
            half * (0.8 + p.panel), deep * 0.7, (tall * (0.5 - p.dial), tall * (0.5 + p.dial))
        )
        yield disc.scaled(y=deep * 12).at(half * 0.4, -deep * 0.1, tall / 2)
    upright = p.variant in ("portable", "boombox", "handheld")
    if upright and p.chance(0.5):
        rise = tall + p.handle
        bar = p.knob * 0.4
        yield box(1.8 * half, bar * 2, (rise - bar * 2, rise))
        yield both(box((half * 0.9 - bar, half * 0.9), bar * 2, (tall * 0.9, rise)))
    if p.variant != "receiver" and p.chance(0.25):
        length = p.antenna * (1.0 if p.chance(0.7) else 0.4)
        lean = np.radians(p.lean if p.chance(0.5) else 0.0)
        root = np.array([p.choice((-0.9, 0.9)) * half, deep * 0.25, tall * 0.98])
        yield rod(root, root + length * np.array([np.sin(lean), 0, np.cos(lean)]), 0.012, 6)
    if p.foot > 0.015 and p.variant != "handheld":
        foot = cylinder(p.foot, (-p.foot, 0), 10)
        yield join(foot.at(sx * half * 0.8, sy * deep * 0.35) for sx in (-1, 1) for sy in (-1, 1))
    if p.variant == "boombox":
        yield both(box((half, half * 1.35), deep, (0, tall * 0.9)))


@family(
    "xbox",
    variants={"slab": 5, "waisted": 3, "rounded": 3, "banded": 1.5, "stepped": 0.8, "wide": 0.8,
              "with_pad": 1, "with_drive": 0.7},
    width=(0.7, 1.04), thickness=(0.14, 0.46), waist=(0.0, 0.35), corner=(0.1, 0.5),
    step=(0.0, 0.05), step_width=(0.3, 0.7), badge=(0.06, 0.2), tray=(0.3, 0.7),
    groove=(0.2, 0.45), foot=(0.0, 0.02), pad=(0.2, 0.3), side=(0.0, 0.05),
)  # fmt: skip
def xbox(p: Draw) -> Iterable[Solid]:
    """A console standing on its short side: the broad faces look to ±y."""
    wide, thick = p.width * (1.9 if p.variant == "wide" else 1.0), p.thickness
    if p.variant == "stepped":
        yield box(wide, thick, (-0.5, p.groove - 0.3))
        yield box(wide * (0.85 + p.side * 2), thick * 0.7, (p.groove - 0.3, 0.5))
        return
    if p.variant == "rounded":
        outline = rounded_rectangle(wide, thick, p.corner * thick)
        yield extrude(outline, 1.0)
    else:
        rings = []
        for z in np.linspace(-0.5, 0.5, 13):
            pinch = 1 - (p.waist * (1 - 4 * z * z) if p.variant == "waisted" else 0.0)
            side = 1 - (p.side * 2 * (1 - 4 * z * z) if p.variant == "waisted" else 0.0)
            o = rounded_rectangle(wide * side, thick * pinch, 0.02)
            rings.append(np.column_stack([o, np.full(len(o), z)]))
        yield loft(np.stack(rings))
    if p.step > 0.01:
        left = p.choice((-1, 1)) * wide * (1 - p.step_width) / 2
        yield box(wide * p.step_width, thick * 0.96, (0.5, 0.5 + p.step)).at(x=left * 0.95)
    face = -thick / 2
    disc = cylinder(p.badge, (0, 0.012), 24).turned("x", 90)
    if p.chance(0.6):
        yield disc.at(0, face * (1 - 0.9 * p.waist if p.variant == "waisted" else 1.0), 0.1)
    if p.chance(0.7):
        yield box((wide / 2 - 0.002, wide / 2 + 0.01), thick * 0.2, 1.0 * p.tray)
    if p.chance(0.5):
        yield box(wide * 0.8, (face - 0.008, face), (0.5 - p.groove, 0.5 - p.groove + 0.03))
    if p.variant == "banded":
        for z in (-p.groove, p.groove):
            yield box(wide * 0.97, thick * 0.97, (z - 0.004, z + 0.004))
    if p.foot > 0.006:
        yield box(wide * 0.9, thick * 0.8, (-0.5 - p.foot, -0.5))
    if p.variant == "with_pad":
        x, y = 0.1 * wide * p.choice((-1, 1)), p.choice((-1, 1)) * (thick / 2 + 0.22)
        yield _pad(p.pad).at(x, y, -0.5)
    if p.variant == "with_drive":
        yield box((wide / 2 + 0.03, wide / 2 + 0.03 + p.pad), 0.06, (0.0, p.pad * 1.6))


def _pad(size: float) -> Solid:
    """A game pad lying on the floor: a body and two grips."""
    body = ellipsoid(size * 0.55, size * 0.4, size * 0.22, 16).at(z=size * 0.22)
    grip = tube(smooth([(size * 0.4, 0, size * 0.25), (size * 0.6, -size * 0.35, size * 0.15),
                        (size * 0.6, -size * 0.6, size * 0.12)], 6), size * 0.13)  # fmt: skip
    stick = cylinder(size * 0.07, (size * 0.35, size * 0.5), 8)
    return join(body, both(grip), ring(stick.at(size * 0.25), 2))
