"""Hidden point removal: speed of the culled hull, and what the radius does.

    python benchmarks/hpr.py speed  [--points 10000 50000 200000] [--turns 5]
    python benchmarks/hpr.py radius [--points 1024 4096] [--objects 120] [--views 4] [--out PNG]
    python benchmarks/hpr.py picture [--out docs/images/hpr_leak.png]

``speed`` times, in turns in one process, the hull of all flipped points, the same with
``possible_vertices`` before it, the hull of the visible points alone (no culling can be faster
than that) and Open3D where it imports, on boxes of which more and more are hidden. Figures are the
least CPU time of the turns; the index sets are required to be equal.

``radius`` measures, over built-in shapes and the paper's poses, how many of the reported points are
truly visible (precision) and how many of the truly visible are reported (recall), with ray casting
as the truth. Clouds are uniform on the surface, as the aligned ModelNet40 clouds are: their
distances to the nearest neighbour vary as those of uniform points do. ``benchmarks/surfels.py``
measures the alternative on the same clouds.

``picture`` draws the leak through a thin plate for docs/hpr.md.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from partialbench.dataset.categories import MODELNET40
from partialbench.dataset.seeding import generator
from partialbench.geometry.camera import sample_pose
from renderers.hpr import flip, hidden_point_removal, paper_radius
from renderers.hull_cull import possible_vertices
from renderers.shapes.catalogue import make
from renderers.whole import sample_surface

GAMMAS = np.arange(1, 3.01, 0.125)
# A sample counts as seen when its ray ends within this of it (object units).
RAY_TOLERANCE = 2e-3


def boxes(rng: np.random.Generator, points: int, count: int) -> NDArray[np.float64]:
    """Points on the surfaces of ``count`` boxes strewn in a cube."""
    centre, half = rng.uniform(-1, 1, (count, 3)), rng.uniform(0.05, 0.15, (count, 3))
    which = rng.integers(0, count, points)
    on = rng.uniform(-1, 1, (points, 3))
    on[np.arange(points), rng.integers(0, 3, points)] = rng.choice([-1.0, 1.0], points)
    return centre[which] + half[which] * on


def hull_of(flipped: NDArray) -> NDArray[np.intp]:
    vertices = ConvexHull(np.vstack([flipped, np.zeros(3)])).vertices
    return np.sort(vertices[vertices < len(flipped)])


def culled_hull_of(flipped: NDArray) -> NDArray[np.intp]:
    kept = possible_vertices(flipped)
    return kept[hull_of(flipped[kept])]


def open3d_removal(points: NDArray, viewpoint: NDArray, radius: float) -> Callable | None:
    try:
        import open3d as o3d
    except (ImportError, OSError):
        return None
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    return lambda: np.sort(cloud.hidden_point_removal(viewpoint[:, None], radius)[1])


def speed(sizes: list[int], turns: int) -> None:
    write = sys.stdout.write
    write(f"{'points':>8}{'boxes':>7}{'visible':>9}{'kept':>7}{'hull ms':>9}{'culled ms':>11}")
    write(f"{'ratio':>7}{'bound':>7}{'Open3D ms':>11}\n")
    viewpoint = np.array([0.3, 0.5, -4.0])
    for size in sizes:
        for count in (1, 30, 1000):
            points = boxes(generator(0, size, count), size, count)
            radius = paper_radius(points, viewpoint, 2.0)
            flipped = flip(points - viewpoint, radius)
            visible = hull_of(flipped)
            runs: dict[str, Callable] = {
                "full": lambda f=flipped: hull_of(f),
                "culled": lambda f=flipped: culled_hull_of(f),
                "bound": lambda f=flipped[visible]: hull_of(f),
            }
            theirs = open3d_removal(points, viewpoint, radius)
            if theirs is not None:
                runs["open3d"] = theirs
            best = dict.fromkeys(runs, np.inf)
            for _ in range(turns):
                for name, run in runs.items():
                    start = time.process_time()
                    found = run()
                    best[name] = min(best[name], time.process_time() - start)
                    if name != "bound" and not np.array_equal(found, visible):
                        raise SystemExit(f"{name}: another index set at {size} points")
            kept = len(possible_vertices(flipped)) / size
            write(f"{size:>8}{count:>7}{len(visible) / size:>9.3f}{kept:>7.3f}")
            write(f"{1e3 * best['full']:>9.1f}{1e3 * best['culled']:>11.1f}")
            write(f"{best['full'] / best['culled']:>7.2f}{best['full'] / best['bound']:>7.2f}")
            write(f"{1e3 * best['open3d']:>11.1f}\n" if theirs else f"{'absent':>11}\n")
            sys.stdout.flush()


def truly_visible(mesh: trimesh.Trimesh, points: NDArray, viewpoint: NDArray) -> NDArray[np.bool_]:
    """Whether the segment from the viewpoint meets the surface at the sample first."""
    import open3d

    o3d: Any = open3d  # its stubs do not admit arrays
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(np.asarray(mesh.vertices, np.float32)),
        o3d.core.Tensor(np.asarray(mesh.faces, np.uint32)),
    )
    offsets = points - viewpoint
    distance = np.linalg.norm(offsets, axis=1)
    rays = np.hstack([np.tile(viewpoint, (len(points), 1)), offsets / distance[:, None]])
    hit = scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))["t_hit"].numpy()
    return hit > distance - RAY_TOLERANCE


def sampled_views(
    size: int, objects: int, views: int
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]]:
    """Points (size,3) on a shape, a viewpoint (3,) and which of them it truly sees (size,)."""
    for k in range(objects):
        name = MODELNET40[k % len(MODELNET40)]
        mesh = make(name, k // len(MODELNET40))
        for view in range(views):
            rng = generator(0, "hpr radius", name, k, view, size)
            points = sample_surface(mesh, size, rng)
            rotation, translation = sample_pose(rng)
            viewpoint = -rotation.T @ translation
            yield points, viewpoint, truly_visible(mesh, points, viewpoint)


@dataclass
class Score:
    """Counts over many views of what was reported against what is truly visible."""

    right: int = 0
    visible: int = 0
    reported: int = 0

    def add(self, found: NDArray[np.bool_], truth: NDArray[np.bool_]) -> None:
        self.right += int((found & truth).sum())
        self.visible += int(truth.sum())
        self.reported += int(found.sum())

    @property
    def precision(self) -> float:
        return self.right / self.reported

    @property
    def recall(self) -> float:
        return self.right / self.visible

    @property
    def f(self) -> float:
        return 2 * self.right / (self.reported + self.visible)


def found_by_hpr(points: NDArray, viewpoint: NDArray, gamma: float) -> NDArray[np.bool_]:
    found = np.zeros(len(points), np.bool_)
    radius = paper_radius(points, viewpoint, gamma)
    found[hidden_point_removal(points, viewpoint, radius)] = True
    return found


def radius_study(sizes: list[int], objects: int, views: int, out: Path | None) -> None:
    write = sys.stdout.write
    curves: dict[int, list[Score]] = {}
    for size in sizes:
        scores = curves[size] = [Score() for _ in GAMMAS]
        for points, viewpoint, truth in sampled_views(size, objects, views):
            for gamma, score in zip(GAMMAS, scores, strict=True):
                score.add(found_by_hpr(points, viewpoint, float(gamma)), truth)
        write(f"{size} points, {objects} objects, {views} views each\n")
        write(f"{'gamma':>6}{'precision':>11}{'recall':>8}{'F':>8}\n")
        for gamma, score in zip(GAMMAS, scores, strict=True):
            write(f"{gamma:>6.3f}{score.precision:>11.3f}{score.recall:>8.3f}{score.f:>8.3f}\n")
        sys.stdout.flush()
    if out:
        curve_picture(curves, out)


def curve_picture(curves: dict[int, list[Score]], out: Path) -> None:
    """Precision, recall and F over gamma, a panel for each number of points."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(
        1, len(curves), figsize=(4.5 * len(curves), 3.4), sharey=True, squeeze=False,
        layout="constrained",
    )  # fmt: skip
    for panel, (size, scores) in zip(panels[0], curves.items(), strict=True):
        for name in ("precision", "recall", "f"):
            panel.plot(GAMMAS, [getattr(score, name) for score in scores], ".-", label=name)
        panel.set_title(f"{size:,} points")
        panel.set_xlabel("gamma")
        panel.grid(alpha=0.3)
        panel.legend()
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=110)


