"""Mesh → what a pinhole camera sees of it, by Mitsuba's ray tracing (see ``tracing``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from partialbench.dataset.others import POOL, Others, require_share
from partialbench.dataset.sources import RejectedView, View
from partialbench.errors import InputError
from partialbench.geometry.camera import Camera, fit_ball
from renderers import occlusion
from renderers.normals import face_normals, towards_camera
from renderers.sensors import make_sensor
from renderers.stereo import NEAREST_RADII, Stereo, require_opencv
from renderers.tracing import Tracer, make_tracer
from renderers.variants import activate, pick_variant
from renderers.visibility import inside_image, sight_lines, surface_samples

DEFAULT_RESOLUTION = 256
MOST_PIXELS = 2**28
"""Of one image: Mitsuba's arrays end at 2³² numbers, and a ray has more than one."""

NOTHING_SEEN = "no surface at any pixel centre"
NOTHING_MEASURED = "the sensor measures nothing of the surface in view: out of its range, or lost"
TOO_NEAR = f"nearer than {NEAREST_RADII:g} units, where a stereo sensor sees nothing"

Pose = tuple[NDArray, NDArray]


@dataclass
class MitsubaOccluder:
    """Depth rendering of a mesh from given viewpoints, and the points it shows.

    Picklable; Mitsuba is set up in whichever process first asks for views. Processes that are to
    use it must be spawned, not forked from one that already did: its threads do not survive a fork.

    Attributes:
        resolution: image width and height in pixels, of a camera fitted to the unit ball per view;
            a ``camera`` has its own, and another resolution beside it is refused.
        variant: a Mitsuba variant, or "auto" for the fastest that works. The first use settles it:
            a copy sent to another process afterwards uses the same variant, or fails there.
        keep_depth: whether a view keeps its depth image.
        normals: whether a view has the normals of the faces behind its points. A sensor moves the
            points, not the normals: each is that of the surface at its pixel.
        visibility_samples: surface points behind ``visible_fraction``.
        camera: one to use for every view instead of the fitted one; it may cut the object.
        occluders: share of the object's pixels that other objects hide, in the mean; see
            ``occlusion``. Of what is measured only the object's own pixels are kept.
        sensor: "ideal", or what distorts the depth before it is back-projected: a name of
            ``renderers.sensors`` with an optional strength ("kinect-v1", "tof:0.5").
        threads: of this process. One each is fastest when objects are spread over processes; the
            result does not depend on it.
    """

    resolution: int = DEFAULT_RESOLUTION
    variant: str = "auto"
    keep_depth: bool = False
    visibility_samples: int = 2048
    camera: Camera | None = None
    sensor: str = "ideal"
    threads: int = 1
    normals: bool = False
    occluders: float = 0.0

    def __post_init__(self) -> None:
        for name in ("resolution", "visibility_samples", "threads"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
                raise InputError(f"{name} must be a whole number of at least 1, got {value!r}")
        if self.resolution**2 > MOST_PIXELS:
            raise InputError(
                f"resolution must be at most {int(MOST_PIXELS**0.5)}, got {self.resolution}"
            )
        if self.camera is not None and not isinstance(self.camera, Camera):
            raise InputError(f"camera must be a geometry.camera.Camera, got {self.camera!r}")
        if self.camera is not None and self.camera.width * self.camera.height > MOST_PIXELS:
            raise InputError(
                f"an image may have {MOST_PIXELS} pixels at most, the camera's has "
                f"{self.camera.width}×{self.camera.height}"
            )
        if self.camera is not None and self.resolution != DEFAULT_RESOLUTION:
            raise InputError(
                f"resolution={self.resolution} would have no effect: the camera has its own image, "
                f"{self.camera.width}×{self.camera.height} pixels; give one of them"
            )
        require_share(self.occluders)
        if isinstance(make_sensor(self.sensor), Stereo):  # raises for an unknown name or strength
            require_opencv()

    def settle(self) -> str:
        """The Mitsuba variant in use; ``InputError`` when the one asked for does not work here."""
        self.variant = pick_variant(self.variant)
        if self.variant.startswith("scalar") and isinstance(make_sensor(self.sensor), Stereo):
            raise InputError(
                f"the sensor {self.sensor!r} renders images, for which the Mitsuba variant "
                f"{self.variant} is too slow; it needs llvm_ad_rgb or cuda_ad_rgb "
                f"('partialbench doctor' says what those need)"
            )
        return self.variant

    def describe(self) -> dict[str, Any]:
        """What defines the views, as JSON data."""
        camera = None if self.camera is None else {
            "K": self.camera.K.tolist(), "width": self.camera.width, "height": self.camera.height,
        }  # fmt: skip
        return {
            "name": "mitsuba",
            "variant": self.settle(),
            "resolution": int(self.resolution) if self.camera is None else None,
            "camera": camera,
            "sensor": make_sensor(self.sensor).describe(),
            "visibility_samples": int(self.visibility_samples),
            "keep_depth": bool(self.keep_depth),
            **({"normals": "of the mesh's faces"} if self.normals else {}),
            **({"occluders": float(self.occluders), "pool": POOL} if self.occluders else {}),
        }

    def views(
        self,
        shape: trimesh.Trimesh,
        poses: list[Pose],
        rngs: list[np.random.Generator],
        others: Others | None = None,
    ) -> list[View | RejectedView]:
        """Render a mesh from every pose.

        Args:
            shape: in the object frame, inside the unit ball around the origin. Vertices are used
                as float32.
            poses: (R_camera_object (3,3), t_camera_object (3,)) each.
            rngs: one per view, for the sensor's noise; an ideal one draws nothing.
            others: what stands before the object, meshes in the unit ball, if ``occluders``.

        Returns:
            One ``View`` per pose, its points in row-major pixel order; a ``RejectedView`` where no
            pixel centre meets the surface (a flat shape seen edge-on, or outside a fixed camera),
            or the sensor measures nothing of it.

        Raises:
            InputError: when the mesh or one of the others has no area, or leaves the unit ball.
        """
        vertices, faces = _arrays(shape)
        try:
            samples = surface_samples(vertices, faces, self.visibility_samples)
        except ValueError as error:
            raise InputError(f"the mesh cannot be rendered: {error}") from error
        if not poses:
            return []
        R = np.stack([np.asarray(r, np.float64) for r, _ in poses])
        t = np.stack([np.asarray(x, np.float64) for _, x in poses])
        cameras = [self.camera or fit_ball(centre, self.resolution) for centre in t]

        variant = self.settle()
        activate(variant, self.threads)
        tracer = make_tracer(variant, vertices, faces)
        meshes: list[tuple[NDArray[np.float32], NDArray[np.uint32]]] = []
        if self.occluders:
            if others is None or not others.shapes:
                raise InputError(
                    f"occluders={self.occluders:g} needs others to put before an object"
                )
            meshes = [_arrays(other) for other in others.shapes]
        pool = [make_tracer(variant, *mesh) for mesh in meshes]
        seen = self._seen(tracer, samples, R, t, cameras)
        images = tracer.images(R, t, cameras, self.normals)
        normals = face_normals(vertices, faces) if self.normals else None
        sensor = None if self.sensor == "ideal" else make_sensor(self.sensor)
        views: list[View | RejectedView] = []
        for k, (depth, hit) in enumerate(images):
            hidden, before = None, []
            if pool and others is not None and depth.any():
                pixels = occlusion.Pixels(depth, cameras[k])
                if self.camera is not None and pixels.count < occlusion.FEW_PIXELS:
                    # A fixed camera may show the object as small as it likes.
                    pixels = occlusion.Pixels(*occlusion.cropped(depth, cameras[k]))
                arranged = occlusion.arrange(pixels, t[k], self.occluders, pool, others.rngs[k])
                if arranged is None:
                    views.append(RejectedView(occlusion.NO_ROOM))
                    continue
                before, shown = arranged, depth
                depth, own = occlusion.composite(before, pool, shown, cameras[k])
                hidden = 1 - float(own.sum()) / float((shown > 0).sum())
                if not own.any():
                    views.append(RejectedView(occlusion.ALL_HIDDEN))
                    continue
                lines = sight_lines(samples, -R[k].T @ t[k])
                seen[k] &= occlusion.unhidden(before, pool, R[k], *lines)
            if isinstance(sensor, Stereo) and np.linalg.norm(t[k]) < NEAREST_RADII:
                views.append(RejectedView(TOO_NEAR, {"units": float(np.linalg.norm(t[k]))}))
                continue
            exact = depth
            if isinstance(sensor, Stereo):
                parts = [((vertices @ R[k].T + t[k]).astype(np.float32), faces)]
                parts += [occlusion.placed(each, *meshes[each.shape]) for each in before]
                depth = sensor.capture(parts, depth, cameras[k].K, t[k], rngs[k])
            elif sensor:
                depth = sensor.apply(depth, cameras[k].K, rngs[k])
            if hidden is not None:
                depth, exact = np.where(own, depth, np.float32(0)), np.where(own, exact, 0)
            if not depth.any() and exact.any():
                views.append(RejectedView(NOTHING_MEASURED, _depths(self.sensor, exact)))
                continue
            view = self._view(depth, R[k], t[k], cameras[k], float(seen[k].mean()))
            if isinstance(view, View):
                view.occluded_fraction = hidden
            if isinstance(view, View) and hit is not None and normals is not None:
                # The pixels with depth, in the order of the points.
                facing = normals.take(hit[depth != 0], axis=0)
                view.normals = towards_camera(facing, view.points, R[k])
            views.append(view)
        return views

    def _view(
        self, depth: NDArray[np.float32], R: NDArray, t: NDArray, camera: Camera, fraction: float
    ) -> View | RejectedView:
        points = back_project(depth, camera)
        if not len(points):
            return RejectedView(NOTHING_SEEN, {"width": camera.width, "height": camera.height})
        return View(
            points=points,
            R_camera_object=R,
            t_camera_object=t,
            K=camera.K,
            visible_fraction=fraction,
            n_visible=len(points),
            depth=depth if self.keep_depth else None,
        )

    def _seen(
        self,
        tracer: Tracer,
        samples: NDArray[np.float32],
        R: NDArray,
        t: NDArray,
        cameras: list[Camera],
    ) -> NDArray[np.bool_]:
        """(V,S): which of the surface samples each view sees, inside its image."""
        eyes = -np.einsum("vji,vj->vi", R, t)
        lines = [sight_lines(samples, eye) for eye in eyes]
        seen = tracer.clear(eyes, np.stack([d for d, _ in lines]), np.stack([e for _, e in lines]))
        if self.camera is not None:
            for k, camera in enumerate(cameras):
                seen[k] &= inside_image(
                    samples @ R[k].T + t[k], camera.K, camera.width, camera.height
                )
        return seen


def back_project(depth: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
    """Every surface pixel of a depth image as a camera-frame point: (n,3) float32, row-major.

    The same numbers as ``Camera.unproject_depth`` to float32; in it, because this runs on every
    pixel of a data set.
    """
    flat = depth.reshape(-1)
    index = np.flatnonzero(flat)
    rows, columns = np.divmod(index, camera.width)
    z = flat[index]
    x_slope = ((np.arange(camera.width) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]).astype(np.float32)
    y_slope = ((np.arange(camera.height) + 0.5 - camera.K[1, 2]) / camera.K[1, 1]).astype(
        np.float32
    )
    points = np.empty((len(z), 3), np.float32)
    np.multiply(x_slope[columns], z, out=points[:, 0])
    np.multiply(y_slope[rows], z, out=points[:, 1])
    points[:, 2] = z
    return points


def _depths(sensor: str, depth: NDArray) -> dict[str, Any]:
    """Between which depths a sensor measured nothing of an image, object units."""
    there = depth[depth > 0]
    return {"sensor": sensor, "from": float(there.min()), "to": float(there.max())}


def _arrays(shape: trimesh.Trimesh) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Vertices (V,3) float32 and faces (F,3) uint32, checked as a renderer needs them."""
    if not isinstance(shape, trimesh.Trimesh):
        raise InputError(f"expected a trimesh.Trimesh, got {type(shape).__name__}")
    vertices = np.ascontiguousarray(shape.vertices, np.float32)
    faces = np.ascontiguousarray(shape.faces)
    if not len(faces):
        raise InputError("the mesh has no faces")
    if not np.isfinite(vertices).all():
        raise InputError("the mesh has vertices that are NaN or infinite")
    low, high = int(faces.min()), int(faces.max())
    if low < 0 or high >= len(vertices):
        raise InputError(
            f"a face names vertex {low if low < 0 else high}; the mesh's vertices are 0 to "
            f"{len(vertices) - 1}"
        )
    _require_unit_ball(vertices)
    return vertices, faces.astype(np.uint32)


def _require_unit_ball(vertices: NDArray[np.float32]) -> None:
    # Not for the fitted camera alone: what is hidden, where obstacles have room and how many metres
    # an object is long all go by this size.
    radius = float(np.sqrt(np.einsum("ij,ij->i", vertices, vertices).max()))
    if radius > 1 + 1e-5:
        raise InputError(
            f"the mesh reaches {radius:g} from the origin; expected is one inside the unit ball: "
            f"pass it through renderers.sources.mesh.normalise, and divide poses by its scale"
        )
