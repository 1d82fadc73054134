"""Computer keyboards: flat in x-y, keys up, the far edge (+y) raised."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from renderers.shapes.family import Draw, family
from renderers.shapes.outlines import rounded_rectangle
from renderers.shapes.solids import Solid, box, extrude, join, sheet

_CORNERS = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2


def _key(x: float, y: float, w: float, d: float, height: float, taper: float) -> Solid:
    """A cap without a floor, narrower at the top."""
    foot = _CORNERS * (w, d)
    rings = [np.insert(foot * s + (x, y), 2, z, axis=1) for s, z in ((1, 0), (taper, height))]
    walls = sheet(np.array(rings), wrap=True)
    lid = np.array([[4, 5, 6], [4, 6, 7]])
    return Solid(walls.vertices, np.concatenate([walls.faces, lid]))


def _rows(p: Draw, x: tuple[float, float], y: tuple[float, float], count: int) -> Iterable[Solid]:
    """Rows of keys in a rectangle, row by row from the front, the space bar in the first."""
    pitch_y = (y[1] - y[0]) / count
    keys = max(3, round((x[1] - x[0]) / (pitch_y * 1.02)))
    pitch_x = (x[1] - x[0]) / keys
    size = pitch_x * (1 - p.gap), pitch_y * (1 - p.gap)
    for row in range(count):
        at_y = y[0] + (row + 0.5) * pitch_y
        shift = 0.25 * (row % 2) * p.stagger * pitch_x
        column = 0
        while column < keys:
            wide = 6 if row == 0 and keys > 10 and column == 3 else 1
            if column == 0 and shift:
                width, at_x = size[0] + shift, x[0] + (pitch_x + shift) / 2
            else:
                width = size[0] + (wide - 1) * pitch_x
                at_x = x[0] + (column + wide / 2) * pitch_x + shift * (column < keys - 1)
                width -= shift * 1.2 * (column == keys - 1)
                at_x += 0.6 * shift * (column == keys - 1)
            yield _key(at_x, at_y, width, size[1], p.key, p.taper)
            column += wide


@family(
    "keyboard",
    variants={"full": 5, "compact": 3, "wrist_rest": 2, "split": 1},
    length=(0.95, 1.1), depth=(0.27, 0.42), front=(0.006, 0.03), rise=(0.0, 0.05),
    margin=(0.01, 0.04), corner=(0.0, 0.05), key=(0.004, 0.022), gap=(0.06, 0.22),
    taper=(0.65, 0.97), stagger=(0.3, 1.0), rest=(0.08, 0.16), angle=(4.0, 14.0),
    curve=(0.0, 0.04), feet=(0.0, 0.05),
)  # fmt: skip
def keyboard(p: Draw) -> Iterable[Solid]:
    w, d, m = p.length, p.depth, p.margin
    if p.variant == "compact":
        w, d = 0.85 * w, 0.95 * d
    rows = p.integer(5, 6)
    front = -d / 2 + m + (p.rest if p.variant == "wrist_rest" else 0.0)
    case = extrude(rounded_rectangle(w, d + (p.rest if p.variant == "wrist_rest" else 0),
                                     p.corner), (-p.front, 0))  # fmt: skip
    case = case.at(y=0.0).subdivided()
    y = (front, d / 2 - m + (p.rest / 2 if p.variant == "wrist_rest" else 0.0))

    blocks: list[Solid] = []
    if p.variant in ("full", "wrist_rest"):  # letters, arrows, digits
        cuts = (-w / 2 + m, w * 0.155, w * 0.175, w * 0.3, w * 0.32, w / 2 - m)
        for low, high in ((cuts[0], cuts[1]), (cuts[2], cuts[3]), (cuts[4], cuts[5])):
            blocks.extend(_rows(p, (low, high), y, rows))
    elif p.variant == "compact":
        blocks.extend(_rows(p, (-w / 2 + m, w / 2 - m), y, rows))
    if p.variant == "split":
        half = join(case.scaled(0.5, 1, 1), _rows(p, (-w / 4 + m, w / 4 - m), y, rows))
        board = join(half.turned("z", s * p.angle).at(-s * w * 0.27) for s in (-1, 1))
    else:
        board = join(case, blocks)

    # The deck rises towards the back and may be dished; the case grows down to the desk under it.
    slope = p.rise / d
    dish = p.curve * p.chance(0.3)
    bottom = board.vertices[:, 2].min()

    def shape(v: np.ndarray) -> np.ndarray:
        lift = (v[:, 1] + d / 2) * slope + dish * (2 * v[:, 0] / w) ** 2
        flat = v[:, 2] > bottom + 1e-9
        v[:, 2] += np.where(flat | tilted, lift, 0.0)
        return v

    tilted = p.chance(0.5)  # the whole board leans on its feet, or only the deck slopes
    yield board.warped(shape)
    if tilted:
        for x in (-0.4, 0.4):
            yield box(0.05, 0.02, (bottom - p.feet, bottom)).at(x * w, d / 2 - 0.03, p.rise)
