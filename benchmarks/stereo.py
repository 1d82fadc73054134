"""What the stereo sensors measure: spread over distance, holes over angle, edges; plot and table.

python -m benchmarks.stereo --out docs/images/stereo.png
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.seeding import generator
from partialbench.geometry.camera import Camera
from partialbench.geometry.rotations import axis_rotation
from renderers import stereo
from renderers.stereo import Stereo
from renderers.variants import activate, pick_variant

SIDE = 160
DISTANCES_M = (0.8, 1.1, 1.5, 2.0, 2.6, 3.2)
TILT_DEG = 30.0
ALBEDO, DARK = 0.4, 0.03
ANGLES_DEG = (0, 30, 50, 60, 70, 75, 80, 85)


def quad(z: float, half: float, angle_deg: float = 0.0, axis: str = "y") -> tuple[NDArray, NDArray]:
    """A square at a distance, turned about the vertical or another axis: vertices and faces."""
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * half
    turned = corners @ axis_rotation(axis, np.deg2rad(angle_deg)).T
    return turned + [0, 0, z], np.array([[0, 1, 2], [0, 2, 3]])


def camera_of(sensor: Stereo, side: int = SIDE) -> Camera:
    """The middle of a sensor's image."""
    K = np.array([[sensor.focal, 0, side / 2], [0, sensor.focal, side / 2], [0, 0, 1.0]])
    return Camera(K, side, side)


def errors(
    sensor: Stereo, distance: float, views: int = 3, angle_deg: float = TILT_DEG, axis: str = "y"
) -> NDArray[np.float64]:
    """Errors in metres of z measured on a turned plane at a distance, without mismatches.

    A plane that faces the camera has one disparity, and what a matcher makes of that one depends on
    where it lies between two pixels; a tilted one has them all.
    """
    camera = camera_of(sensor)
    part = quad(distance, 3 * distance, angle_deg, axis)
    normal = axis_rotation(axis, np.deg2rad(angle_deg)) @ [0, 0, 1]
    found = []
    for k in range(views):
        rng = generator(k, "plane", str(distance))
        z, _ = sensor.measure([(part, ALBEDO)], camera, (0.75 * distance, 1.4 * distance), rng)
        v, u = np.nonzero(z)
        rays = camera.unproject(np.stack([u + 0.5, v + 0.5], axis=1), np.ones(len(u)))
        found.append(z[v, u] - distance * normal[2] / (rays @ normal))
    every = np.concatenate(found)
    return every[np.abs(every) < 8 * np.median(np.abs(every))]


def spread(sensor: Stereo, distance: float, views: int = 3) -> tuple[float, float]:
    """σ and bias in metres of z measured on a plane at a distance, turned by 30°."""
    found = errors(sensor, distance, views)
    return float(found.std()), float(np.median(found))


def lowered(sensor: Stereo, distance: float = 1.1) -> float:
    """By how many pixels a surface is measured lower in the image than it is.

    Half of the difference of what planes turned by 30° up and down err by, which is no bias of
    depth, over their slope.
    """
    up, down = (errors(sensor, distance, 3, a, "x").mean() for a in (TILT_DEG, -TILT_DEG))
    slope = distance / sensor.focal * np.tan(np.deg2rad(TILT_DEG))
    return float(down - up) / 2 / slope


def filled(
    sensor: Stereo, angle_deg: float, distance: float = 1.5, albedo: float = ALBEDO
) -> float:
    """Share of the pixels of a tilted square that are measured."""
    rng = generator(0, "tilted", str(angle_deg))
    part = quad(distance, 0.2, angle_deg)
    camera = camera_of(sensor)
    z, _ = sensor.measure([(part, albedo)], camera, (distance - 0.35, distance + 0.6), rng)
    (left, right), (top, bottom) = _outline(camera, part[0])
    inside = z[top:bottom, left:right]
    slope = np.sin(np.deg2rad(angle_deg)) * 0.2 + 0.1
    return float(((inside > 0) & (np.abs(inside - distance) < slope)).mean())