def picture(out: Path) -> None:
    """A plate, 0.1 thick, drawn edge-on and seen from the right, for three radii."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    points = sample_surface(trimesh.creation.box((0.1, 1.4, 1.4)), 1024, generator(0, "plate"))
    viewpoint = np.array([3.5, 0.0, 0.0])
    front = np.isclose(points[:, 0], 0.05)
    figure, panels = plt.subplots(1, 3, figsize=(9, 3.6), sharey=True, layout="constrained")
    for panel, gamma in zip(panels, (1.0, 1.75, 3.0), strict=True):
        found = np.zeros(len(points), bool)
        found[hidden_point_removal(points, viewpoint, paper_radius(points, viewpoint, gamma))] = (
            True
        )
        for chosen, colour, label in (
            (~found & ~front, "0.8", "hidden, not reported"),
            (~found & front, "tab:orange", "seen, lost"),
            (found & front, "tab:blue", "seen, reported"),
            (found & ~front, "tab:red", "hidden, leaked"),
        ):
            panel.scatter(
                *points[chosen][:, [0, 1]].T, s=6, c=colour, label=f"{label} ({chosen.sum()})"
            )
        panel.set_title(f"gamma {gamma:g}")
        panel.set_xlim(-0.35, 0.35)
        panel.set_xlabel("x, the camera is at +3.5")
        panel.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.18))
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    what = parser.add_subparsers(dest="what", required=True)
    fast = what.add_parser("speed")
    fast.add_argument("--points", type=int, nargs="+", default=[10_000, 50_000, 200_000])
    fast.add_argument("--turns", type=int, default=5)
    study = what.add_parser("radius")
    study.add_argument("--points", type=int, nargs="+", default=[1024, 4096])
    study.add_argument("--objects", type=int, default=120)
    study.add_argument("--views", type=int, default=4)
    study.add_argument(
        "--out", type=Path, help="also draw the curves, e.g. docs/images/hpr_gamma.png"
    )
    draw = what.add_parser("picture")
    draw.add_argument("--out", type=Path, default=Path("docs/images/hpr_leak.png"))
    given = parser.parse_args()
    if given.what == "speed":
        speed(given.points, given.turns)
    elif given.what == "picture":
        picture(given.out)
    else:
        radius_study(given.points, given.objects, given.views, given.out)


if __name__ == "__main__":
    main()
