"""The pinhole camera, OpenCV convention: x right, y down, z forward; depth is z.

The projection, with p_camera = R_camera_object · p_object + t_camera_object::

    u = fx · x/z + cx,   v = fy · y/z + cy        (pixels)

Pixel (row 0, column 0) covers [0,1]×[0,1]: its centre is (0.5, 0.5). Depth 0 means no surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from partialbench.errors import InputError
from partialbench.geometry.rotations import haar_rotations

# Paper, section 5.1: t_x, t_y ~ U(−2, 2), t_z ~ U(2, 5) for an object in the unit ball.
TRANSLATION_LOW = (-2.0, -2.0, 2.0)
TRANSLATION_HIGH = (2.0, 2.0, 5.0)


@dataclass(frozen=True)
class Camera:
    """Intrinsics and image size.

    Attributes:
        K: (3,3) float64, [[fx,0,cx],[0,fy,cy],[0,0,1]], pixels.
        width, height: image size in pixels.
    """

    K: NDArray[np.float64]
    width: int
    height: int

    def __post_init__(self) -> None:
        K = np.asarray(self.K, np.float64)
        if K.shape != (3, 3) or not np.isfinite(K).all():
            raise ValueError(f"K must be a finite (3,3) matrix, got {self.K!r}")
        if K[0, 0] <= 0 or K[1, 1] <= 0:
            raise ValueError(f"focal lengths must be positive, got {K[0, 0]} and {K[1, 1]} px")
        if K[0, 1] != 0 or K[1, 0] != 0 or not np.array_equal(K[2], (0, 0, 1)):
            raise ValueError(f"K must have no skew and a last row of 0 0 1, got {K.tolist()}")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"image size must be positive, got {self.width}×{self.height}")
        object.__setattr__(self, "K", K)

    def project(self, points: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(…,3) camera-frame points → pixels (…,2) as (u, v), and depth z (…).

        A point with z ≤ 0 is not in front of the camera: its pixel is NaN.
        """
        points = np.asarray(points, np.float64)
        z = points[..., 2]
        safe = np.where(z > 0, z, np.nan)
        u = self.K[0, 0] * points[..., 0] / safe + self.K[0, 2]
        v = self.K[1, 1] * points[..., 1] / safe + self.K[1, 2]
        return np.stack([u, v], axis=-1), z

    def unproject(self, pixels: NDArray, z: NDArray) -> NDArray[np.float64]:
        """Pixels (…,2) as (u, v) at depth z (…) → (…,3) points in the camera frame."""
        pixels, z = np.asarray(pixels, np.float64), np.asarray(z, np.float64)
        x = (pixels[..., 0] - self.K[0, 2]) / self.K[0, 0] * z
        y = (pixels[..., 1] - self.K[1, 2]) / self.K[1, 1] * z
        return np.stack([x, y, z], axis=-1)

    def pixel_centres(self) -> NDArray[np.float64]:
        """(H,W,2) float64 (u, v) of every pixel's centre."""
        u, v = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        return np.stack([u, v], axis=-1)

    def unproject_depth(self, depth: NDArray) -> NDArray[np.float64]:
        """A depth image (H,W), 0 = no surface → (n,3) camera-frame points in row-major order."""
        if depth.shape != (self.height, self.width):
            raise ValueError(
                f"depth image is {depth.shape}, expected {(self.height, self.width)} "
                f"(rows, columns)"
            )
        rows, columns = np.nonzero(depth > 0)
        pixels = np.stack([columns + 0.5, rows + 0.5], axis=-1)
        return self.unproject(pixels, depth[rows, columns])


