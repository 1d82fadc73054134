"""Mesh → what a pinhole camera sees of it, by Mitsuba's ray tracing.

One acceleration structure in the object frame serves every view of an object; the cameras move
instead. A ray leaves through each pixel's exact centre with a direction whose camera z is 1, so the
distance Mitsuba returns, in units of that direction, is the z-depth itself: no integrator, no film
and no jitter stand between the ray and the number. Faces count from both sides.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh
from numpy.typing import NDArray

from partialbench.dataset.others import POOL, Others
from partialbench.dataset.sources import RejectedView, View
from partialbench.errors import InputError
from partialbench.geometry.camera import Camera, fit_ball
from renderers import occlusion
from renderers.normals import face_normals, towards_camera
from renderers.sensors import make_sensor
from renderers.stereo import Stereo, require_opencv
from renderers.variants import activate, pick_variant
from renderers.visibility import inside_image, sight_lines, surface_samples

# A packet of rays costs what the region it crosses costs: 16 neighbours in a 4×4 tile took two
# thirds of the time of 16 in a row.
TILE = 4
# Bounds the memory of one launch (64 MiB of depth); ten views of 256×256 are a twenty-fifth of it.
MAX_RAYS = 1 << 24
MOST_OCCLUDED = 0.9
NOTHING_SEEN = "no surface at any pixel centre"

Pose = tuple[NDArray, NDArray]
Image = tuple[NDArray[np.float32], NDArray[np.uint32] | None]
"""z-depth (H,W), 0 = no surface, and the index of the face that each pixel shows (0 where none)."""


@dataclass
class MitsubaOccluder:
    """Depth rendering of a mesh from given viewpoints, and the points it shows.

    Picklable; Mitsuba is set up in whichever process first asks for views. Processes that are to
    use it must be spawned, not forked from one that already did: its threads do not survive a fork.

    Attributes:
        resolution: image width and height in pixels, of a camera fitted to the unit ball per view.
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

    resolution: int = 256
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
        if self.camera is not None and not isinstance(self.camera, Camera):
            raise InputError(f"camera must be a geometry.camera.Camera, got {self.camera!r}")
        if not 0 <= self.occluders <= MOST_OCCLUDED:
            raise InputError(
                f"occluders must hide a share of 0 to {MOST_OCCLUDED}, got {self.occluders!r}"
            )
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
            shape: in the object frame, inside the unit ball around the origin unless a ``camera``
                is set. Vertices are used as float32.
            poses: (R_camera_object (3,3), t_camera_object (3,)) each.
            rngs: one per view, for the sensor's noise; an ideal one draws nothing.
            others: what stands before the object, meshes in the unit ball, if ``occluders``.

        Returns:
            One ``View`` per pose, its points in row-major pixel order; a ``RejectedView`` where no
            pixel centre meets the surface (a flat shape seen edge-on, or outside a fixed camera).

        Raises:
            InputError: when the mesh has no area, or leaves the unit ball.
        """
        vertices, faces = _arrays(shape)
        if self.camera is None:
            _require_unit_ball(vertices)
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
        make_tracer = _ScalarTracer if variant.startswith("scalar") else _Tracer
        tracer = make_tracer(vertices, faces)
        meshes: list[tuple[NDArray[np.float32], NDArray[np.uint32]]] = []
        if self.occluders:
            if others is None or not others.shapes:
                raise InputError(
                    f"occluders={self.occluders:g} needs others to put before an object"
                )
            meshes = [_arrays(other) for other in others.shapes]
        pool = [make_tracer(*mesh) for mesh in meshes]
        seen = self._seen(tracer, samples, R, t, cameras)
        images = tracer.images(R, t, cameras, self.normals)
        normals = face_normals(vertices, faces) if self.normals else None
        sensor = None if self.sensor == "ideal" else make_sensor(self.sensor)
        views: list[View | RejectedView] = []
        for k, (depth, hit) in enumerate(images):
            hidden, before = None, []
            if pool and others is not None and depth.any():
                arranged = occlusion.arrange(
                    depth, cameras[k], t[k], self.occluders, pool, others.rngs[k]
                )
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
                seen[k] &= occlusion.unhidden(before, pool, R[k], t[k], *lines)
            if isinstance(sensor, Stereo):
                parts = [((vertices @ R[k].T + t[k]).astype(np.float32), faces)]
                parts += [occlusion.placed(each, *meshes[each.shape]) for each in before]
                depth = sensor.capture(parts, depth, cameras[k].K, t[k], rngs[k])
            elif sensor:
                depth = sensor.apply(depth, cameras[k].K, rngs[k])
            if hidden is not None:
                depth = np.where(own, depth, np.float32(0))
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
        tracer: _Tracer | _ScalarTracer,
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
    return vertices, faces.astype(np.uint32)


def _require_unit_ball(vertices: NDArray[np.float32]) -> None:
    radius = float(np.sqrt(np.einsum("ij,ij->i", vertices, vertices).max()))
    if radius > 1 + 1e-5:
        raise InputError(
            f"the mesh reaches {radius:g} from the origin; the fitted camera needs it inside the "
            f"unit ball: pass it through renderers.sources.mesh.normalise, or set a camera"
        )


def make_scene(vertices: NDArray[np.float32], faces: NDArray[np.uint32]) -> Any:
    """A ``mitsuba.Scene`` of the active variant; Any, as what it returns depends on the variant."""
    mesh = mi.Mesh("object", len(vertices), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = vertices.ravel()
    parameters["faces"] = faces.ravel()
    parameters.update()
    # Embree's robust test leaves no cracks between triangles. It also spares the splitting of
    # triangles: on 20,000 faces the structure is built in a third of the time.
    return mi.load_dict({"type": "scene", "object": mesh, "embree_use_robust_intersections": True})


def _rays(R: NDArray, t: NDArray, cameras: list[Camera]) -> NDArray[np.float32]:
    """(V,12): the map from (u, v, 1) to a view's ray direction in the object frame, and its eye."""
    rows = np.zeros((len(cameras), 12), np.float32)
    for k, camera in enumerate(cameras):
        (fx, _, cx), (_, fy, cy), _ = camera.K
        to_slope = np.array([[1 / fx, 0, -cx / fx], [0, 1 / fy, -cy / fy], [0, 0, 1]])
        rows[k, :9] = (R[k].T @ to_slope).ravel()
        rows[k, 9:] = -R[k].T @ t[k]
    return rows


