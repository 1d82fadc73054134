"""Draws one view: the object, faint, what a depth camera sees of it, and where from.

    python examples/view_picture.py view.png

The picture of the README. ``partialbench.render_view`` makes all that it shows.
"""

from __future__ import annotations

import sys

import matplotlib

matplotlib.use("agg")
import numpy as np
from matplotlib import pyplot
from matplotlib.collections import LineCollection, PolyCollection

import partialbench as pb
from renderers.shapes.catalogue import FAMILIES

PAPER, INK, FAINT = "#fbfaf7", "#30343b", "#c9ccd1"
AXES = {"x": "#d1495b", "y": "#3a8f5c", "z": "#2e6fb7"}
FROM_ABOVE, AROUND = np.radians(18), np.radians(-38)
"""Where the picture is seen from; the depth camera is elsewhere."""


def seen(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Object frame (…,3) → where in the picture (…,2), and how far back (…)."""
    c, s = np.cos(AROUND), np.sin(AROUND)
    x, y, z = np.moveaxis(np.asarray(points, float), -1, 0)
    right, back = c * x - s * y, s * x + c * y
    up = np.cos(FROM_ABOVE) * z + np.sin(FROM_ABOVE) * back
    return np.stack([right, up], -1), np.cos(FROM_ABOVE) * back - np.sin(FROM_ABOVE) * z


def main(out: str) -> None:
    mesh = FAMILIES["chair"].mesh(3, 0)
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    mesh.apply_scale(1 / np.linalg.norm(mesh.vertices, axis=1).max())
    eye = np.array([-2.1, -1.6, 1.15])
    view = pb.render_view(mesh, pb.look_at(eye), num_points=2048, depth=True)
    R, t = view.R_camera_object, view.t_camera_object
    points = (view.points - t) @ R  # p_camera = R · p_object + t

    figure, (scene, image) = pyplot.subplots(
        1, 2, figsize=(9.6, 4.2), width_ratios=(2.2, 1), facecolor=PAPER
    )
    triangles, back = seen(mesh.triangles)
    order = np.argsort(-back.mean(axis=1))
    faint = PolyCollection(triangles[order], facecolor="#dfe1e4", edgecolor=FAINT, alpha=0.7)
    faint.set_linewidth(0.15)
    scene.add_collection(faint)
    where, back = seen(points)
    order = np.argsort(-back)
    shade = np.linalg.norm(points - eye, axis=1)[order]
    scene.scatter(*where[order].T, c=-shade, cmap="viridis", s=4, linewidth=0, zorder=3)

    # The object's own axes: what R turns.
    for axis, (name, colour) in zip(1.15 * np.eye(3), AXES.items(), strict=True):
        (start, end), _ = seen(np.stack([0 * axis, axis]))
        scene.annotate("", end, start, annotation_clip=False, zorder=4,
                       arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.8})  # fmt: skip
        scene.text(
            *(end + 0.06 * (end - start)), name, color=colour, fontsize=12, ha="center", va="center"
        )

    # The camera: its pyramid, 0.6 long, and dotted rays to the corners of what it sees.
    height, width = view.depth.shape
    corners = np.array([(0, 0), (width, 0), (width, height), (0, height)])
    rays = np.column_stack([corners, np.ones(4)]) @ np.linalg.inv(view.K).T
    near, far = ((depth * rays - t) @ R for depth in (0.6, t[2]))
    (apex, *_), _ = seen(eye[None])
    near, far = seen(near)[0], seen(far)[0]
    frame = [*([apex, corner] for corner in near), *zip(near, np.roll(near, 1, 0), strict=True)]
    scene.add_collection(LineCollection(frame, color=INK, linewidth=1.1, zorder=5))
    rays = [[corner, end] for corner, end in zip(near, far, strict=True)]
    scene.add_collection(LineCollection(rays, color=INK, linewidth=0.5, linestyle=(0, (1, 4))))
    scene.text(*(apex + (0, 0.08)), "camera", color=INK, fontsize=11)

    kept = np.where(view.depth > 0, view.depth, np.nan)
    image.imshow(-kept, cmap="viridis", interpolation="nearest")
    image.set_title("its depth image", color=INK, fontsize=11)
    rows = [" ".join(f"{value:+.2f}" for value in row) for row in R.round(2) + 0]
    said = [
        f"points   {len(view.points):,} × 3, camera frame",
        f"visible  {view.visible_fraction:.0%} of the surface",
        *(f"{'R' if i == 1 else ' '}        {row}" for i, row in enumerate(rows)),
        "t        " + " ".join(f"{value:+.2f}" for value in t.round(2) + 0),
    ]
    image.text(0.5, -0.06, "\n".join(said), transform=image.transAxes, family="monospace",
               fontsize=8, color=INK, ha="center", va="top",
               multialignment="left")  # fmt: skip
    scene.set_aspect("equal")
    scene.autoscale_view()
    scene.margins(0.03)
    for one in (scene, image):
        one.set_axis_off()
    figure.subplots_adjust(0.01, 0.26, 0.97, 0.92, wspace=0.02)
    scene.set_position((0.0, 0.02, 0.66, 0.96))
    figure.savefig(out, dpi=150, facecolor=PAPER)


if __name__ == "__main__":
    main(sys.argv[1])