def fit_ball(
    centre: ArrayLike, resolution: int, radius: float = 1.0, height: int | None = None
) -> Camera:
    """The crop of an ideal pinhole whose image the ball's projection just fills.

    The bounding box of the ball's outline (an ellipse off the axis) is centred in the image and
    touches the border in its larger direction; pixels are square. Nothing of an object inside the
    ball is cut off, and because only the intrinsics change, what is visible depends on the camera's
    position alone.

    Args:
        centre: (3,) ball centre in the camera frame; its z must exceed the radius.
        resolution: image width in pixels (and height, unless given).
        radius: the ball's radius.
    """
    x, y, z = (float(c) for c in np.asarray(centre, np.float64))
    if not z > radius:
        raise ValueError(
            f"the ball (centre z {z:g}, radius {radius:g}) reaches behind the camera plane; "
            f"z must be greater than the radius"
        )
    rows = resolution if height is None else height
    # A vertical plane x = u·z touches the ball where (x − u·z)² = r²(1 + u²): two roots in u.
    bounds = []
    for c in (x, y):
        spread = radius * np.sqrt(c * c + z * z - radius * radius)
        scale = z * z - radius * radius
        bounds.append(((c * z - spread) / scale, (c * z + spread) / scale))
    (u0, u1), (v0, v1) = bounds
    focal_px = min(resolution / (u1 - u0), rows / (v1 - v0))
    cx = resolution / 2 - focal_px * (u0 + u1) / 2
    cy = rows / 2 - focal_px * (v0 + v1) / 2
    return Camera(np.array([[focal_px, 0, cx], [0, focal_px, cy], [0, 0, 1.0]]), resolution, rows)


def sample_pose(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """One object → camera pose as the paper draws it: (R (3,3), t (3,)) float64.

    R is uniform on SO(3); t_x, t_y ~ U(−2, 2), t_z ~ U(2, 5) (paper, section 5.1). A draw whose
    unit ball would reach the camera plane cannot occur: t_z ≥ 2.
    """
    return haar_rotations(rng, 1)[0], rng.uniform(TRANSLATION_LOW, TRANSLATION_HIGH)


def look_at(
    eye: ArrayLike, target: ArrayLike = (0.0, 0.0, 0.0), up: ArrayLike = (0.0, 0.0, 1.0)
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The pose of an object seen by a camera at ``eye`` that looks at ``target``, upright.

    Args:
        eye: (3,) where the camera is, in the object's frame.
        target: (3,) what it looks at, in the same.
        up: (3,), what the picture has upwards (its −y), in the object's frame.

    Returns:
        (R_camera_object (3,3), t_camera_object (3,)) float64: p_camera = R·p_object + t. The target
        is on the optical axis, at (0, 0, distance).

    Raises:
        InputError: not three finite numbers each, eye and target at one place, or ``up`` along the
            line of sight.

    >>> R, t = look_at(eye=(3, 0, 0))
    >>> t.tolist()
    [0.0, 0.0, 3.0]
    >>> (R @ (0, 0, 1)).tolist()  # the object's z appears upwards
    [0.0, -1.0, 0.0]
    """
    given = {"eye": eye, "target": target, "up": up}
    vectors = {}
    for name, value in given.items():
        try:
            vectors[name] = np.asarray(value)
        except (TypeError, ValueError, RuntimeError):  # ragged lists, tensors with a gradient
            vectors[name] = np.zeros(0)
        if vectors[name].dtype.kind in "fiu":  # of texts NumPy makes numbers, of complex ones half
            vectors[name] = vectors[name].astype(np.float64)
        else:
            vectors[name] = np.zeros(0)
        if vectors[name].shape != (3,) or not np.isfinite(vectors[name]).all():
            raise InputError(f"look_at: {name} must be three finite numbers, got {value!r}")
    forward = vectors["target"] - vectors["eye"]
    distance = np.linalg.norm(forward)
    if distance == 0:
        raise InputError(f"look_at: eye and target are both at {vectors['eye'].tolist()}")
    forward /= distance
    right = np.cross(forward, vectors["up"])
    length = np.linalg.norm(right)
    if length <= 1e-9 * np.linalg.norm(vectors["up"]) or length == 0:
        raise InputError(
            f"look_at: up {vectors['up'].tolist()} lies along the line of sight; give another up"
        )
    right /= length
    # Without this a pose along an axis has entries of −0.
    R = np.stack([right, np.cross(forward, right), forward]) + 0.0
    return R, -R @ vectors["eye"] + 0.0
