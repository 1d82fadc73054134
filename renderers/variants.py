"""Which of Mitsuba's variants works on this machine, and what to install where one does not."""

from __future__ import annotations

import functools

import drjit as dr
import mitsuba as mi

from partialbench.errors import InputError

SUPPORTED = ("cuda_ad_rgb", "llvm_ad_rgb", "scalar_rgb")
"""The variants the occluder knows, fastest first."""

_REMEDY = {
    "cuda_ad_rgb": (
        "it needs an NVIDIA GPU and its driver (libcuda.so, libnvoptix.so, 535 or newer; in a "
        "container also NVIDIA_DRIVER_CAPABILITIES=graphics,compute,utility)"
    ),
    "llvm_ad_rgb": (
        "it needs the system library libLLVM.so; on Debian or Ubuntu: "
        "sudo apt-get install -y libllvm15 (or whichever libllvmNN the release has; elsewhere, "
        "point DRJIT_LIBLLVM_PATH at the library)"
    ),
    "scalar_rgb": "it needs nothing but Mitsuba itself: reinstall mitsuba",
}


def pick_variant(requested: str = "auto") -> str:
    """The Mitsuba variant to use here: the one asked for, or the fastest that works.

    A variant counts as working when it traces one ray against one triangle correctly. The answer
    is kept for the life of the process; an active Mitsuba variant stays the active one.

    Args:
        requested: "auto", or one of ``SUPPORTED``.

    Raises:
        InputError: for an unknown name, or a variant that does not work here (the message says
            which system library is missing and how to install it).
    """
    if requested == "auto":
        for name in SUPPORTED:
            if _why_not(name) is None:
                return name
        requested = "scalar_rgb"
    if requested not in SUPPORTED:
        raise InputError(
            f"unknown Mitsuba variant {requested!r}; expected auto, {', '.join(SUPPORTED)}"
        )
    problem = _why_not(requested)
    if problem is not None:
        working = [name for name in SUPPORTED if _why_not(name) is None]
        raise InputError(
            f"the Mitsuba variant {requested} does not work here: {_REMEDY[requested]}. "
            f"Working here: {', '.join(working) or 'none'}. Mitsuba said: {problem}"
        )
    return requested


def activate(variant: str, threads: int) -> None:
    """Make ``variant`` Mitsuba's active one, with this many threads (at least 1) in this process.

    Both are settings of the whole process: a caller that uses Mitsuba beside the occluder sets its
    own variant again afterwards.
    """
    if mi.variant() != variant:
        mi.set_variant(variant)
    if dr.thread_count() != threads:
        dr.set_thread_count(threads)


@functools.cache
def _why_not(variant: str) -> str | None:
    """None when the variant traces a ray here, else Mitsuba's own words."""
    before = mi.variant()
    try:
        mi.set_variant(variant)
        triangle = mi.Mesh("probe", 3, 1)
        parameters = mi.traverse(triangle)
        parameters["vertex_positions"] = [0.0, 0.0, 2.0, 1.0, 0.0, 2.0, 0.0, 1.0, 2.0]
        parameters["faces"] = [0, 1, 2]
        parameters.update()
        scene = mi.load_dict({"type": "scene", "shape": triangle})
        ray = mi.Ray3f(mi.Point3f(0.25, 0.25, 0.0), mi.Vector3f(0.0, 0.0, 1.0))
        distance = scene.ray_intersect_preliminary(ray).t
        found = float(distance if variant.startswith("scalar") else distance[0])
        return None if abs(found - 2) < 1e-5 else f"a ray met a plane 2 away at {found}"
    except (ImportError, RuntimeError) as error:
        return " ".join(str(error).split())
    finally:
        if before is not None:
            mi.set_variant(before)