class _Tracer:
    """Vectorised ray tracing of one mesh: all rays of all views in one launch."""

    def __init__(self, vertices: NDArray[np.float32], faces: NDArray[np.uint32]) -> None:
        self.scene = make_scene(vertices, faces)

    def images(
        self, R: NDArray, t: NDArray, cameras: list[Camera], faces: bool = False
    ) -> Iterator[Image]:
        """Each view's z-depth image and, if asked for, which face each pixel shows."""
        width, height = cameras[0].width, cameras[0].height
        tile_columns, tile_rows = -(-width // TILE), -(-height // TILE)
        per_view = tile_columns * tile_rows * TILE * TILE
        rays = _rays(R, t, cameras)
        step = max(1, MAX_RAYS // per_view)
        for first in range(0, len(rays), step):
            batch = rays[first : first + step]
            hit = self._launch(batch, per_view, tile_columns)
            z = dr.select(hit.is_valid(), hit.t, 0.0)
            face = dr.select(hit.is_valid(), hit.prim_index, 0) if faces else None
            dr.eval(z, face)
            parts = []
            for values in (z, face):
                if values is None:
                    parts.append([None] * len(batch))
                    continue
                tiles = values.numpy().reshape(len(batch), tile_rows, tile_columns, TILE, TILE)
                whole = tiles.swapaxes(2, 3).reshape(len(batch), tile_rows * TILE, -1)
                parts.append(whole[:, :height, :width])
            yield from zip(*parts, strict=True)

    def _launch(self, rays: NDArray[np.float32], per_view: int, tile_columns: int) -> Any:
        """What the rays of some views meet first, in tiles: a preliminary intersection."""
        index = dr.arange(mi.UInt32, len(rays) * per_view)
        view = index // per_view
        pixel = index - view * per_view
        tile, inner = pixel // (TILE * TILE), pixel % (TILE * TILE)
        tile_row = tile // tile_columns
        u = mi.Float((tile - tile_row * tile_columns) * TILE + inner % TILE) + 0.5
        v = mi.Float(tile_row * TILE + inner // TILE) + 0.5
        table = mi.Float(rays.ravel())
        m = [dr.gather(mi.Float, table, view * 12 + k) for k in range(12)]
        direction = mi.Vector3f(*(m[k] * u + m[k + 1] * v + m[k + 2] for k in (0, 3, 6)))
        ray = mi.Ray3f(mi.Point3f(*m[9:]), direction)
        return self.scene.ray_intersect_preliminary(ray, coherent=True)

    def clear(
        self, eyes: NDArray, directions: NDArray[np.float32], ends: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """Which segments meet no surface.

        Args:
            eyes: (V,3) where they begin; directions: (V,S,3); ends: (V,S) in units of direction.

        Returns:
            (V,S) bool.
        """
        count = ends.shape[1]
        view = dr.arange(mi.UInt32, ends.size) // count
        origin = dr.gather(mi.Point3f, mi.Float(eyes.astype(np.float32).ravel()), view)
        direction = mi.Vector3f(directions.reshape(-1, 3).T)
        ray: Any = mi.Ray3f(origin, direction)
        ray.maxt = mi.Float(ends.ravel())
        return ~self.scene.ray_test(ray).numpy().reshape(ends.shape)


class _ScalarTracer:
    """The same, one ray at a time: for machines without LLVM."""

    def __init__(self, vertices: NDArray[np.float32], faces: NDArray[np.uint32]) -> None:
        self.scene = make_scene(vertices, faces)

    def images(
        self, R: NDArray, t: NDArray, cameras: list[Camera], faces: bool = False
    ) -> Iterator[Image]:
        """As ``_Tracer.images``."""
        intersect = self.scene.ray_intersect_preliminary
        for row, camera in zip(_rays(R, t, cameras), cameras, strict=True):
            M, eye = row[:9].reshape(3, 3), row[9:]
            pixels = camera.pixel_centres().reshape(-1, 2).astype(np.float32)
            directions = pixels @ M[:, :2].T + M[:, 2]
            ray = mi.Ray3f(mi.Point3f(eye), mi.Vector3f(0, 0, 1))
            z = np.zeros(len(directions), np.float32)
            face = np.zeros(len(directions), np.uint32)
            for k, direction in enumerate(directions.tolist()):
                ray.d = direction
                hit = intersect(ray)
                z[k] = hit.t
                if faces:
                    face[k] = hit.prim_index
            missed = np.isinf(z)
            z[missed] = face[missed] = 0
            shape = camera.height, camera.width
            yield z.reshape(shape), face.reshape(shape) if faces else None

    def clear(
        self, eyes: NDArray, directions: NDArray[np.float32], ends: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """As ``_Tracer.clear``."""
        seen = np.zeros(ends.shape, bool)
        blocked = self.scene.ray_test
        for k, eye in enumerate(eyes.tolist()):
            ray = mi.Ray3f(mi.Point3f(eye), mi.Vector3f(0, 0, 1))
            segments = zip(directions[k].tolist(), ends[k].tolist(), strict=True)
            for j, (ray.d, ray.maxt) in enumerate(segments):
                seen[k, j] = not blocked(ray)
        return seen
