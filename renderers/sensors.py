"""Depth sensors: from the exact depth image to what a real camera would have measured.

A sensor works on z-depth images before back-projection: 0 means no surface, and no sensor makes
depth where there was none. Its physics is in metres and in angles: ``metres_per_unit`` gives the
scale of the object's unit, and a sensor's own pixel is converted by the focal lengths, because a
view is a crop whose pixel is not the sensor's.

``strength`` multiplies every standard deviation, quantisation step, probability and baseline: 1 is
the sensor as published.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from partialbench.errors import InputError
from partialbench.registry import close_matches
from renderers.depth_images import (
    EDGE_SHARE,
    displaced,
    edges,
    incidence_angle,
    over_neighbours,
    projector_shadow,
)

METRES_PER_UNIT = 0.5
"""An object that fills the unit ball is then about a metre across, seen from 1 to 2.5 m: a chair in
a room. The nearest depth (1 unit) is the sensors' nearest, 0.5 m."""

STRENGTHS = (0.5, 1.0, 2.0)
"""The strengths that benchmarks compare: mild, as published, strong."""

MAX_INCIDENCE = np.deg2rad(85)
"""Angles are held below this in the noise models, which have a pole at 90° (measured up to 70°)."""


class Sensor(Protocol):
    """What every sensor offers."""

    def apply(self, depth: NDArray, K: ArrayLike, rng: np.random.Generator) -> NDArray[np.float32]:
        """Measure depth images.

        Args:
            depth: (H,W) or (V,H,W), z-depth in object units, 0 = no surface.
            K: (3,3), or (V,3,3) for as many images, pixel intrinsics.
            rng: every random draw; the images of a stack are drawn one after the other.

        Returns:
            float32 of the same shape; 0 where nothing was there or nothing was measured.

        Raises:
            InputError: shapes that do not fit, negative or non-finite depth.
        """
        ...

    def describe(self) -> dict[str, Any]:
        """Name and parameters as JSON data, for the configuration."""
        ...


@dataclass(frozen=True)
class Ideal:
    """Measures the depth image as it is."""

    def apply(self, depth: NDArray, K: ArrayLike, rng: np.random.Generator) -> NDArray[np.float32]:
        """As ``Sensor.apply``."""
        return _per_image(depth, K, lambda image, _: image)

    def describe(self) -> dict[str, Any]:
        """As ``Sensor.describe``."""
        return {"name": "ideal"}


@dataclass(frozen=True)
class KinectV1:
    """A structured-light camera like the first Kinect.

    In this order: range limits, the projector's occlusion shadow, lateral noise, axial noise,
    quantised disparity, dropout at depth edges.

    Attributes:
        strength, metres_per_unit: see the module.
        nearest_m, farthest_m: operating range (Khoshelham and Elberink 2012).
        baseline_m: projector to the camera's right; a surface it does not reach gives no depth.
        focal_px: of the sensor's own image, whose pixel is 1/focal_px wide at unit depth.
        inverse_depth_step: spacing of measurable 1/z in 1/m. Khoshelham and Elberink 2012 calibrate
            it as 2.85·10⁻⁵/cm; it is the 1/8 pixel of disparity, 1/(8·focal·baseline), that Barron
            and Malik 2013 and Handa et al. 2014 use (their 35130 cm is its inverse).
        lateral_px: the constant in the σ across the ray, see below.
        edge_m: a step between neighbouring pixels larger than this, 5 % of z at least, is an edge.
        edge_dropout: probability that a pixel at an edge gives no depth. The publications show the
            effect without a number: this one is our choice.

    Noise is Gaussian with the fits of Nguyen, Izadi and Lovell 2012, θ between normal and ray:
    across the ray 0.8 + 0.035·θ/(π/2 − θ) in the sensor's pixels, each way; along z, in metres,
    0.0012 + 0.0019(z − 0.4)² + 0.0001/√z · θ²/(π/2 − θ)², the last term from 10° on. They measured
    quantised depth, so the variance of the quantisation is taken off before drawing. They measured
    the noise across the ray at the outline of a target and the noise along z inside it, slanted:
    displacement frays outlines and leaves the depth of a slanted surface to the second fit.
    """

    strength: float = 1.0
    metres_per_unit: float = METRES_PER_UNIT
    nearest_m: float = 0.5
    farthest_m: float = 5.0
    baseline_m: float = 0.075
    focal_px: float = 585.0
    inverse_depth_step: float = 2.85e-3
    lateral_px: float = 0.8
    edge_m: float = 0.03
    edge_dropout: float = 0.3

    def __post_init__(self) -> None:
        _require_positive(strength=self.strength, metres_per_unit=self.metres_per_unit)

    def axial_sigma(self, z: NDArray, incidence: NDArray | float) -> NDArray[np.float64]:
        """σ of measured depth in metres at depth z (metres) and angle of incidence (radians)."""
        tilt = np.minimum(incidence, MAX_INCIDENCE)
        grazing = 1e-4 / np.sqrt(z) * (tilt / (np.pi / 2 - tilt)) ** 2
        sigma = 0.0012 + 0.0019 * (z - 0.4) ** 2 + np.where(tilt < np.deg2rad(10), 0.0, grazing)
        return self.strength * sigma

    def lateral_sigma(self, incidence: NDArray | float) -> NDArray[np.float64]:
        """σ across the ray in the sensor's pixels at an angle of incidence (radians)."""
        tilt = np.minimum(incidence, MAX_INCIDENCE)
        return self.strength * (self.lateral_px + 0.035 * tilt / (np.pi / 2 - tilt))

    def apply(self, depth: NDArray, K: ArrayLike, rng: np.random.Generator) -> NDArray[np.float32]:
        """As ``Sensor.apply``."""
        return _per_image(depth, K, lambda image, k: self._measure(image, k, rng))

    def _measure(self, depth: NDArray, K: NDArray, rng: np.random.Generator) -> NDArray:
        z = _in_range(depth * self.metres_per_unit, self.nearest_m, self.farthest_m)
        incidence = incidence_angle(z, K)
        at_edge = edges(z, self.edge_m)
        lit = np.where(projector_shadow(z, K, self.strength * self.baseline_m), 0, z)
        scale = np.array([K[1, 1], K[0, 0]])[:, None, None] / self.focal_px
        shift = rng.standard_normal((2, *z.shape)) * self.lateral_sigma(incidence) * scale
        seen = displaced(lit, shift, self.edge_m)
        there = (lit > 0) & (seen > 0)
        step = self.strength * self.inverse_depth_step
        safe = np.where(there, seen, 1.0)
        variance = self.axial_sigma(safe, incidence) ** 2 - (step * safe**2) ** 2 / 12
        noisy = safe + rng.standard_normal(z.shape) * np.sqrt(np.maximum(variance, 0))
        levels = np.maximum(np.rint(1 / (np.maximum(noisy, self.nearest_m / 2) * step)), 1)
        dropped = at_edge & (rng.random(z.shape) < self.strength * self.edge_dropout)
        return np.where(there & ~dropped, 1 / (levels * step), 0) / self.metres_per_unit

    def describe(self) -> dict[str, Any]:
        """As ``Sensor.describe``."""
        return {"name": "kinect-v1", **asdict(self)}


