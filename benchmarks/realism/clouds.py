"""Complete aligned clouds: real ones from a file, parametric ones from the families."""

from __future__ import annotations

import hashlib
import sys
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import trimesh
from numpy.typing import NDArray

from partialbench.dataset.categories import MODELNET40
from partialbench.dataset.seeding import generator
from renderers.shapes.catalogue import FAMILIES
from renderers.shapes.family import GENERATION, Family

POINTS = 1024
PARAMETRIC_SEED = 0


@dataclass(frozen=True)
class Clouds:
    """Labelled clouds.

    Attributes:
        points: (M,1024,3) float32, bounding-box centre at the origin, largest norm 1.
        labels: (M,) int64 into MODELNET40.
    """

    points: NDArray[np.float32]
    labels: NDArray[np.int64]

    def divided(self, share: float, rng: np.random.Generator) -> tuple[Clouds, Clouds]:
        """Two disjoint parts of every class: about ``share`` of it, and the rest, in file order."""
        first = np.zeros(len(self.labels), bool)
        for label in np.unique(self.labels):
            of_class = rng.permutation(np.flatnonzero(self.labels == label))
            first[of_class[: round(share * len(of_class))]] = True
        return (
            Clouds(self.points[first], self.labels[first]),
            Clouds(self.points[~first], self.labels[~first]),
        )

    def at_most(self, per_class: int) -> Clouds:
        """The first ``per_class`` clouds of each class."""
        chosen = [
            np.flatnonzero(self.labels == label)[:per_class] for label in np.unique(self.labels)
        ]
        order = np.sort(np.concatenate(chosen))
        return Clouds(self.points[order], self.labels[order])


def normalise(points: NDArray) -> NDArray[np.float32]:
    """(…,N,3) → the same with each cloud's bounding-box centre at the origin, largest norm 1."""
    centre = (points.min(axis=-2, keepdims=True) + points.max(axis=-2, keepdims=True)) / 2
    points = points - centre
    radius = np.linalg.norm(points, axis=-1, keepdims=True).max(axis=-2, keepdims=True)
    return (points / radius).astype(np.float32)


def real(file: Path, split: str) -> Clouds:
    """Clouds of an HDF5 file with ``{split}/points`` (M,3,1024) uint16 and ``{split}/label``.

    A code c stands for c/4095·2 − 1.
    """
    with h5py.File(file) as h5:
        codes = h5[split]["points"][()]
        labels = h5[split]["label"][()].astype(np.int64)
    points = codes.transpose(0, 2, 1).astype(np.float32) / 4095 * 2 - 1
    return Clouds(normalise(points), labels)


def parametric(cache: Path, indices: range) -> Clouds:
    """Objects of every family, sampled uniformly over their surface.

    Kept in ``cache``, one file a class, named by the sources of its family, so that an edited
    family is made anew.
    """
    cache.mkdir(parents=True, exist_ok=True)
    points, labels = [], []
    for name, family in FAMILIES.items():
        file = cache / f"{name}-{indices.start}-{indices.stop}-{_digest(family)}.npy"
        if not file.is_file():
            np.save(file, np.stack([sample_cloud(family, i) for i in indices]))
        points.append(np.load(file))
        labels.append(np.full(len(indices), MODELNET40.index(name)))
    return Clouds(np.concatenate(points), np.concatenate(labels))


def sample_cloud(family: Family, index: int) -> NDArray[np.float32]:
    """(1024,3) points drawn uniformly from the surface of one object."""
    mesh = family.mesh(index, PARAMETRIC_SEED)
    rng = generator(PARAMETRIC_SEED, "realism", family.name, index)
    return normalise(np.asarray(trimesh.sample.sample_surface(mesh, POINTS, seed=rng)[0]))


def _digest(family: Family) -> str:
    """Digest of the code a family is made by: its module and what that takes from its package."""
    module = sys.modules[family.build.__module__]
    origins = {getattr(value, "__module__", None) for value in vars(module).values()}
    shared = {f"renderers.shapes.{name}" for name in ("family", "outlines", "solids")}
    names = (
        {module.__name__}
        | shared
        | {origin for origin in origins if origin and origin.startswith("renderers.shapes.")}
    )
    digest = hashlib.sha256(str(GENERATION).encode())
    for name in sorted(names):
        digest.update(Path(str(sys.modules[name].__file__)).read_bytes())
    return digest.hexdigest()[:16]
