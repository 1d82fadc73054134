"""Makes picture.svg, the page's first picture: an object, the side a camera sees, and its pose.

    python -m leaderboard.page.picture

The object is one of the built-in shapes; the file is kept, so that a board needs none of this.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from partialbench import registry

FILE = Path(__file__).with_name("picture.svg")
OBJECT = "chair_0003"
POINTS = 2_600
CAMERA = np.array([-1.75, -0.75, 0.55])
"""Where it stands, world frame, z up; it looks at the origin."""
RADIUS = 100.0
"""Of hidden point removal, some thirty times the distance: dots this sparse are to hide others."""
SIZE = (470, 210)


def draw() -> str:
    """The picture as SVG, coloured by the page's style."""
    source = registry.load(registry.SOURCES["parametric"])(counts=(5, 0))
    ref = next(r for r in source.objects("train") if r.object_id == OBJECT)
    points, _ = trimesh.sample.sample_surface(source.load(ref), POINTS, seed=0)
    pose = Rotation.from_euler("xyz", (0.1, -0.1, -0.9)).as_matrix()
    points = points @ pose.T
    seen = np.zeros(len(points), bool)
    remove = registry.load("renderers.hpr:hidden_point_removal")
    seen[remove(points, CAMERA, RADIUS)] = True
    paths = [
        _dots(points[~seen], "whole", 1.7),
        _dots(points[seen], "seen", 2.4),
        _camera(),
        '<g class="axes">'
        + "".join(_line(np.zeros(3), 0.9 * pose[:, i], f"a{name}") for i, name in enumerate("xyz"))
        + "</g>",
    ]
    x, y = _place(CAMERA)
    labels = (
        f'<text x="{max(2, x - 20):.0f}" y="{y - 22:.0f}">camera</text>'
        '<text x="325" y="62">its pose: x, y, z</text>'
        '<text x="325" y="102" class="seen-label">what the camera sees</text>'
        '<text x="325" y="142">the rest is hidden</text>'
    )
    return (
        f'<svg viewBox="0 0 {SIZE[0]} {SIZE[1]}" role="img" aria-label="A chair as dots: a camera '
        'at the left sees the side that faces it; three axes show the pose of the chair.">\n'
        + "\n".join(paths)
        + f"\n{labels}\n</svg>\n"
    )


def _place(points: NDArray) -> NDArray:
    """World frame → the picture: seen from the front right, a little from above, in parallel."""
    turn = Rotation.from_euler("z", 0.1).as_matrix()
    x, y, z = (np.atleast_2d(points) @ turn.T).T
    return np.stack([205 + 98 * x, 112 - 98 * (0.92 * z + 0.38 * y)], axis=-1).squeeze()


def _dots(points: NDArray, name: str, size: float) -> str:
    path = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in _place(points))
    return f'<path class="{name}" d="{path}" stroke-width="{size}" stroke-linecap="round"/>'


def _line(start: NDArray, end: NDArray, name: str) -> str:
    (x1, y1), (x2, y2) = _place(start), _place(end)
    return f'<line class="{name}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'


def _camera() -> str:
    """A box, and the cone of what it looks at: the unit ball."""
    forward = -CAMERA / np.linalg.norm(CAMERA)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    rim = [
        forward * 0.5 + 0.2 * (a * right + b * up) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    corners = [CAMERA + offset for offset in rim]
    outline = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in map(_place, corners)) + "Z"
    rays = "".join(
        "M{:.1f} {:.1f}L{:.1f} {:.1f}".format(*_place(CAMERA), *_place(corner))
        for corner in corners
    )
    return f'<path class="camera" d="{outline}{rays}"/>'


if __name__ == "__main__":
    FILE.write_text(draw(), encoding="utf-8")
