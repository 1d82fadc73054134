"""People: standing, walking, gesturing, in skirts and coats; they face −y."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import smooth, superellipse
from renderers.shapes.solids import (
    Solid,
    box,
    cylinder,
    ellipsoid,
    join,
    loft,
    revolve,
    rounded_box,
    sheet,
    tube,
)

Point = NDArray[np.float64]


def swing(length: float, forward: float, outward: float, side: int) -> Point:
    """A limb's segment hanging from its joint, raised ``forward`` then ``outward`` degrees."""
    f, o = np.radians(forward), np.radians(outward)
    return length * np.array([side * np.sin(o), -np.sin(f) * np.cos(o), -np.cos(f) * np.cos(o)])


def limb(joints: list[Point], thick: float, thin: float) -> Solid:
    """A tapering round limb through its joints."""
    path = np.array(joints)
    path = np.concatenate([path[:1], (path[:1] + path[1:2]) / 2, path[1:2],
                           (path[1:2] + path[2:]) / 2, path[2:]])  # fmt: skip
    return tube(path, thick, segments=10, scale=np.array([1.0, 0.95, 0.8, 0.75, thin / thick]))


@family(
    "person",
    variants={"standing": 4, "walking": 3, "gesturing": 3, "skirted": 1.5, "coated": 1.5,
              "spread": 1, "seated": 0.4, "cut_out": 0.5},
    leg=(0.76, 0.9), torso=(0.5, 0.6), shoulder=(0.16, 0.22), hip=(0.085, 0.13),
    girth=(0.085, 0.19), chest=(0.16, 0.25), arm_out=(2.0, 18.0), elbow=(5.0, 60.0),
    stride=(8.0, 38.0), stance=(0.0, 7.0), raise_angle=(30.0, 150.0), head=(0.095, 0.125),
    limb=(0.06, 0.085), lean=(-4.0, 12.0), yaw=(-35.0, 35.0), hem=(0.35, 0.95),
)  # fmt: skip
def person(p: Draw) -> Iterable[Solid]:
    """A figure of joints and limbs, a metre and three quarters tall."""
    body = join(_figure(p))
    if p.variant == "cut_out":  # a painted board, as crowds in architects' models are
        body = body.scaled(y=0.02)
    turn = p.yaw if p.chance(0.5) else 0.2 * p.yaw
    yield body.turned("z", turn)


def _figure(p: Draw) -> Iterable[Solid]:
    waist_z = p.leg
    neck_z = waist_z + p.torso
    lean = p.lean if p.variant in ("walking", "gesturing") else p.lean * 0.3
    yield from _legs(p)
    upper = join(_torso(p, waist_z, neck_z), _arms(p, neck_z), _head(p, neck_z))
    yield upper.at(z=-waist_z).turned("x", lean).at(z=waist_z)


def _torso(p: Draw, waist_z: float, neck_z: float) -> Iterable[Solid]:
    tall = neck_z - waist_z
    rings = []
    for f, x, y in ((-0.12, p.hip * 1.5, p.girth * 0.95), (0.05, p.hip * 1.6, p.girth),
                    (0.35, p.chest * 0.85, p.girth * 0.95), (0.7, p.chest, p.girth * 1.05),
                    (0.9, p.shoulder * 0.95, p.girth * 0.8), (1.0, 0.07, 0.06)):  # fmt: skip
        o = superellipse(x, y, 2.6, 20)
        rings.append(np.column_stack([o, np.full(len(o), waist_z + f * tall)]))
    yield loft(np.stack(rings))
    if p.variant == "coated":
        low = waist_z - p.hem * 0.6
        flare = 1.1 + 0.3 * p.hem
        coat = []
        for f, wide in ((0.0, flare), (0.45, 1.15), (0.8, 1.12), (1.0, 1.05)):
            o = superellipse(p.chest * 1.05 * wide, p.girth * 1.15 * wide, 2.8, 20)
            z = low + f * (waist_z + 0.7 * tall - low)
            coat.append(np.column_stack([o, np.full(len(o), z)]))
        yield loft(np.stack(coat), caps=False)
    if p.variant == "skirted":
        low = waist_z - p.hem * p.leg * 0.85
        skirt = [(p.hip * 1.5 + 0.18 * p.hem, low), (p.hip * 1.6, waist_z - 0.05),
                 (p.chest * 0.85, waist_z + 0.05)]  # fmt: skip
        yield revolve(smooth(skirt, 8), 20).scaled(y=0.8)
    if p.chance(0.12):
        yield rounded_box(0.3, (p.girth, p.girth + 0.16), (waist_z + 0.1, neck_z - 0.05), 0.05, 2)
    if p.chance(0.08):
        down, across = np.meshgrid(np.linspace(0, 1, 6), np.linspace(-1, 1, 7), indexing="ij")
        spread = across * p.shoulder * (1 + 0.5 * down)
        behind = p.girth * 0.9 + 0.35 * down**2
        yield sheet(np.stack([spread, behind, neck_z - 0.06 - down], -1))


