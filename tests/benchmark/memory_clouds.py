"""Data for tests of the harness: clouds of simple solids in memory, or the same in a folder."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from partialbench.dataset import build as builder
from partialbench.dataset.executors import InlineExecutor
from partialbench.dataset.rows import Job
from partialbench.dataset.sources import ObjectRef, View
from partialbench.geometry.rotations import haar_rotations
from partialbench.geometry.symmetry import CLASS_SYMMETRY

CLASSES = ("bottle", "chair", "table")
_PROPORTIONS = {"bottle": (0.2, 0.2, 1.0), "chair": (0.6, 0.5, 0.7), "table": (1.0, 0.8, 0.1)}


def solid(name: str, points: int, rng: np.random.Generator) -> np.ndarray:
    """Points on a box with its class's proportions, a little varied; unit ball."""
    size = np.array(_PROPORTIONS.get(name, (0.5, 0.5, 0.5))) * rng.uniform(0.9, 1.1, 3)
    cloud = rng.uniform(-1, 1, (points, 3))
    side = rng.integers(0, 3, points)
    cloud[np.arange(points), side] = np.sign(cloud[np.arange(points), side])
    cloud *= size
    return cloud / np.linalg.norm(cloud, axis=1).max()


def hash_of(name: str) -> str:
    return hashlib.sha256(name.encode()).hexdigest()


class MemoryClouds:
    """What ``ShardDataset`` is to the harness, without files."""

    def __init__(
        self, objects=20, views=2, num_points=64, classes=CLASSES, seed=0, setting="partial"
    ):
        rng = np.random.default_rng(seed)
        rows = [
            (c, o, v) for c in range(len(classes)) for o in range(objects) for v in range(views)
        ]
        self.num_points, self.class_names, self.setting = num_points, tuple(classes), setting
        self.sensor, self.has_poses, self.has_normals = "", True, False
        self.occluders, self.grid = 0.0, ""
        self.dataset_id, self.digest = "toy", f"{seed:064d}"
        self.labels = np.array([c for c, _, _ in rows], np.int64)
        self.object_ids = np.array([f"{classes[c]}_{o:04d}" for c, o, _ in rows])
        self.views = np.array([v for _, _, v in rows], np.int32)
        self.rotations = haar_rotations(rng, len(rows))
        self.visible_fraction = rng.uniform(0.2, 0.6, len(rows)).astype(np.float32)
        self.source_digests = np.array([hash_of(name) for name in self.object_ids])
        self.symmetries = np.array([CLASS_SYMMETRY.get(classes[c], "none") for c, _, _ in rows])
        canonical = np.stack([solid(classes[c], 2 * num_points, rng) for c, _, _ in rows])
        self.clouds = (canonical @ self.rotations.swapaxes(1, 2) + (0, 0, 3)).astype(np.float32)

    def __len__(self):
        return len(self.labels)

    def points(self, indices, rng=None, distinct=False):
        indices = np.asarray(indices)
        if rng is None:
            return self.clouds[indices, : self.num_points].copy()
        start = rng.integers(0, self.clouds.shape[1], len(indices))
        take = (start[:, None] + np.arange(self.num_points)) % self.clouds.shape[1]
        return self.clouds[indices[:, None], take]


class SolidSource:
    """The same solids as a source of clouds for the builder."""

    frame = "aligned"

    def __init__(self, objects: int, classes) -> None:
        self.count, self.class_names, self.rejected = objects, tuple(classes), []

    def splits(self):
        return ("train", "test")

    def objects(self, split):
        return [
            ObjectRef(f"{name}_{i:04d}", label, split, f"{split}/{name}/{i}")
            for label, name in enumerate(self.class_names)
            for i in range(self.count)
        ]

    def load(self, ref):
        rng = np.random.default_rng([sum(map(ord, ref.location)), ref.label])
        return solid(self.class_names[ref.label], 300, rng)

    def digest(self, ref):
        return hash_of(ref.location)

    def describe(self):
        return {"name": "solids", "count": self.count}


class WholeView:
    """An occluder that hides nothing."""

    def views(self, shape, poses, rngs):
        return [
            View((shape @ R.T + t).astype(np.float32), R, t, np.zeros((3, 3)), 0.5, len(shape))
            for R, t in poses
        ]

    def describe(self):
        return {"name": "whole"}


def data_folder(
    out: Path, dataset_id="toy", classes=CLASSES, objects=12, views=2, points=128, seed=0,
    setting="partial",
) -> Path:  # fmt: skip
    """A complete data folder of solids."""
    job = Job(SolidSource(objects, classes), WholeView(), dataset_id, setting,
              {"train": views, "test": 2}, points, seed)  # fmt: skip
    builder.build(builder.BuildPlan(job, out, ("train", "test")), InlineExecutor)
    return out
