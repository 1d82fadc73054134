"""Curves in the plane (and in space) from which solids are extruded, revolved and swept.

An extent along an axis is a length, centred on zero, or an interval ``(low, high)``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Extent = float | tuple[float, float]


def span(extent: Extent) -> tuple[float, float]:
    """An extent as an interval."""
    if isinstance(extent, tuple):
        return extent
    return -extent / 2, extent / 2


def circle(radius: float, segments: int = 24) -> NDArray[np.float64]:
    """(segments,2) points of a circle, counter-clockwise from +x."""
    t = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    return radius * np.stack([np.cos(t), np.sin(t)], 1)


def superellipse(x: float, y: float, power: float = 4.0, segments: int = 32) -> NDArray[np.float64]:
    """(segments,2) points between an ellipse (power 2) and a rectangle (power → ∞).

    x and y are the half axes.
    """
    t = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    c, s = np.cos(t), np.sin(t)
    return np.stack([
        x * np.sign(c) * np.abs(c) ** (2 / power), y * np.sign(s) * np.abs(s) ** (2 / power),
    ], 1)  # fmt: skip


def rounded_rectangle(x: Extent, y: Extent, radius: float, steps: int = 4) -> NDArray[np.float64]:
    """(4·(steps+1),2) outline of a rectangle with round corners, counter-clockwise."""
    (x0, x1), (y0, y1) = span(x), span(y)
    radius = min(radius, (x1 - x0) * 0.499, (y1 - y0) * 0.499)
    c, s = circle(radius, 4 * steps)[: steps + 1].T
    return np.concatenate([
        np.stack([x1 - radius + c, y1 - radius + s], 1),
        np.stack([x0 + radius - s, y1 - radius + c], 1),
        np.stack([x0 + radius - c, y0 + radius - s], 1),
        np.stack([x1 - radius + s, y0 + radius - c], 1),
    ])  # fmt: skip


def smooth(points: ArrayLike, count: int = 24) -> NDArray[np.float64]:
    """``count`` points of the Catmull-Rom curve through (n,d) points, ends included."""
    points = np.asarray(points, np.float64)
    padded = np.concatenate([2 * points[:1] - points[1:2], points, 2 * points[-1:] - points[-2:-1]])
    t = np.linspace(0, len(points) - 1, count)
    i = np.minimum(t.astype(int), len(points) - 2)
    u = (t - i)[:, None]
    p0, p1, p2, p3 = padded[i], padded[i + 1], padded[i + 2], padded[i + 3]
    return 0.5 * (
        2 * p1 + (p2 - p0) * u + (2 * p0 - 5 * p1 + 4 * p2 - p3) * u**2
        + (3 * p1 - p0 - 3 * p2 + p3) * u**3
    )  # fmt: skip


def arc(
    centre: ArrayLike, radius: float, start_degrees: float, end_degrees: float, count: int = 12
) -> NDArray[np.float64]:
    """(count,2) points of an arc about a 2D centre."""
    t = np.radians(np.linspace(start_degrees, end_degrees, count))
    return np.asarray(centre, np.float64) + radius * np.stack([np.cos(t), np.sin(t)], 1)


def counter_clockwise(outline: ArrayLike) -> NDArray[np.float64]:
    """(n,2) the outline, turned round if it runs clockwise."""
    points = np.asarray(outline, np.float64)
    x, y = points.T
    area = (x * np.roll(y, -1) - np.roll(x, -1) * y).sum()
    return points if area > 0 else points[::-1]
