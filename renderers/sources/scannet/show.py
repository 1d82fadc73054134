"""A picture to check poses by eye: each instance's points and CAD box in its canonical frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from renderers.sources.scannet.reader import ScanInstance

_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
_EDGES = [
    (i, j) for i in range(8) for j in range(i + 1, 8) if (_CORNERS[i] != _CORNERS[j]).sum() == 1
]
# Towards the eye of the oblique view; seen from the front-right of a class whose front is −y.
_EYE = np.array([0.55, -0.7, 0.45])


def draw_instances(named: list[tuple[str, ScanInstance]], path: Path) -> None:
    """Write a PNG with a row per instance: oblique view, from above, from +x.

    Points are shaded by depth, the CAD's box is grey, the canonical axes x red, y green, z blue.

    Args:
        named: (title, instance) pairs.
        path: of the PNG; its folder must exist.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4 * len(named)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(named), 3, squeeze=False)
    for row, (title, shape) in zip(axes, named, strict=True):
        corners = shape.box_centre + _CORNERS * shape.box_half_extent
        label = f"{title} {shape.class_name} · box to points {100 * shape.residual_m:.1f} cm"
        for ax, view, name in zip(row, _views(), (label, "from above", "from +x"), strict=True):
            points = shape.points @ view.T
            order = np.argsort(points[:, 2])
            ax.scatter(*points[order, :2].T, c=points[order, 2], s=2, cmap="viridis")
            flat = corners @ view.T
            for i, j in _EDGES:
                ax.plot(*flat[[i, j], :2].T, color="0.4", linewidth=0.8)
            for axis, colour in zip(np.eye(3), "rgb", strict=True):
                ax.plot(*np.stack([np.zeros(2), (view @ axis)[:2] * 0.5]).T, color=colour)
            ax.set_title(name, fontsize=9)
            ax.set_aspect("equal")
            ax.set_axis_off()
    figure.savefig(path, dpi=80, metadata={"Software": None})


def _views() -> list[NDArray[np.float64]]:
    """(3,3) each: rows are the picture's right, its up, and towards the eye."""
    eye = _EYE / np.linalg.norm(_EYE)
    right = np.cross((0, 0, 1), eye)
    right /= np.linalg.norm(right)
    oblique = np.stack([right, np.cross(eye, right), eye])
    from_x = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    return [oblique, np.eye(3), from_x]