@dataclass(frozen=True)
class TimeOfFlight:
    """A time-of-flight camera like the second Kinect.

    In this order: range limits, lateral noise, flying pixels at edges, multipath, axial noise.

    Attributes:
        strength, metres_per_unit: see the module.
        nearest_m, farthest_m: operating range of the second Kinect.
        lateral_m: σ across the ray, each way, at every depth (Fankhauser et al. 2015, indoors).
        edge_m: a step between neighbouring pixels larger than this, 5 % of z at least, is an edge.
        flying_probability: that a pixel at an edge mixes the near and the far surface: its depth is
            then uniform between them. The effect is described by Foix, Alenyà and Torras 2011; the
            number is our choice. An edge to empty space mixes nothing: there is no far return.
        multipath: how much farther concave places appear, 0 (off) by default: depth grows by
            multipath · max(0, mean depth of the 3×3 neighbours − depth). It stands for light that
            takes a longer way and is our own first-order form.

    Lateral noise frays outlines; the depth of a slanted surface is left to the axial fit, which was
    measured there. It is Gaussian, the indoor fit of Fankhauser et al. 2015, in millimetres with z
    in metres and θ between normal and ray: 1.5 − 0.5z + 0.3z² + 0.1·z^(3/2)·θ²/(π/2 − θ)². The last
    term is the amplitude that falls with the angle.
    """

    strength: float = 1.0
    metres_per_unit: float = METRES_PER_UNIT
    nearest_m: float = 0.5
    farthest_m: float = 4.5
    lateral_m: float = 0.0016
    edge_m: float = 0.03
    flying_probability: float = 0.5
    multipath: float = 0.0

    def __post_init__(self) -> None:
        _require_positive(strength=self.strength, metres_per_unit=self.metres_per_unit)
        if not 0 <= self.multipath <= 1:
            raise InputError(f"multipath must be between 0 and 1, got {self.multipath!r}")

    def axial_sigma(self, z: NDArray, incidence: NDArray | float) -> NDArray[np.float64]:
        """σ of measured depth in metres at depth z (metres) and angle of incidence (radians)."""
        tilt = np.minimum(incidence, MAX_INCIDENCE)
        grazing = 0.1 * z**1.5 * (tilt / (np.pi / 2 - tilt)) ** 2
        return self.strength * 1e-3 * (1.5 - 0.5 * z + 0.3 * z**2 + grazing)

    def apply(self, depth: NDArray, K: ArrayLike, rng: np.random.Generator) -> NDArray[np.float32]:
        """As ``Sensor.apply``."""
        return _per_image(depth, K, lambda image, k: self._measure(image, k, rng))

    def _measure(self, depth: NDArray, K: NDArray, rng: np.random.Generator) -> NDArray:
        z = _in_range(depth * self.metres_per_unit, self.nearest_m, self.farthest_m)
        incidence = incidence_angle(z, K)
        safe = np.where(z > 0, z, 1.0)
        sigma_px = self.strength * self.lateral_m * np.stack([K[1, 1] / safe, K[0, 0] / safe])
        seen = displaced(z, rng.standard_normal(sigma_px.shape) * sigma_px, self.edge_m)
        there = (z > 0) & (seen > 0)
        far = over_neighbours(z, np.max, 0)
        near = np.minimum(over_neighbours(np.where(z > 0, z, np.inf), np.min, np.inf), far)
        between = (z > 0) & (far - near > np.maximum(self.edge_m, EDGE_SHARE * safe))
        flies = between & (rng.random(z.shape) < self.strength * self.flying_probability)
        mix = rng.random(z.shape)
        seen[flies] = near[flies] + mix[flies] * (far - near)[flies]
        if self.multipath:
            valid = over_neighbours(there, np.sum, 0)
            mean = over_neighbours(np.where(there, seen, 0), np.sum, 0) / np.maximum(valid, 1)
            seen = seen + self.strength * self.multipath * np.maximum(mean - seen, 0)
        sigma = self.axial_sigma(np.where(there, seen, 1.0), incidence)
        noisy = seen + rng.standard_normal(z.shape) * sigma
        return np.where(there, np.maximum(noisy, self.nearest_m / 2), 0) / self.metres_per_unit

    def describe(self) -> dict[str, Any]:
        """As ``Sensor.describe``."""
        return {"name": "tof", **asdict(self)}


