"""Cars: bonnet at +x, wheels below, y across."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import smooth
from renderers.shapes.solids import Solid, body, both, box, cylinder, four, join, loft, rounded_box


def _wheel(radius: float, width: float) -> Solid:
    tyre = cylinder(radius, width, 20).turned("x", 90)
    hub = cylinder(radius * 0.55, width * 1.1, 12).turned("x", 90)
    return join(tyre, hub)


def _hull(p: Draw, w: float, low: float, rear: float, waist: float, nose: float) -> Solid:
    """The lower body; its top line runs from the boot over the waist to the bonnet's edge."""
    x = np.array([-0.5, -0.49, -0.44, -0.25, 0.0, 0.2, 0.4, 0.47, 0.495, 0.5])
    top = np.array([0.75 * rear, rear * 0.94, rear, waist, waist, 0.98 * waist, nose, 0.9 * nose,
                    0.7 * nose, 0.6 * nose])  # fmt: skip
    plan = 1 - p.plan * np.array([0.5, 0.3, 0.15, 0.02, 0, 0, 0.12, 0.35, 0.7, 0.9]) * 1.2
    bottom = np.array([0.3, 0.12, 0.0, 0, 0, 0, 0.0, 0.05, 0.15, 0.25]) * (waist - low) + low
    rows = np.stack([x, w / 2 * plan, np.maximum(top - bottom, 0.02) / 2, (top + bottom) / 2], 1)
    return body(smooth(rows, 24), 24, p.boxiness)


def _cabin(
    p: Draw, w: float, low: float, high: float, line: tuple[float, float, float, float]
) -> Solid:
    """The greenhouse over x = foot of rear window, roof end, roof start, foot of windscreen."""
    rear, roof0, roof1, front = line
    bow = 0.025
    x = np.array([rear, (rear + roof0) / 2, roof0, (roof0 + roof1) / 2, roof1,
                  (roof1 + front) / 2, front])  # fmt: skip
    rise = np.array([0.02, 0.55, 0.97, 1.0, 0.97, 0.55, 0.02]) * (high - low - bow)
    rings = []
    for at, up in zip(x, rise, strict=True):
        half = w / 2 * 0.96
        narrow = half * (1 - p.tumblehome * up / (high - low))
        z = low + up
        rings.append([(at, half, low - 0.04), (at, narrow, z), (at, 0.5 * narrow, z + bow * 0.7),
                      (at, 0, z + bow), (at, -0.5 * narrow, z + bow * 0.7), (at, -narrow, z),
                      (at, -half, low - 0.04)])  # fmt: skip
    return loft(np.array(rings))


def _racer(p: Draw) -> Iterable[Solid]:
    """An open single-seater with wings."""
    w, r = p.width * 1.05, p.wheel * 1.15
    rows = [(-0.45, 0.06, 0.05, 0.09), (-0.2, 0.11, 0.07, 0.1), (0.0, 0.1, 0.06, 0.09),
            (0.25, 0.05, 0.04, 0.07), (0.5, 0.02, 0.015, 0.05)]  # fmt: skip
    yield body(smooth(rows, 16), 14, 3.0)
    yield body([(-0.4, 0.02, 0.03, 0.18), (-0.15, 0.05, 0.05, 0.18), (-0.1, 0.02, 0.03, 0.17)], 10)
    pod = body([(-0.35, 0.05, 0.05, 0.08), (0.02, 0.06, 0.05, 0.08)], 10, 4.0)
    yield both(pod.at(0, 0.13), "y")
    yield box((0.44, 0.53), w * 0.95, (0.02, 0.03))
    yield box((-0.5, -0.41), w * 0.6, (0.2, 0.215))
    yield both(box((-0.51, -0.4), 0.01, (0.08, 0.24)).at(0, w * 0.3), "y")
    yield both(_wheel(r, 0.09).at(0.3, w / 2 - 0.04, r - 0.02), "y")
    yield both(_wheel(r, 0.11).at(-0.35, w / 2 - 0.05, r - 0.02), "y")


