"""Printers and stoves: the two PS15 classes that ModelNet40 does not have."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from renderers.shapes.family import Draw, Family, family
from renderers.shapes.solids import (
    Solid,
    box,
    cylinder,
    difference,
    extrude,
    join,
    ring,
    rod,
    rounded_box,
)


@family(
    "printer",
    variants={"laser": 4, "inkjet": 3, "multifunction": 4},
    width=(0.36, 0.50), depth=(0.32, 0.46), height=(0.22, 0.36), rounding=(0.006, 0.03),
    slot=(0.55, 0.8), tray=(0.06, 0.16), slope=(0.0, 0.35), panel=(0.06, 0.14), lid=(0.03, 0.07),
    cassette=(0.2, 0.34),
)  # fmt: skip
def printer(p: Draw) -> Iterable[Solid]:
    """The paper comes out towards −y."""
    w, d = p.width, p.depth
    h = p.height * (0.55 if p.variant == "inkjet" else 1.0)
    front, back = -d / 2, d / 2
    body = rounded_box(w, d, (0, h), p.rounding)
    mouth = box(w * p.slot, (front - 0.01, front + d * 0.45), (h * 0.55, h * 0.78))
    yield difference(body, mouth)
    yield from _output_tray(p, w * p.slot, front, h * 0.55)
    if p.variant == "laser":
        # The top dips towards the back, where the pages land face down.
        ahead, behind = front + 0.02, back - 0.02
        profile = [(ahead, 0), (behind, 0), (behind, 0.05), (front + d * 0.4, 0.012),
                   (ahead, 0.012)]  # fmt: skip
        yield extrude(profile, w * 0.9, axis="x").at(z=h - 0.002)
        yield _panel(p, w * 0.32, front).at(x=w * 0.28, z=h)
    elif p.variant == "inkjet":
        feeder = box(w * 0.6, 0.012, (0, 0.13 + 0.3 * p.tray))
        yield feeder.turned("x", -20 - 30 * p.slope).at(y=back - 0.04, z=h - 0.02)
        yield _panel(p, w * 0.5, front).at(z=h)
    else:
        lid = p.lid
        yield rounded_box(w * 0.98, d * 0.86, (h, h + lid), p.rounding).at(y=d * 0.06)
        feeder = rounded_box(w * 0.62, d * 0.5, (h + lid, h + lid + 0.07), 0.015)
        yield feeder.at(x=-w * 0.14, y=d * 0.18)
        sheet = box(w * 0.5, d * 0.34, 0.008).turned("x", 12).at(y=front + d * 0.4)
        yield sheet.at(x=-w * 0.14, z=h + lid + 0.05)
        yield _panel(p, w * 0.8, front).at(z=h)
    if p.variant != "inkjet":
        edge = (h * 0.06, h * p.cassette)
        yield box(w * 0.9, (front - 0.008, front + 0.02), edge)
        yield box(w * 0.3, (front - 0.02, front), (edge[1] - 0.025, edge[1] - 0.01))


def _output_tray(p: Draw, width: float, front: float, z: float) -> Iterable[Solid]:
    """A thin tray that sticks out of the mouth and rises towards its end."""
    reach = p.tray
    plate = box(width * 0.95, (-reach, 0.04), 0.008).turned("x", -8)
    yield plate.at(y=front, z=z + 0.01)


def _panel(p: Draw, width: float, front: float) -> Solid:
    """A control panel on the front edge of the top, tilted up."""
    plate = rounded_box(width, p.panel, 0.018, 0.006)
    return plate.turned("x", 15 + 30 * p.slope).at(y=front + p.panel * 0.55, z=0.02)


@family(
    "stove",
    variants={"backguard": 4, "slide_in": 3, "gas": 3},
    width=(0.52, 0.78), depth=(0.55, 0.66), height=(0.85, 0.94), guard=(0.10, 0.26),
    door=(0.42, 0.58), window=(0.45, 0.75), handle=(0.012, 0.02), drawer=(0.14, 0.22),
    burner=(0.075, 0.11), knob=(0.016, 0.026), knobs=(4.0, 6.0),
)  # fmt: skip
def stove(p: Draw) -> Iterable[Solid]:
    """The oven door faces −y, the back stands against a wall at +y."""
    w, d, h = p.width, p.depth, p.height
    front, back = -d / 2, d / 2
    yield box(w, d, (0.06, h - 0.03))
    yield box(w * 0.94, (front + 0.04, back), (0, 0.06))
    yield box(w * 1.01, (front - 0.012, back), (h - 0.03, h))
    yield from _door(p, front)
    if p.variant == "backguard":
        lean = [(back - 0.07, 0), (back, 0), (back, p.guard), (back - 0.045, p.guard)]
        yield extrude(lean, w, axis="x").at(z=h)
        yield from _knobs(p, back - 0.06, h + p.guard * 0.5)
    else:
        yield from _knobs(p, front - 0.012, h - 0.075)
    for n, (x, y) in enumerate((x, y) for x in (-0.24, 0.24) for y in (-0.21, 0.2)):
        size = p.burner * (1.0 if n % 3 else 0.8)
        burner = join(_burner(size)) if p.variant == "gas" else cylinder(size, (0, 0.012))
        yield burner.at(x * w, y * d, h)


def _door(p: Draw, front: float) -> Iterable[Solid]:
    w, h = p.width, p.height
    low = 0.08 + p.drawer
    high = low + p.door * (h - 0.2) / 0.72
    high = min(high, h - 0.13)
    frame = box(w * 0.97, (front - 0.035, front), (low, high))
    glass = box(w * 0.97 * p.window, (front - 0.05, front - 0.02), (low + 0.08, high - 0.14))
    yield difference(frame, glass)
    yield box(w * 0.97, (front - 0.03, front), (0.07, low - 0.01))
    for z, length in ((high - 0.05, 0.8), (low - 0.05, 0.4)):
        reach = front - 0.075
        half = w * length / 2
        yield rod((-half, reach, z), (half, reach, z), p.handle)
        for x in (-half * 0.92, half * 0.92):
            yield rod((x, reach, z), (x, front - 0.02, z), p.handle * 0.8)


def _knobs(p: Draw, y: float, z: float) -> Iterable[Solid]:
    count = round(p.knobs)
    for x in np.linspace(-0.38, 0.38, count) * p.width:
        knob = cylinder(p.knob, (0, 0.03), 14, top=p.knob * 0.8)
        yield knob.turned("x", 90).at(x=float(x), y=y, z=z)


def _burner(size: float) -> Iterable[Solid]:
    """A gas burner: a cap under a grate of four bars."""
    yield cylinder(size * 0.4, (0, 0.02), 18)
    bar = box((size * 0.35, size * 1.25), 0.012, (0.025, 0.04))
    yield ring(bar, 4)
    yield ring(box(0.012, 0.012, (0, 0.03)).at(x=size * 1.2), 4)


FAMILIES: dict[str, Family] = {"printer": printer, "stove": stove}
"""Class name → family."""
