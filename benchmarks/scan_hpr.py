"""The radius of hidden point removal on scanned objects, against ray casting on the scan's mesh.

    python -m benchmarks.scan_hpr --rooms 5
    python -m benchmarks.scan_hpr --scannet DIR --scan2cad full_annotations.json
    python -m benchmarks.scan_hpr --rooms 5 --figure docs/images/scan_hpr.png

For every instance and viewpoint, a point is truly seen when no face of the instance's own part of
the mesh lies between it and the viewpoint (what else stands in the room hides nothing in PS15).
Counted over all points of all views: the truly seen that are lost, the hidden among the reported,
and F, the harmonic mean of precision and recall. Only views that the rules accept at ``--accept``
count, the same for every gamma: they are what a data set holds.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.seeding import generator
from renderers.hpr import hidden_point_removal, paper_radius
from renderers.rooms.scan import import_open3d
from renderers.rooms.source import SimulatedRooms
from renderers.sources.scannet.filters import Rules, judge_view
from renderers.sources.scannet.frames import read_scene, scene_folder
from renderers.sources.scannet.instances import segment
from renderers.sources.scannet.reader import ScanInstance
from renderers.sources.scannet.source import ScanNetInstances

GAMMAS = np.arange(1.0, 4.01, 0.25)
BEFORE = 1e-3
"""A segment ends this share before its point, so that the point's own faces do not hide it."""


def own_faces(source: ScanNetInstances, scene_id: str) -> dict[int, NDArray[np.int64]]:
    """Index of an instance → its faces, as positions in its points."""
    reader, annotation = source._reader, source._annotations[scene_id]
    folder = scene_folder(source.scannet, scene_id)
    assert folder is not None
    settled = reader.settled(read_scene(folder, reader.known_labels), annotation)
    found = {}
    for instance in segment(settled, annotation, reader.known_labels, reader.rules)[0]:
        position = np.full(len(settled.vertices), -1)
        position[instance.vertices] = np.arange(len(instance.vertices))
        faces = position[settled.faces]
        found[instance.index] = faces[(faces >= 0).all(axis=1)]
    return found


def truly_seen(
    o3d: Any, points: NDArray, faces: NDArray[np.int64], viewpoint: NDArray
) -> NDArray[np.bool_]:
    """Whether the segment from the viewpoint to each point (n,3) meets none of the faces."""
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(points.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32))
    )
    rays = np.hstack([np.tile(viewpoint, (len(points), 1)), points - viewpoint])
    hidden = scene.test_occlusions(o3d.core.Tensor(rays.astype(np.float32)), 0.0, 1 - BEFORE)
    return ~hidden.numpy()


def study(source: ScanNetInstances, views: int, accept: float) -> NDArray[np.float64]:
    """(4, gammas): truly seen and reported, truly seen, reported, and views accepted at a gamma."""
    o3d: Any = import_open3d()
    counts = np.zeros((4, len(GAMMAS)))
    rules = Rules()
    faces: dict[int, NDArray[np.int64]] = {}
    scene = ""
    for ref in [ref for split in source.splits() for ref in source.objects(split)]:
        if ref.location != scene:
            scene, faces = ref.location, own_faces(source, ref.location)
        shape: ScanInstance = source.load(ref)
        points = shape.points.astype(np.float64)
        rngs = [generator(0, "scan hpr", ref.object_id, view) for view in range(views)]
        for R, t in source.poses(shape, rngs):
            viewpoint = -R.T @ t
            found = {
                gamma: hidden_point_removal(
                    points, viewpoint, paper_radius(points, viewpoint, gamma)
                )
                for gamma in GAMMAS.tolist()
            }
            for g, seen in enumerate(found.values()):
                counts[3, g] += (
                    judge_view(points[seen], shape.normals[seen], viewpoint, rules) is None
                )
            judged = found[accept]
            if judge_view(points[judged], shape.normals[judged], viewpoint, rules):
                continue
            truth = truly_seen(o3d, points, faces[int(ref.object_id.rsplit("/", 1)[1])], viewpoint)
            for g, seen in enumerate(found.values()):
                counts[:3, g] += truth[seen].sum(), truth.sum(), len(seen)
    return counts


def table(counts: NDArray[np.float64], total: int) -> NDArray[np.float64]:
    """Print the curve; returns F by gamma."""
    recall, precision = counts[0] / counts[1], counts[0] / counts[2]
    score = 2 * recall * precision / (recall + precision)
    sys.stdout.write(f"{'gamma':>6}{'lost':>8}{'leaked':>8}{'F':>8}{'accepted':>10}\n")
    for row in zip(GAMMAS, 1 - recall, 1 - precision, score, counts[3] / total, strict=True):
        sys.stdout.write("{:>6.2f}{:>8.3f}{:>8.3f}{:>8.3f}{:>10.3f}\n".format(*row))
    sys.stdout.flush()
    return score


def figure(curves: dict[str, NDArray[np.float64]], out: Path) -> None:
    """F over gamma, a line for each kind of viewpoint."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(5, 3.2), layout="constrained")
    FigureCanvasAgg(drawn)
    axes = drawn.subplots()
    for name, score in curves.items():
        axes.plot(GAMMAS, score, marker="o", markersize=3, label=name)
    axes.set_xlabel("gamma (radius = 10^gamma · largest distance)")
    axes.set_ylabel("F against ray casting")
    axes.grid(alpha=0.3)
    axes.legend()
    drawn.savefig(out, dpi=130, metadata={"Software": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--rooms", type=int, default=5)
    parser.add_argument("--scannet", type=Path)
    parser.add_argument("--scan2cad", type=Path)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--accept", type=float, default=2.5, choices=GAMMAS.tolist())
    parser.add_argument("--figure", type=Path)
    given = parser.parse_args()
    curves = {}
    for viewpoints in ("uniform", "standing"):
        source = (
            SimulatedRooms(given.rooms, viewpoints=viewpoints)
            if given.scannet is None
            else ScanNetInstances(given.scannet, given.scan2cad, viewpoints=viewpoints)
        )
        total = given.views * sum(len(source.objects(split)) for split in source.splits())
        sys.stdout.write(f"{viewpoints} viewpoints, {total} views\n")
        curves[viewpoints] = table(study(source, given.views, given.accept), total)
    if given.figure:
        figure(curves, given.figure)


if __name__ == "__main__":
    main()
