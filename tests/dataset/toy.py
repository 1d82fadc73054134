"""A source and an occluder so simple that their answers are known: convex solids, seen exactly."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass, field

import numpy as np
import trimesh

from partialbench.dataset.build import BuildPlan
from partialbench.dataset.rows import Job
from partialbench.dataset.sources import ObjectRef, RejectedObject, RejectedView, View
from partialbench.errors import InputError


@dataclass
class ToySource:
    """``count`` boxes and bottles a split; ``broken`` ids do not load, ``deadly`` kill a worker."""

    count: int = 6
    broken: tuple[str, ...] = ()
    deadly: tuple[str, ...] = ()
    slow_s: float = 0.0
    class_names: tuple[str, ...] = ("dresser", "bottle")
    frame: str = "aligned"
    rejected: list[RejectedObject] = field(default_factory=list)

    def splits(self):
        return ("train", "test")

    def objects(self, split):
        return [
            ObjectRef(f"{self.class_names[i % 2]}_{i:04d}", i % 2, split, f"toy/{split}/{i}")
            for i in range(self.count)
        ]

    def load(self, ref):
        time.sleep(self.slow_s)
        if ref.object_id in self.deadly:
            os.kill(os.getpid(), signal.SIGKILL)
        if ref.object_id in self.broken:
            raise InputError(f"{ref.location} has 0 faces, expected at least 1")
        size = 1 + int(ref.location.rsplit("/", 1)[1]) / 10
        mesh = (
            trimesh.creation.box((1, size, 0.5))
            if ref.label == 0
            else trimesh.creation.cylinder(0.5, size)
        )
        mesh.vertices /= np.linalg.norm(mesh.vertices, axis=1).max()
        return mesh

    def digest(self, ref):
        return f"{hash(ref.location) % 1:064d}"

    def describe(self):
        return {"name": "toy", "count": self.count}


@dataclass
class ToyOccluder:
    """Surface samples on faces that look at the camera: exact for convex solids.

    With ``depth`` a view has an image of that height, one wider, of random numbers.
    """

    samples: int = 400
    reject: bool = False
    normals: bool = False
    depth: int = 0

    def views(self, shape, poses, rngs):
        seen = []
        for (R, t), rng in zip(poses, rngs, strict=True):
            if self.reject and rng.random() < 0.3:
                seen.append(RejectedView("too few points", {"n": 3}))
                continue
            points, faces = trimesh.sample.sample_surface(shape, self.samples, seed=rng)
            eye = -R.T @ t
            facing = ((eye - points) * shape.face_normals[faces]).sum(1) > 0
            camera = points[facing] @ R.T + t
            normals = shape.face_normals[faces][facing] @ R.T
            image = rng.random((self.depth, self.depth + 1)).astype(np.float32)
            seen.append(
                View(camera.astype(np.float32), R, t, np.zeros((3, 3)), float(facing.mean()),
                     int(facing.sum()), image if self.depth else None,
                     normals.astype(np.float32) if self.normals else None)
            )  # fmt: skip
        return seen

    def describe(self):
        return {"name": "toy", "samples": self.samples}


def plan(out, *, source=None, occluder=None, setting="partial", rows_per_shard=6, seed=0,
         points=64, per_class=None):  # fmt: skip
    job = Job(source or ToySource(), occluder or ToyOccluder(), "toy", setting,
              {"train": 3, "test": 1}, points, seed)  # fmt: skip
    return BuildPlan(job, out, ("train", "test"), per_class, rows_per_shard)