@family(
    "car",
    variants={"sedan": 6, "hatchback": 3, "suv": 3, "coupe": 5, "pickup": 1, "van": 1,
              "cabriolet": 2, "racer": 1},
    width=(0.36, 0.44), height=(0.27, 0.35), clearance=(0.035, 0.06), waist=(0.58, 0.68),
    nose=(0.68, 0.85), boot=(0.82, 1.0), plan=(0.12, 0.42), boxiness=(3.2, 7.0),
    tumblehome=(0.15, 0.34), windscreen=(0.1, 0.2), rear_window=(0.06, 0.2), bonnet=(0.22, 0.32),
    wheel=(0.062, 0.082), wheelbase=(0.54, 0.64), tyre=(0.04, 0.06),
)  # fmt: skip
def car(p: Draw) -> Iterable[Solid]:
    if p.variant == "racer":
        yield from _racer(p)
        return
    tall = {"suv": 1.2, "van": 1.3, "pickup": 1.12, "coupe": 0.87, "cabriolet": 0.9}
    w, h = p.width, p.height * tall.get(p.variant, 1.0)
    low = p.clearance * (1.4 if p.variant in ("suv", "pickup") else 1.0)
    waist = low + (h - low) * p.waist
    nose = low + (waist - low) * p.nose
    yield _hull(p, w, low, low + (waist - low) * p.boot, waist, nose)

    # greenhouse
    front = 0.5 - p.bonnet * (0.65 if p.variant == "van" else 1.0)
    roof1 = front - p.windscreen
    rear, roof0 = {
        "sedan": (-0.36, -0.34 + p.rear_window), "coupe": (-0.42, -0.3 + p.rear_window),
        "hatchback": (-0.47, -0.43 + 0.4 * p.rear_window), "cabriolet": (-0.2, -0.18),
        "suv": (-0.485, -0.47 + 0.3 * p.rear_window), "van": (-0.49, -0.48),
        "pickup": (-0.1, -0.08 + 0.2 * p.rear_window),
    }[p.variant]  # fmt: skip
    if p.variant == "cabriolet":  # only the windscreen and two rows of seats
        screen = box(0.01, w * 0.8, (0, (h - waist) * 0.9)).turned("y", -35)
        yield screen.at(front - 0.03, 0, waist - 0.01)
        for x in (0.0, -0.17):
            seat = rounded_box(0.05, 0.12, (0.6 * waist, waist + 0.05), 0.02)
            yield both(seat.at(x, 0.22 * w), "y")
    else:
        yield _cabin(p, w, waist, h, (rear, min(roof0, roof1 - 0.06), roof1, front))
    if p.variant == "pickup":  # the bed's rim, drawn as an open box on the tail
        yield both(box((-0.49, -0.1), 0.02, (waist - 0.05, waist + 0.02)).at(0, w / 2 - 0.02), "y")
        yield box((-0.49, -0.47), w * 0.9, (waist - 0.05, waist + 0.02))

    # wheels and what hangs on the body
    wheel = _wheel(p.wheel * (1.1 if p.variant in ("suv", "pickup") else 1.0), p.tyre)
    z = p.wheel - 0.01
    yield four(wheel.at(p.wheelbase / 2, w / 2 - p.tyre * 0.45, z)).at(-0.01)
    if p.chance(0.6):
        mirror = rounded_box(0.03, 0.05, 0.03, 0.01)
        yield both(mirror.at(front - 0.06, w / 2 + 0.015, waist + 0.01), "y")
    if p.chance(0.5):
        yield both(box((-0.25, 0.28), 0.012, (low, low + 0.03)).at(0, w / 2), "y")
    if p.chance(0.45):  # an interior, seen through nothing but counted by the sampler
        for x in (0.05, -0.15):
            yield both(box(0.1, 0.12, (low + 0.03, low + 0.08)).at(x, 0.22 * w), "y")
            yield both(box(0.03, 0.12, (low + 0.05, waist + 0.04)).at(x - 0.06, 0.22 * w), "y")
    if p.variant == "coupe" and p.chance(0.35):
        yield box((-0.49, -0.43), w * 0.85, (waist + 0.04, waist + 0.05))
        yield both(box((-0.47, -0.45), 0.01, (waist - 0.03, waist + 0.05)).at(0, 0.3 * w), "y")
