"""Mean occupancy of real and parametric clouds side by side, in three projections a class."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from numpy.typing import NDArray

from benchmarks.realism.clouds import Clouds
from partialbench.dataset.categories import MODELNET40
from partialbench.geometry.rotations import axis_rotation

BINS = 48
SPACE_BINS = 16
_VIEWS = {"front (x, z), from −y": (0, 2), "side (y, z), from +x": (1, 2), "top (x, y)": (0, 1)}


def projection(points: NDArray, axes: tuple[int, int]) -> NDArray[np.float64]:
    """(BINS,BINS) mean over clouds of the share of points in each cell of [−1,1]², row = 2nd axis.

    Args:
        points: (M,N,3).
        axes: which coordinates run right and up.
    """
    flat = points[..., axes].reshape(-1, 2)
    counts, _, _ = np.histogram2d(flat[:, 1], flat[:, 0], BINS, [(-1, 1), (-1, 1)])
    return counts / max(len(flat), 1)


def overlap(a: NDArray, b: NDArray) -> float:
    """Shared mass of two distributions: 1 for equal ones, 0 for disjoint ones."""
    return float(np.minimum(a, b).sum() / max(a.sum(), b.sum()))


def overlaps_by_yaw(real: NDArray, made: NDArray) -> NDArray[np.float64]:
    """(4,) overlap of mean occupancy in space after turns of ``made`` by 0, 90, 180, 270° of yaw.

    Args:
        real, made: (M,N,3) normalised clouds of one class; a family in its class's frame overlaps
            best unturned, up to the class's symmetry.
    """

    def occupancy(points: NDArray) -> NDArray[np.float64]:
        counts, _ = np.histogramdd(points.reshape(-1, 3), SPACE_BINS, [(-1, 1)] * 3)
        return counts / counts.sum()

    still = occupancy(real)
    turns = [np.round(axis_rotation("z", k * np.pi / 2)) for k in range(4)]
    return np.array([overlap(still, occupancy(made @ turn.T)) for turn in turns])


def draw(real: Clouds, made: Clouds, folder: Path) -> dict[str, float]:
    """One picture a class into ``folder``: real above, parametric below.

    Returns:
        Class name → overlap of the two occupancies, the mean of the three projections.
    """
    matplotlib.use("agg")
    from matplotlib import pyplot

    folder.mkdir(parents=True, exist_ok=True)
    overlaps = {}
    for label in np.unique(made.labels):
        name = MODELNET40[label]
        rows = {
            "real": real.points[real.labels == label],
            "parametric": made.points[made.labels == label],
        }
        figure, axes = pyplot.subplots(2, 3, figsize=(7.5, 5))
        shared = []
        for column, (title, pair) in enumerate(_VIEWS.items()):
            images = [projection(points, pair) for points in rows.values()]
            shared.append(overlap(*images))
            for row, (kind, image) in enumerate(zip(rows, images, strict=True)):
                axes[row, column].imshow(np.sqrt(image), origin="lower", extent=(-1, 1, -1, 1))
                axes[row, column].set_title(f"{kind}: {title}", fontsize=7)
                axes[row, column].tick_params(labelsize=5)
        overlaps[name] = float(np.mean(shared))
        figure.suptitle(f"{name}: overlap {overlaps[name]:.2f}")
        figure.tight_layout()
        figure.savefig(folder / f"{label:02d}_{name}.png", dpi=80)
        pyplot.close(figure)
    return overlaps
