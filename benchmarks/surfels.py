"""A z-buffer of surfels against hidden point removal, on the clouds of ``hpr.py radius``.

    python -m benchmarks.surfels [--points 1024] [--objects 40] [--views 2]

Every point becomes a disc whose radius is a share of the distance to its k-th neighbour. A point is
hidden where its line of sight meets another's disc nearer by more than a tolerance, which is a
share of the same distance. Discs lie in the plane through the point's neighbours ("in the surface")
or face the camera ("facing"). All settings of a grid are tried; the best of each kind is printed,
which flatters them.
"""

from __future__ import annotations

import argparse
import itertools
import sys

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks.hpr import GAMMAS, Score, found_by_hpr, sampled_views
from renderers.normals import plane_normals

NEIGHBOURS, SHARES, TOLERANCES = (2, 4, 6), (0.5, 0.7, 0.85, 1.0), (0.25, 0.5, 1.0, 1.5)


def seen_past_discs(
    offsets: NDArray, normals: NDArray, radii: NDArray, tolerances: NDArray
) -> NDArray[np.bool_]:
    """Which points no disc hides.

    Args:
        offsets: (N,3) from the viewpoint.
        normals: (N,3) of the discs; of either sign, need not be unit vectors.
        radii, tolerances: (N,) of the discs.
    """
    square = np.einsum("ij,ij->i", offsets, offsets)
    dot = offsets @ offsets.T
    with np.errstate(divide="ignore", invalid="ignore"):
        # Where the line to point j meets the plane of disc i, as a share of the way.
        share = np.einsum("ij,ij->i", offsets, normals)[:, None] / (normals @ offsets.T)
        nearer = (share > 0) & ((1 - share) * np.sqrt(square) > tolerances[:, None])
        apart = share**2 * square - 2 * share * dot + square[:, None]
        hides = nearer & (apart <= radii[:, None] ** 2)
    np.fill_diagonal(hides, False)
    return ~hides.any(axis=0)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--points", type=int, default=1024)
    parser.add_argument("--objects", type=int, default=40)
    parser.add_argument("--views", type=int, default=2)
    given = parser.parse_args()
    scores: dict[tuple, Score] = {}
    for points, viewpoint, truth in sampled_views(given.points, given.objects, given.views):
        for gamma in GAMMAS:
            found = found_by_hpr(points, viewpoint, float(gamma))
            scores.setdefault(("hidden point removal", f"gamma {gamma:g}"), Score()).add(
                found, truth
            )
        distance = cKDTree(points).query(points, max(NEIGHBOURS) + 1)[0]
        offsets = points - viewpoint
        for kind, normals in (("in the surface", plane_normals(points)), ("facing", offsets)):
            for k, share, tolerance in itertools.product(NEIGHBOURS, SHARES, TOLERANCES):
                spacing = distance[:, k]
                found = seen_past_discs(offsets, normals, share * spacing, tolerance * spacing)
                setting = f"neighbour {k}, radius {share:g}, tolerance {tolerance:g}"
                scores.setdefault((f"surfels {kind}", setting), Score()).add(found, truth)
    for kind in dict.fromkeys(key[0] for key in scores):
        best = max((key for key in scores if key[0] == kind), key=lambda key: scores[key].f)
        score = scores[best]
        sys.stdout.write(
            f"{kind:<24}F {score.f:.3f}  precision {score.precision:.3f}  "
            f"recall {score.recall:.3f}  ({best[1]})\n"
        )


if __name__ == "__main__":
    main()
