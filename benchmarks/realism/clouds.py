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

    def only(self, labels: list[int]) -> Clouds:
        """The clouds of some classes, labels kept."""
        chosen = np.isin(self.labels, labels)
        return Clouds(self.points[chosen], self.labels[chosen])

    def stratified(self, per_class: int, rng: np.random.Generator) -> Clouds:
        """At most ``per_class`` clouds of each class, drawn without replacement, in file order."""
        chosen: list[int] = []
        for label in np.unique(self.labels):
            of_class = np.flatnonzero(self.labels == label)
            chosen += rng.permutation(of_class)[:per_class].tolist()
        order = np.sort(chosen)
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


def parametric(cache: Path, per_class: int) -> Clouds:
    """``per_class`` objects of every family, sampled uniformly over their surface.

    Kept in ``cache``, one file a class, named by the sources of its family, so that an edited
    family is made anew.
    """
    cache.mkdir(parents=True, exist_ok=True)
    points, labels = [], []
    for name, family in FAMILIES.items():
        file = cache / f"{name}-{per_class}-{_digest(family)}.npy"
        if not file.is_file():
            np.save(file, np.stack([_sample(family, i) for i in range(per_class)]))
        points.append(np.load(file))
        labels.append(np.full(per_class, MODELNET40.index(name)))
    return Clouds(np.concatenate(points), np.concatenate(labels))


def _sample(family: Family, index: int) -> NDArray[np.float32]:
    mesh = family.mesh(index, PARAMETRIC_SEED)
    rng = generator(PARAMETRIC_SEED, "realism", family.name, index)
    return normalise(np.asarray(trimesh.sample.sample_surface(mesh, POINTS, seed=rng)[0]))


def _digest(family: Family) -> str:
    """Digest of the code a family is made by: its module and what that takes from its package."""
    module = sys.modules[family.build.__module__]
    origins = {getattr(value, "__module__", None) for value in vars(module).values()}
    names = {module.__name__, "renderers.shapes.solids", "renderers.shapes.family"} | {
        origin for origin in origins if origin and origin.startswith("renderers.shapes.")
    }
    digest = hashlib.sha256(str(GENERATION).encode())
    for name in sorted(names):
        digest.update(Path(str(sys.modules[name].__file__)).read_bytes())
    return digest.hexdigest()[:16]
