"""The images of a stereo rig: what Mitsuba's rays meet, lit by a projector and by ambient light.

Direct light only. Each emitter is sampled once a ray, the projector's one direction exactly, so
there is no noise of the renderer in the pattern. Sums are in a fixed order: the same image for any
number of threads. A vectorised variant of Mitsuba must be active.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from partialbench.geometry.camera import Camera

_SUBPIXELS = ((0.25, 0.25), (0.75, 0.75))
_WALL_ALBEDO = 0.4


class Scene:
    """Meshes before a wall, in the rig's frame and metres: x right, y down, z forward.

    Args:
        parts: ((vertices, faces), albedo) each.
        wall: its z.
        projector_x: where the projector is; it looks along z.
        pattern: (N,N) what it throws, a pixel as wide as one of a camera of ``focal`` pixels.
        ambient: even light, as a share of the pattern's mean where it falls.
    """

    def __init__(
        self,
        parts: Sequence[tuple[tuple[NDArray, NDArray], float]],
        wall: float,
        projector_x: float,
        pattern: NDArray[np.float32],
        focal: float,
        ambient: float,
    ) -> None:
        side = len(pattern)
        place = mi.ScalarTransform4f().look_at([projector_x, 0, 0], [projector_x, 0, 1], [0, -1, 0])
        content: dict[str, Any] = {
            "type": "scene",
            "projector": {
                "type": "projector", "to_world": place,
                "fov": float(np.rad2deg(2 * np.arctan(side / 2 / focal))),
                "irradiance": {
                    "type": "bitmap", "bitmap": mi.Bitmap(pattern[..., None]), "raw": True,
                },
            },
            "wall": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().look_at([0, 0, wall], [0, 0, 0], [0, 1, 0])
                @ mi.ScalarTransform4f().scale(20 * wall),
                "bsdf": _matt(_WALL_ALBEDO),
            },
        }  # fmt: skip
        for k, ((vertices, faces), albedo) in enumerate(parts):
            content[f"part{k}"] = _mesh(vertices, faces, _matt(albedo))
        self.scene = mi.load_dict(content)
        (self.projector,) = self.scene.emitters()
        # Of the pattern's irradiance E at a metre, E/z² arrives at z.
        self.ambient = ambient * float(pattern.mean()) / max(wall, 0.1) ** 2

    def image(
        self, camera: Camera, x: float, shift: int, margin: int, rng: np.random.Generator
    ) -> NDArray[np.float64]:
        """(H, margin + W) radiance of one camera at x, two rays a pixel.

        Args:
            camera: of the wanted part of the image; ``margin`` more columns come to its left.
            shift: by how many pixels the image is moved to the right.
            rng: directions of the ambient light.
        """
        width, height = camera.width + margin, camera.height
        u = np.arange(width, dtype=np.float64) - margin - shift
        v = np.arange(height, dtype=np.float64)
        total = np.zeros((height, width))
        for du, dv in _SUBPIXELS:
            slope_x = (u + du - camera.K[0, 2]) / camera.K[0, 0]
            slope_y = (v + dv - camera.K[1, 2]) / camera.K[1, 1]
            slopes = np.stack(np.broadcast_arrays(slope_x, slope_y[:, None]))
            samples = rng.random((2, width * height), np.float32)
            total += self._radiance(x, slopes.reshape(2, -1), samples).reshape(total.shape)
        return total / len(_SUBPIXELS)

    def _radiance(self, x: float, slopes: NDArray, samples: NDArray) -> NDArray[np.float64]:
        across, down = (mi.Float(each) for each in slopes.astype(np.float32))
        direction = dr.normalize(mi.Vector3f(across, down, 1.0))
        ray = mi.RayDifferential3f(mi.Point3f(x, 0, 0), direction)
        hit = self.scene.ray_intersect(ray)
        bsdf, context = hit.bsdf(ray), mi.BSDFContext()
        valid = hit.is_valid()
        towards, weight = self.projector.sample_direction(hit, mi.Point2f(0.5), valid)
        lit = valid & (towards.pdf > 0)
        lit &= ~self.scene.ray_test(hit.spawn_ray_to(towards.p), lit)
        back = bsdf.eval(context, hit, hit.to_local(towards.d), lit)
        pattern = dr.select(lit, (back * weight).x, 0.0)
        # One direction of the hemisphere a ray, as a matt surface weighs them: a point on the unit
        # sphere about the tip of the normal.
        normal = dr.select(dr.dot(hit.n, direction) > 0, -hit.n, hit.n)
        sky = valid & ~self.scene.ray_test(hit.spawn_ray(normal + _on_sphere(samples)), valid)
        # A matt surface's albedo/π: what it sends back of light along its normal.
        upright = mi.Vector3f(0, 0, dr.select(hit.wi.z > 0, 1.0, -1.0))
        matt = bsdf.eval(context, hit, upright, valid).x
        found = pattern + self.ambient * dr.select(sky, matt, 0.0)
        return found.numpy().astype(np.float64)


def _on_sphere(samples: NDArray[np.float32]) -> Any:
    """Unit vectors of (2,n) numbers in [0, 1)."""
    z = 1 - 2 * mi.Float(samples[0])
    sine, cosine = dr.sincos(2 * np.pi * mi.Float(samples[1]))
    # Not ``safe_sqrt``: see ``_matt``.
    r = dr.sqrt(dr.abs(1 - z * z))
    return mi.Vector3f(r * cosine, r * sine, z)


def _matt(albedo: float) -> dict[str, Any]:
    # Mitsuba's glossy materials take a maximum of floats, at which the code generator of LLVM 15
    # and older ends the process on AVX-512.
    grey = {"type": "rgb", "value": [albedo] * 3}
    return {"type": "twosided", "material": {"type": "diffuse", "reflectance": grey}}


def _mesh(vertices: NDArray, faces: NDArray, bsdf: dict[str, Any]) -> Any:
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh("part", len(vertices), len(faces), props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.ascontiguousarray(vertices, np.float32).ravel()
    parameters["faces"] = np.ascontiguousarray(faces, np.uint32).ravel()
    parameters.update()
    return mesh
