"""An oracle for depth images: every ray against every triangle, in float64, with NumPy alone.

It shares nothing with the renderer: no acceleration structure, no float32, another intersection
test. The camera is at the origin, so a ray through the pixel (u, v) is s·(x, y, 1) with
x = (u − cx)/fx, y = (v − cy)/fy, and a triangle (a, b, c) in the camera frame is hit when the three
signed volumes d·(b×c), d·(c×a), d·(a×b) have one sign; the depth is a·(b×c) over their sum.

The line d·(b×c) = 0 is the image of the edge bc. Divided by the norm of its (x, y) part the volume
is the distance from the pixel centre to that line in the plane z = 1, so "grown by m" below means:
hit when no edge is passed by more than m, and "shrunk by m" the reverse. Where a centre lies within
rounding of an edge, hit and miss are both right; the two depths bracket what a caster may answer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from partialbench.geometry.camera import Camera

PAIRS = 1 << 21


@dataclass
class Cast:
    """Depths (H,W) float64, 0 = no surface: exact, and with triangles grown and shrunk."""

    depth: np.ndarray
    grown: np.ndarray
    shrunk: np.ndarray


def cast(
    vertices: np.ndarray,
    faces: np.ndarray,
    R: np.ndarray,
    t: np.ndarray,
    camera: Camera,
    margin: float = 1e-6,
    prune: bool = True,
) -> Cast:
    """The depth image of a mesh that lies wholly in front of the camera.

    Args:
        vertices, faces: (V,3), (F,3), object frame.
        R, t: object → camera.
        margin: see above; in the plane z = 1.
        prune: try each triangle only on the pixels of its bounding box, one pixel wider all around;
            False tries all pairs.
    """
    corners = (vertices.astype(np.float64) @ R.T + t)[faces]
    assert (corners[..., 2] > 0).all()
    width, height = camera.width, camera.height
    images = [np.full(height * width, np.inf) for _ in range(3)]
    if prune:
        uv, _ = camera.project(corners)
        size = np.array([width, height])
        low = np.clip(np.floor(uv.min(axis=1) - 1.5).astype(int), 0, size)
        high = np.clip(np.ceil(uv.max(axis=1) + 1.5).astype(int), 0, size)
    else:
        low = np.zeros((len(faces), 2), int)
        high = np.tile([width, height], (len(faces), 1))
    spans = high - low
    counts = spans.prod(axis=1)
    ends = np.cumsum(counts)
    first = 0
    while first < len(faces):
        base = ends[first] - counts[first]
        last = max(first + 1, int(np.searchsorted(ends, base + PAIRS, side="right")))
        face = np.repeat(np.arange(first, last), counts[first:last])
        local = np.arange(len(face)) - (ends[face] - counts[face] - base)
        column = low[face, 0] + local % np.maximum(spans[face, 0], 1)
        row = low[face, 1] + local // np.maximum(spans[face, 0], 1)
        _meet(corners[first:last], face - first, row, column, camera, margin, images)
        first = last
    exact, grown, shrunk = (np.where(np.isinf(z), 0, z).reshape(height, width) for z in images)
    return Cast(exact, grown, shrunk)


def _meet(
    corners: np.ndarray,
    face: np.ndarray,
    row: np.ndarray,
    column: np.ndarray,
    camera: Camera,
    margin: float,
    images: list[np.ndarray],
) -> None:
    """Lower each image to the depths at which these (triangle, pixel) pairs meet."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    lines = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)  # (F,3,3)
    volume = np.einsum("fi,fi->f", a, lines[:, 0])
    x = (column + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    y = (row + 0.5 - camera.K[1, 2]) / camera.K[1, 1]
    sides = lines[face, :, 0] * x[:, None] + lines[face, :, 1] * y[:, None] + lines[face, :, 2]
    # Facing away or towards: turned so that inside is positive.
    total = sides.sum(axis=1)
    sides = sides * np.sign(total)[:, None]
    scale = np.hypot(lines[..., 0], lines[..., 1])[face]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = volume[face] / total
    valid = (total != 0) & np.isfinite(z) & (z > 0)
    pixel = row * camera.width + column
    for image, shift in zip(images, (0, margin, -margin), strict=True):
        hit = valid & (sides >= -shift * scale).all(axis=1)
        np.minimum.at(image, pixel[hit], z[hit])


def segments_clear(
    corners: np.ndarray, start: np.ndarray, directions: np.ndarray, ends: np.ndarray
) -> np.ndarray:
    """Whether each segment start + s·direction, 0 < s < end, meets no triangle: (S,) bool.

    Args:
        corners: (F,3,3) triangles; start: (3,); directions: (S,3); ends: (S,); float64.
    """
    a, b, c = (corners[:, k] - start for k in range(3))
    clear = np.ones(len(directions), bool)
    lines = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=0)  # (3,F,3)
    volume = np.einsum("fi,fi->f", a, lines[0])
    for first in range(0, len(directions), 64):
        part = slice(first, first + 64)
        sides = np.einsum("kfi,si->ksf", lines, directions[part])
        total = sides.sum(axis=0)
        one_sign = (sides >= 0).all(axis=0) | (sides <= 0).all(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = volume / total
        clear[part] = ~(one_sign & (total != 0) & (s > 0) & (s < ends[part, None])).any(axis=1)
    return clear
