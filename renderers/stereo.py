"""Active stereo, physically: a projected dot pattern, two rendered cameras, and matching.

The rig looks at the object. Its left camera is where the view's camera is, so every pixel of the
view has its ray in the rig's image too. Mitsuba traces the rays; what they meet is lit by the
projector and by even ambient light, and sends it back as matt things do; behind the object stands a
wall. The images get shot and read noise and eight bits. OpenCV's semi-global matching makes the
disparity, checked from left to right and freed of speckles.

Errors are not drawn but arise: the quadratic growth with distance, the bias towards whole
disparities, fattened and eroded edges, holes where light does not reach or comes back too weak.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from partialbench.dataset.seeding import generator
from partialbench.errors import InputError
from partialbench.geometry import portable
from partialbench.geometry.camera import Camera

Part = tuple[NDArray[np.float32], NDArray[np.uint32]]
"""Vertices (V,3) in the view's camera frame, object units, and faces (F,3)."""
Painted = tuple[tuple[NDArray, NDArray], float]
"""Vertices and faces, and the share of light that they send back."""

_PATTERN_SIDE = 2048
_FULL_SCALE = 255.0
ALBEDO = (0.15, 0.7)
"""Between which the share of light that an object sends back is drawn."""
DARK_ALBEDO = (0.02, 0.06)
"""The same of its dark part."""
NEAREST_RADII = 1.25
"""From the camera to the object's centre, at least: nearer, its image and the disparities to look
for grow without bound."""
WALL_RADII = 1.6
"""Of the wall behind the object, from its centre. A capture is cropped to what lies before it."""