def fattening(sensor: Stereo, distance: float = 1.2) -> float:
    """By how many pixels on each side a square before a wall is measured too wide."""
    widths = []
    camera = camera_of(sensor)
    part = quad(distance, 0.07)
    for k in range(5):
        z, _ = sensor.measure([(part, ALBEDO)], camera, (0.9, 1.8), generator(k, "edges"))
        (left, right), (top, bottom) = _outline(camera, part[0])
        middle = z[top + 8 : bottom - 8]
        near = (middle > 0) & (np.abs(middle - distance) < 0.1)
        widths.append(near.sum(axis=1).mean() - (right - left))
    return float(np.mean(widths)) / 2


def seconds(sensor: Stereo) -> float:
    """Of processor for one view of 320×240 pixels; the first, which compiles, is not counted."""
    K = np.array([[sensor.focal, 0, 160], [0, sensor.focal, 120], [0, 0, 1.0]])
    camera = Camera(K, 320, 240)
    for k in range(7):
        if k == 1:
            start = time.process_time()
        part = quad(1.7, 0.4, 30)
        sensor.measure([(part, ALBEDO)], camera, (1.2, 2.6), generator(k, "speed"))
    return (time.process_time() - start) / 6


def _outline(camera: Camera, vertices: NDArray) -> tuple[tuple[int, int], tuple[int, int]]:
    uv, _ = camera.project(vertices)
    low, high = np.ceil(uv.min(axis=0)).astype(int), np.floor(uv.max(axis=0)).astype(int)
    low, high = low.clip(0), high.clip(max=[camera.width, camera.height])
    return (int(low[0]), int(high[0])), (int(low[1]), int(high[1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/images/stereo.png"))
    arguments = parser.parse_args()
    activate(pick_variant(), 1)
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(13, 3.8), layout="constrained")
    for sensor, colour in ((stereo.d415(), "C0"), (stereo.kinect_v1(), "C1")):
        sigma = np.array([spread(sensor, d) for d in DISTANCES_M])
        square = np.square(DISTANCES_M)
        factor = float((sigma[:, 0] * square).sum() / (square**2).sum())
        print(f"{sensor.name}: σ_z = {1e3 * factor:.2f} mm·z²")
        for d, (s, b) in zip(DISTANCES_M, sigma, strict=True):
            print(f"  {d} m: σ {1e3 * s:.2f} mm, of the law {s / factor / d**2:.2f}, "
                  f"bias {1e3 * b:+.2f} mm")  # fmt: skip
        shares = [filled(sensor, angle) for angle in ANGLES_DEG]
        dark = [filled(sensor, angle, albedo=DARK) for angle in ANGLES_DEG]
        for what, found in (("filled", shares), (f"of albedo {DARK}", dark)):
            told = (f"{a}° {s:.2f}" for a, s in zip(ANGLES_DEG, found, strict=True))
            print(f"  {what}:", ", ".join(told))
        wider, cost = fattening(sensor), seconds(sensor)
        print(f"  edges {wider:+.2f} px a side; {lowered(sensor):+.2f} px lower in the image; "
              f"{cost:.2f} s of processor a view")  # fmt: skip
        axes[0].plot(DISTANCES_M, 1e3 * sigma[:, 0], "o", color=colour, label=sensor.name)
        x = np.linspace(DISTANCES_M[0], DISTANCES_M[-1])
        axes[0].plot(x, 1e3 * factor * x**2, color=colour, lw=1)
        axes[1].plot(ANGLES_DEG, shares, "o-", color=colour)
        axes[1].plot(ANGLES_DEG, dark, "o:", color=colour, label=f"albedo {DARK}")
        if colour == "C0":
            part, rng = quad(1.2, 0.07), generator(0, "picture")
            z, image = sensor.measure([(part, ALBEDO)], camera_of(sensor), (0.9, 1.8), rng)
            depth = np.where(z > 0, (z - 1) / 0.9, 0)
            axes[2].imshow(np.hstack([image / image.max(), depth]), "gray")
    axes[0].set(xlabel="distance (m)", ylabel="σ of z (mm)", title="a plane; lines: c·z²")
    axes[1].set(xlabel="angle of incidence (°)", ylabel="share measured", title="a tilted square")
    axes[2].set(title="D415-like: infrared image, measured z", xticks=[], yticks=[])
    for axis in axes[:2]:
        axis.legend(frameon=False)
    figure.savefig(arguments.out, dpi=110)


if __name__ == "__main__":
    main()
