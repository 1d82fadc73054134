"""What a family is: a class name, structural variants, named parameters with ranges, a builder.

    @family("cone", variants={"traffic": 2, "plain": 1}, height=(0.6, 1.2), base=(0.2, 0.5), ...)
    def cone(p: Draw) -> Iterable[Solid]: ...

turns the function into a `Family`. An object is a pure function of (seed, class, index): its
generator is keyed by them, the variant is drawn first, then every continuous parameter in the order
declared (used or not), so that a parameter means the same number in every variant.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
import trimesh
from numpy.typing import NDArray

from partialbench.dataset.seeding import generator
from renderers.shapes.solids import Solid, join

GENERATION = 2
"""Number of the families' edition: raise it when any object changes, it enters every digest."""

MIN_FACES, MAX_FACES = 300, 20_000
GRID = 2.0**-20
"""Vertices lie on this grid: the last bit of a platform's sine does not enter the mesh, and every
coordinate is exact in float32."""

T = TypeVar("T")


@dataclass(frozen=True)
class Draw:
    """One object's variant, parameters and the generator for its discrete choices.

    Parameters read as attributes: ``p.height``.
    """

    variant: str
    values: Mapping[str, float]
    rng: np.random.Generator = field(repr=False)

    def __getattr__(self, name: str) -> float:
        try:
            return self.__dict__["values"][name]
        except KeyError:
            raise AttributeError(f"no parameter {name!r} in this family") from None

    def chance(self, probability: float) -> bool:
        """True with the given probability."""
        return bool(self.rng.random() < probability)

    def integer(self, low: int, high: int) -> int:
        """A whole number in [low, high]."""
        return int(self.rng.integers(low, high + 1))

    def choice(self, options: Sequence[T]) -> T:
        """One of the options."""
        return options[int(self.rng.integers(len(options)))]

    def uniform(self, low: float, high: float) -> float:
        """A nameless detail: clutter, jitter. What shapes the object is a declared parameter."""
        return float(self.rng.uniform(low, high))


@dataclass(frozen=True)
class Family:
    """One class's generator.

    Attributes:
        name: the class name.
        variants: structural variant → weight.
        ranges: continuous parameter → (low, high), drawn uniformly.
        build: a draw → the parts.
    """

    name: str
    variants: Mapping[str, float]
    ranges: Mapping[str, tuple[float, float]]
    build: Callable[[Draw], Iterable[Solid]]

    def draw(self, index: int, seed: int = 0) -> Draw:
        """The variant and parameters of object ``index``."""
        rng = generator(seed, "shapes", self.name, index)
        weights = np.cumsum(list(self.variants.values()))
        chosen = int(np.searchsorted(weights, rng.random() * weights[-1], side="right"))
        values = {k: float(rng.uniform(low, high)) for k, (low, high) in self.ranges.items()}
        return Draw(list(self.variants)[chosen], values, rng)

    def mesh(self, index: int, seed: int = 0) -> trimesh.Trimesh:
        """Object ``index``, finished."""
        return finish(join(self.build(self.draw(index, seed))))


def family(
    name: str, variants: Mapping[str, float], **ranges: tuple[float, float]
) -> Callable[[Callable[[Draw], Iterable[Solid]]], Family]:
    """Turns a builder into a `Family`; it registers nothing, ``catalogue`` lists the families."""

    def wrap(build: Callable[[Draw], Iterable[Solid]]) -> Family:
        return Family(name, dict(variants), dict(ranges), build)

    return wrap


def finish(solid: Solid) -> trimesh.Trimesh:
    """The normalised mesh: bounding-box centre at the origin, farthest vertex at norm 1.

    Faces without area and vertices without faces are removed; fewer than 300 faces are subdivided.
    """
    vertices = solid.vertices
    assert np.isfinite(vertices).all(), "a builder made a vertex that is not finite"
    faces = _with_area(vertices, solid.faces, GRID * np.ptp(vertices, axis=0).max())
    corners = vertices[np.unique(faces)]
    centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
    radius = np.linalg.norm(corners - centre, axis=1).max()
    # A cell short of 1, so that rounding does not carry a vertex out of the unit ball.
    vertices = np.round((vertices - centre) * ((1 - GRID) / radius / GRID)) * GRID
    faces = _with_area(vertices, faces, GRID)
    while len(faces) < MIN_FACES:
        finer = Solid(vertices, faces).subdivided()
        vertices = np.round(finer.vertices / GRID) * GRID
        faces = _with_area(vertices, finer.faces, GRID)
    used, faces = np.unique(faces, return_inverse=True)
    return trimesh.Trimesh(vertices[used], faces.reshape(-1, 3), process=False)


def _with_area(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], unit: float
) -> NDArray[np.int64]:
    """The faces whose area is not nought, for vertices on a grid of ``unit``.

    On a grid, the least area of a triangle whose corners do not lie on a line is half a cell.
    """
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return faces[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0.5 * unit**2]