@dataclass(frozen=True)
class Stereo:
    """An active stereo camera.

    Attributes:
        name: as ``sensors`` knows it.
        baseline_m: between the two cameras, the second to the right.
        projector_m: of the projector, from the first camera to the right.
        focal_px: of the camera's own image; an object is seen with as many pixels as it would have.
        disparity_step: in pixels; OpenCV's own is 1/16.
        dot_every_px: mean distance of neighbouring dots, in pixels of the camera.
        block: side of the matching window in pixels, odd.
        ambient: even light, as a share of what the pattern gives in the mean.
        dark: expected share of an object's extent, from a random side on, that is dark.
        read_noise, full_well: of a pixel, in grey values and in electrons at full scale.
        strength, metres_per_unit: see ``sensors``. Strength multiplies read noise and divides the
            focal length and the full well: σ of the depth is then in proportion.
        uniqueness, speckle_px: by how many percent the best match must beat the second; the
            smallest patch of like disparity that is kept.
    """

    name: str
    baseline_m: float
    projector_m: float
    focal_px: float
    disparity_step: float = 1 / 16
    dot_every_px: float = 4.0
    block: int = 9
    ambient: float = 0.15
    dark: float = 0.15
    read_noise: float = 1.0
    full_well: float = 5000.0
    strength: float = 1.0
    metres_per_unit: float = 0.5
    uniqueness: int = 10
    speckle_px: int = 60

    def __post_init__(self) -> None:
        for name in ("strength", "metres_per_unit", "baseline_m", "focal_px", "disparity_step"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"{name} must be a finite number > 0, got {value!r}")
        if self.block < 1 or self.block % 2 == 0:
            raise InputError(f"block must be an odd number of pixels, got {self.block!r}")

    @property
    def focal(self) -> float:
        """Focal length in pixels at this strength."""
        return self.focal_px / self.strength

    def describe(self) -> dict[str, Any]:
        """As ``Sensor.describe``."""
        return asdict(self)

    def apply(self, depth: NDArray, K: ArrayLike, rng: np.random.Generator) -> NDArray[np.float32]:
        """Refused: what a depth image shows cannot be lit from another place."""
        raise InputError(
            f"the sensor {self.name!r} renders its own images of meshes; it cannot be put behind a "
            f"depth image. Use kinect-v1 or tof here"
        )

    def capture(
        self, parts: Sequence[Part], depth: NDArray, K: NDArray, centre: NDArray,
        rng: np.random.Generator,
    ) -> NDArray[np.float32]:  # fmt: skip
        """What the camera measures where an exact depth image shows a surface.

        Args:
            parts: meshes of the scene, camera frame, the object's first.
            depth: (H,W) exact z-depth of them, object units, 0 = no surface.
            K: (3,3) of that image. centre: (3,) of the object, camera frame, object units.
            rng: material and noise.

        Returns:
            (H,W) float32 z-depth, 0 where nothing was there or nothing was measured.

        Raises:
            InputError: no OpenCV.
        """
        require_opencv()
        scale = self.metres_per_unit
        rig = _looking_at(np.asarray(centre, np.float64))
        away = float(np.linalg.norm(centre)) * scale
        radius = scale
        camera = self._camera(away, radius)
        near, wall = max(away - radius, 0.1), away + WALL_RADII * radius
        turned = [((v.astype(np.float64) * scale) @ rig.T, f) for v, f in parts]
        albedo = float(rng.uniform(*ALBEDO))
        light, dark = _split(turned[0], float(rng.uniform(0, 2 * self.dark)), rng)
        painted = [(light, albedo), (dark, float(rng.uniform(*DARK_ALBEDO)))]
        painted += [(part, albedo) for part in turned[1:]]
        z, _ = self.measure([p for p in painted if len(p[0][1])], camera, (near, wall), rng)
        z[z > away + WALL_RADII * radius * 0.9] = 0
        return _resampled(z, camera, rig, depth, K, scale)

    def measure(
        self, parts: Sequence[Painted], camera: Camera, span: tuple[float, float],
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:  # fmt: skip
        """What the rig measures of meshes before a wall, all in the first camera's frame, metres.

        Args:
            parts: ((vertices, faces), albedo) each.
            camera: what part of the image is looked at; of ``focal`` pixels.
            span: the nearest z looked for, and the wall's.
            rng: noise.

        Returns:
            z (H,W), 0 where nothing is measured, and the first camera's image (H,W).
        """
        left, right, first = self._images(parts, camera, span, rng)
        count = self._range(*span)[1]
        disparity = self._match(left, right, count)
        z = np.zeros(disparity.shape)
        matched = disparity > 0
        z[matched] = self.focal * self.baseline_m / (disparity[matched] + first)
        return z, left[:, count:]

    def _camera(self, away: float, radius: float) -> Camera:
        """Just the part of the camera's image that the object's ball covers, and a margin."""
        half = self.focal * radius / np.sqrt(max(away**2 - radius**2, 1e-4)) + 2 * self.block
        side = 2 * int(np.ceil(half))
        K = np.array([[self.focal, 0, side / 2], [0, self.focal, side / 2], [0, 0, 1.0]])
        return Camera(K, side, side)

    def _range(self, near: float, wall: float) -> tuple[int, int]:
        """The smallest disparity looked for, and how many, a multiple of 16."""
        bend = self.focal * self.baseline_m
        first = max(0, int(bend / wall) - 2)
        return first, 16 * int(np.ceil((bend / near - first + 2) / 16))

    def _images(
        self, parts: Sequence[Painted], camera: Camera, span: tuple[float, float],
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint8], int]:  # fmt: skip
        """Both images, the right one moved by the smallest disparity, which is returned too."""
        from renderers import stereo_light

        first, count = self._range(*span)
        lit = stereo_light.Scene(
            parts, span[1], self.projector_m,
            _middle(_dots(self.dot_every_px), camera.width + 2 * count), self.focal, self.ambient,
        )  # fmt: skip
        pixels = [
            lit.image(camera, 0.0, 0, count, rng),
            lit.image(camera, self.baseline_m, first, count, rng),
        ]
        exposure = 0.5 * _FULL_SCALE / max(float(np.percentile(pixels[0], 95)), 1e-9)
        left, right = (self._recorded(image * exposure, rng) for image in pixels)
        return left, right, first

    def _recorded(self, image: NDArray, rng: np.random.Generator) -> NDArray[np.uint8]:
        """Shot and read noise, eight bits."""
        shot = np.clip(image, 0, None) * _FULL_SCALE / (self.full_well / self.strength)
        sigma = np.sqrt(shot + (self.read_noise * self.strength) ** 2)
        noisy = image + rng.standard_normal(image.shape) * sigma
        return np.clip(np.rint(noisy), 0, _FULL_SCALE).astype(np.uint8)

    def _match(
        self, left: NDArray[np.uint8], right: NDArray[np.uint8], count: int
    ) -> NDArray[np.float64]:
        """(H,W) disparity less the smallest looked for, 0 where none is found.

        Args:
            count: of disparities, by which the images are wider on their left than what is found.
        """
        cv2: Any = importlib.import_module("cv2")  # its stubs lack this class

        area = self.block**2
        matcher = cv2.StereoSGBM_create(
            minDisparity=0, numDisparities=count, blockSize=self.block, P1=4 * area, P2=24 * area,
            disp12MaxDiff=1, preFilterCap=31, uniquenessRatio=self.uniqueness,
            speckleWindowSize=self.speckle_px, speckleRange=1,
            # The other modes share work out by the number of threads.
            mode=cv2.STEREO_SGBM_MODE_SGBM,
        )  # fmt: skip
        found = matcher.compute(left, right)[:, count:].astype(np.float64) / 16
        found = np.where(found > 0, found, 0)
        steps = np.rint(found / self.disparity_step)
        return np.where(found > 0, np.maximum(steps, 1) * self.disparity_step, 0)