def _stereo(name: str, **options: Any) -> Sensor:
    from renderers import stereo  # OpenCV and Mitsuba are for those who ask for it

    factories: dict[str, Callable[..., Sensor]] = {
        "stereo-d415": stereo.d415, "stereo-kinect-v1": stereo.kinect_v1,
    }  # fmt: skip
    return factories[name](**options)


SENSORS: dict[str, Callable[..., Sensor]] = {
    "ideal": Ideal,
    "kinect-v1": KinectV1,
    "tof": TimeOfFlight,
    "stereo-d415": functools.partial(_stereo, "stereo-d415"),
    "stereo-kinect-v1": functools.partial(_stereo, "stereo-kinect-v1"),
}
"""Name → factory; options are the factory's attributes."""


def make_sensor(spec: str, **options: Any) -> Sensor:
    """The sensor named by "name" or "name:strength", e.g. "kinect-v1" or "tof:0.5".

    Raises:
        InputError: unknown names (with close matches), a strength that is no positive number or
            that the sensor does not have, unknown options.
    """
    if not isinstance(spec, str):
        raise InputError(f"a sensor is named by a text such as 'tof:0.5', got {spec!r}")
    name, colon, strength = spec.partition(":")
    if name not in SENSORS:
        raise InputError(f"no sensor named {name!r}{close_matches(name, SENSORS)}")
    if colon:
        try:
            options = {**options, "strength": float(strength)}
        except ValueError:
            raise InputError(
                f"{spec!r}: the strength {strength!r} is no number; write e.g. {name}:0.5"
            ) from None
    try:
        return SENSORS[name](**options)
    except TypeError as error:
        raise InputError(f"the sensor {name!r} does not take this: {error}") from error


def _require_positive(**values: float) -> None:
    for name, value in values.items():
        if not (np.isfinite(value) and value > 0):
            raise InputError(f"{name} must be a finite number > 0, got {value!r}")


def _in_range(z: NDArray, nearest_m: float, farthest_m: float) -> NDArray:
    return np.where((z >= nearest_m) & (z <= farthest_m), z, 0.0)


def _per_image(
    depth: NDArray, K: ArrayLike, measure: Callable[[NDArray, NDArray], NDArray]
) -> NDArray[np.float32]:
    """``measure`` on each (H,W) float64 image with its (3,3) intrinsics, checked."""
    depth = np.asarray(depth)
    K = np.asarray(K, np.float64)
    if depth.ndim not in (2, 3):
        raise InputError(f"depth must have the shape (H,W) or (V,H,W), got {depth.shape}")
    if K.shape not in ((3, 3), (*depth.shape[:-2], 3, 3)):
        raise InputError(
            f"K must have the shape (3,3) or one matrix for each image, got {K.shape} for depth of "
            f"shape {depth.shape}"
        )
    if not (np.isfinite(depth).all() and (depth >= 0).all()):
        raise InputError("depth must be finite and ≥ 0, where 0 means no surface")
    images = depth.astype(np.float64).reshape(-1, *depth.shape[-2:])
    matrices = np.broadcast_to(K, (len(images), 3, 3))
    measured = np.zeros(images.shape, np.float32)
    for i, (image, matrix) in enumerate(zip(images, matrices, strict=True)):
        measured[i] = measure(image, matrix)
    return measured.reshape(depth.shape)
