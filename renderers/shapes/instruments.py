"""Guitars: lying on their backs, strings up (+z), neck towards +y."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import circle, smooth
from renderers.shapes.solids import Solid, box, cylinder, extrude, join, rod


def _mirrored_outline(half: np.ndarray) -> np.ndarray:
    """(x ≥ 0, y) from bottom to top → the whole outline."""
    return np.concatenate([half, half[::-1] * (-1, 1)])


def _acoustic(p: Draw, length: float) -> np.ndarray:
    lower, upper = p.bout, p.bout * p.upper
    waist = upper * p.waist
    return _mirrored_outline(smooth(
        [(0.0, 0.0), (0.62 * lower, 0.03 * length), (lower, 0.27 * length), (waist, 0.62 * length),
         (upper, 0.83 * length), (0.5 * upper, 0.985 * length), (0.0, length)], 28))  # fmt: skip


def _double_cut(p: Draw, length: float) -> np.ndarray:
    """A solid body with two horns; the bass horn (−x) reaches farther."""
    w = p.bout
    right = [(0.5 * w, 0.0), (w, 0.2 * length), (0.72 * w * p.waist / 0.8, 0.52 * length),
             (0.86 * w, 0.78 * length), (0.78 * w, length * (0.84 + 0.5 * p.horn)),
             (0.4 * w, 0.78 * length), (0.2 * w, 0.78 * length)]  # fmt: skip
    left = [(-0.2 * w, 0.8 * length), (-0.45 * w, 0.82 * length),
            (-0.85 * w, length * (0.92 + p.horn)), (-0.9 * w, 0.8 * length),
            (-0.72 * w * p.waist / 0.8, 0.56 * length), (-w, 0.22 * length),
            (-0.5 * w, 0.0)]  # fmt: skip
    return np.concatenate([smooth(right, 24), smooth(left, 24)])


def _single_cut(p: Draw, length: float) -> np.ndarray:
    w = p.bout
    half = _acoustic(p, length)
    cut = (half[:, 0] > 0.25 * w) & (half[:, 1] > 0.72 * length)
    half[cut, 1] -= (half[cut, 0] / w - 0.25) * p.horn * 3 * length
    return half


def _angular(p: Draw, length: float) -> np.ndarray:
    """A V or an X."""
    w = p.bout * 1.25
    if p.horn > 0.12:
        return np.array([(0, 0.2 * length), (0.8 * w, -0.05), (w, 0.02), (0.36 * w, 0.5 * length),
                         (0.8 * w, length), (0.12 * w, 0.85 * length), (-0.12 * w, 0.85 * length),
                         (-0.75 * w, length * 1.08), (-0.36 * w, 0.5 * length), (-w, 0.1),
                         (-0.7 * w, 0.0)])  # fmt: skip
    return np.array([(0, 0.3 * length), (0.75 * w, -0.05), (w, 0.02), (0.2 * w, length),
                     (-0.2 * w, length), (-w, 0.02), (-0.75 * w, -0.05)])  # fmt: skip


@family(
    "guitar",
    variants={"acoustic": 3, "double_cut": 5, "single_cut": 3, "angular": 2},
    body=(0.36, 0.5), bout=(0.145, 0.2), upper=(0.72, 0.9), waist=(0.68, 0.88),
    thickness=(0.03, 0.055), deep=(0.08, 0.13), neck=(0.022, 0.034), neck_thickness=(0.014, 0.03),
    head=(0.13, 0.2), head_width=(0.032, 0.05), head_tilt=(0.0, 16.0), horn=(0.05, 0.18),
    hole=(0.035, 0.055), bridge=(0.05, 0.09), peg=(0.012, 0.025),
)  # fmt: skip
def guitar(p: Draw) -> Iterable[Solid]:
    length = p.body
    acoustic = p.variant == "acoustic"
    thick = p.deep if acoustic and p.chance(0.8) else p.thickness
    outline = {
        "acoustic": _acoustic, "double_cut": _double_cut, "single_cut": _single_cut,
        "angular": _angular,
    }[p.variant](p, length)  # fmt: skip
    hole_at = (0.0, 0.66 * length)
    holes = [circle(p.hole, 20) + hole_at] if acoustic else []
    yield extrude(outline, (-thick, 0), holes=holes)

    # neck and head
    neck_end = 1.0 - p.head
    fret = p.neck_thickness * 0.4
    w = p.neck
    board = [(-w, 0.72 * length), (w, 0.72 * length), (0.8 * w, neck_end), (-0.8 * w, neck_end)]
    yield extrude(board, (0, fret))
    back = [(-w, 0.9 * length), (w, 0.9 * length), (0.8 * w, neck_end), (-0.8 * w, neck_end)]
    yield extrude(back, (-p.neck_thickness, 0))
    hw, long = p.head_width, p.head
    if acoustic or p.chance(0.5):
        plate = [(-0.8 * w, 0), (0.8 * w, 0), (hw, 0.25 * long), (0.9 * hw, long),
                 (-0.9 * hw, long), (-hw, 0.25 * long)]  # fmt: skip
        sides = [(s, y) for s in (-1.0, 1.0) for y in (0.35, 0.6, 0.85)]
    else:
        plate = [(-0.8 * w, 0), (0.8 * w, 0), (1.3 * hw, 0.2 * long), (1.1 * hw, 0.5 * long),
                 (0.2 * hw, long), (-0.8 * hw, 0.9 * long), (-0.6 * hw, 0.3 * long)]  # fmt: skip
        sides = [(-0.75, y) for y in np.linspace(0.25, 0.85, 6).tolist()]
    pegs = [rod((s * hw * 0.9, y * long, -0.01), (s * (hw + p.peg), y * long, -0.01), 0.006, 6)
            for s, y in sides]  # fmt: skip
    head = join(extrude(plate, (-0.016, 0)), pegs)
    yield head.turned("x", -p.head_tilt).at(0, neck_end, fret * 0.5)

    # bridge, pickups, strings
    y = 0.3 * length
    yield box(2 * p.bridge, 0.03, (0, 0.012)).at(0, y)
    if not acoustic:
        for at in (0.42, 0.58, 0.68)[: p.integer(2, 3)]:
            yield box(1.6 * p.bridge, 0.028, (0, 0.008)).at(0, at * length)
        for i in range(p.integer(1, 3)):
            yield cylinder(0.012, (0, 0.014), 10).at(0.6 * p.bout, (0.12 + 0.09 * i) * length)
    if p.chance(0.4):
        for s in np.linspace(-0.7, 0.7, 6):
            yield rod((s * w, y, 0.014), (0.8 * s * w, neck_end, fret + 0.004), 0.0012, 3)