def d415(**options: Any) -> Stereo:
    """Like an Intel RealSense D415 at 848×480.

    Horizontal field of view 65° (Grunnet-Jepsen et al., Intel white paper on subpixel linearity,
    2019); 55 mm is commonly given for its baseline. The projector's place between the cameras and
    the density of dots are our choice.
    """
    return Stereo("stereo-d415", 0.055, 0.0275, 424 / np.tan(np.deg2rad(32.5)), **options)


def kinect_v1(**options: Any) -> Stereo:
    """With the first Kinect's geometry: 75 mm, 585 px, disparity in steps of 1/8 pixel.

    That camera matches its one image with a stored one of the pattern (Khoshelham and Oude Elberink
    2012); here a second camera stands in for it, at the projector's place. The density of dots is
    our choice; docs/sensors.md says where the figures are from.
    """
    given = {"disparity_step": 0.125, "dot_every_px": 3.0, **options}
    return Stereo("stereo-kinect-v1", 0.075, 0.075, 585.0, **given)


def require_opencv() -> None:
    """Raises ``InputError`` that says what to install where OpenCV is missing."""
    try:
        import cv2  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"a stereo sensor matches its images by OpenCV, which does not import here ({error}); "
            f"pip install 'partialbench[stereo]'"
        ) from error


@functools.lru_cache(maxsize=2)
def _dots(every_px: float) -> NDArray[np.float32]:
    """(N,N) a device's pattern, a pixel of it as wide as one of its camera: the same every time."""
    rng = generator(0, "dot pattern")
    dots = (rng.random((_PATTERN_SIDE, _PATTERN_SIDE), np.float32) < 1 / every_px**2).astype(
        np.float32
    )
    # A dot is about two pixels wide: narrower ones leave less to find the subpixel by.
    for axis in (0, 1, 0, 1):
        dots = 0.25 * np.roll(dots, 1, axis) + 0.5 * dots + 0.25 * np.roll(dots, -1, axis)
    return dots


def _middle(pattern: NDArray[np.float32], side: int) -> NDArray[np.float32]:
    """The part of a pattern about its centre that is looked at, the pattern repeated if need be."""
    across = (np.arange(-side // 2, side // 2) + len(pattern) // 2) % len(pattern)
    return np.ascontiguousarray(pattern[np.ix_(across, across)])


def _split(
    part: tuple[NDArray, NDArray], share: float, rng: np.random.Generator
) -> tuple[tuple[NDArray, NDArray], tuple[NDArray, NDArray]]:
    """A mesh without its faces beyond a share of its extent in a random direction, and those."""
    vertices, faces = part
    direction = rng.standard_normal(3)
    along = portable.product(vertices, direction[:, None])[:, 0]
    edge = along.max() - share * (along.max() - along.min())
    beyond = along[faces].mean(axis=1) > edge
    return (vertices, faces[~beyond]), (vertices, faces[beyond])


def _looking_at(centre: NDArray) -> NDArray[np.float64]:
    """(3,3) from the view's camera to a rig whose z goes through a point; x stays level."""
    z = centre / np.linalg.norm(centre)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def _resampled(
    z: NDArray, camera: Camera, rig: NDArray, depth: NDArray, K: NDArray, scale: float
) -> NDArray[np.float32]:
    """The rig's z in metres at each of a view's pixels with a surface, as the view's z-depth."""
    rows, columns = np.nonzero(depth)
    rays = np.stack(
        [
            (columns + 0.5 - K[0, 2]) / K[0, 0],
            (rows + 0.5 - K[1, 2]) / K[1, 1],
            np.ones(len(rows)),
        ],
        axis=1,
    )
    turned = rays @ rig.T
    uv, _ = camera.project(turned)
    # A fixed camera may show what lies outside the object's ball; the rig does not.
    u, v = uv.T
    inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    at = np.floor(np.where(inside[:, None], uv, 0)).astype(int)
    found = np.where(inside, z[at[:, 1], at[:, 0]], 0)
    measured = np.zeros(depth.shape, np.float32)
    measured[rows, columns] = found / turned[:, 2] / scale
    return measured