def _head(p: Draw, neck_z: float) -> Iterable[Solid]:
    yield cylinder(0.05, (neck_z - 0.04, neck_z + 0.08), 12)
    top = neck_z + 0.07 + p.head * 1.25
    yield ellipsoid(p.head * 0.8, p.head * 0.95, p.head * 1.25, 16).at(y=-0.015, z=top)
    covering = p.choice(("none", "none", "hair", "hair", "hat", "cap"))
    if covering == "hair":
        long = p.choice((0.0, 0.06))
        scalp = ellipsoid(p.head * 0.95, p.head * 1.0, p.head * 1.1 + long, 14)
        yield scalp.at(y=0.02, z=top + 0.02 - long)
    elif covering == "hat":
        yield cylinder(p.head * 1.9, (top + p.head * 0.5, top + p.head * 0.58), 20)
        yield cylinder(p.head * 0.95, (top + p.head * 0.5, top + p.head * 1.5), 16)
    elif covering == "cap":
        yield ellipsoid(p.head * 0.95, p.head * 1.05, p.head * 0.8, 14).at(z=top + p.head * 0.6)
        yield box(p.head * 1.2, (-p.head * 1.9, -p.head * 0.7), (top + 0.05, top + 0.06))


def _arms(p: Draw, neck_z: float) -> Iterable[Solid]:
    upper, fore = 0.29, 0.26
    gesture = p.choice((-1, 1))
    both_up = p.chance(0.2)
    for side in (-1, 1):
        shoulder = np.array([side * p.shoulder, 0.0, neck_z - 0.06])
        forward, outward, bend = 0.0, p.arm_out, p.elbow * 0.5
        inward = 0.0
        if p.variant == "walking":
            forward = p.stride * 0.8 * side
            bend = p.elbow
        elif p.variant == "spread":
            outward, bend = 30 + p.raise_angle * 0.4, p.elbow * 0.2
        elif p.variant == "gesturing" and (side == gesture or both_up):
            if p.chance(0.6):
                forward, bend = p.raise_angle * 0.7, p.elbow
            else:
                outward, bend = 15 + p.arm_out * 2, 60 + p.elbow
                inward = 40.0
        elbow = shoulder + swing(upper, forward, outward, side)
        hand = elbow + swing(fore, forward + bend, outward * 0.7 - inward, side)
        yield limb([shoulder, elbow, hand], p.limb * 0.85, p.limb * 0.5)
        yield ellipsoid(0.04, 0.045, 0.07, 8).at(*hand)
        if p.chance(0.08):
            yield box(0.1, 0.32, (-0.36, -0.06)).at(*hand)


def _legs(p: Draw) -> Iterable[Solid]:
    thigh, shin = p.leg * 0.5, p.leg * 0.46
    stance = p.stance + (14 if p.variant == "spread" else 0)
    lead = p.choice((-1, 1))
    for side in (-1, 1):
        hip = np.array([side * p.hip * 0.85, 0.0, p.leg])
        forward, bend = 0.0, 0.0
        if p.variant == "walking":
            forward = p.stride if side == lead else -p.stride * 0.7
            bend = 8.0 if side == lead else p.elbow
        elif p.variant == "seated":
            forward, bend = 85.0, 85.0
        elif p.variant == "gesturing" and side == lead:
            forward, bend = p.stride * 0.4, p.stride * 0.5
        knee = hip + swing(thigh, forward, stance, side)
        ankle = knee + swing(shin, forward - bend, stance, side)
        yield limb([hip, knee, ankle], p.limb * 1.25, p.limb * 0.75)
        foot = ellipsoid(0.05, 0.135, 0.045, 10).at(y=-0.06).turned("x", bend * 0.8)
        yield foot.at(*ankle)
