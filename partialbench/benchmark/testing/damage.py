"""Damage to test clouds, in five strengths: how a model fares where captures are not what it knows.

The first seven kinds are those of ModelNet-C, defined as there where that makes sense for a cloud
of one side. As there, a cloud is moved to its centroid and scaled to a largest norm of 1 first, and
moved back after. What differs, and why:

- counts are ModelNet-C's shares of its 1,024 points, as clouds here have other numbers;
- ``scale`` stretches along the object's axes, which are not the camera's; it does not normalise the
  cloud again, which each model does for itself;
- ``rotate-about-view`` turns about the line of sight alone: a cloud here has a pose uniform on
  SO(3) already, and a turn about any other axis would show another side than was captured.

Three more are of captures: ``flying-pixels``, ``quantisation``, ``uneven-density``.

Source: Ren, Pan and Liu, "Benchmarking and Analyzing Point Cloud Classification under Corruptions",
ICML 2022; numbers as in ldkong1205/PointCloud-C@82f3b4b, build/corrupt_utils.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from partialbench import given
from partialbench.benchmark.clouds import Clouds
from partialbench.dataset.seeding import generator
from partialbench.errors import InputError
from partialbench.geometry import portable
from partialbench.registry import close_matches

STRENGTHS = (1, 2, 3, 4, 5)
ALL = "all"
_POINTS = 1024
"""Points of a cloud in ModelNet-C."""
_NEIGHBOURS = 8


class Scene(NamedTuple):
    """What a damage may ask about a cloud besides its normalised points.

    Attributes:
        axes: (3,3) the object's axes as columns, camera frame.
        rays: (N,3) unit vectors from the camera to the points.
        distances: (N,) along those, in units of the cloud's radius.
        image: (N,2) where the points are seen.
        sight: (3,) unit vector along the line of sight to the cloud's centroid.
    """

    axes: NDArray[np.float64]
    rays: NDArray[np.float64]
    distances: NDArray[np.float64]
    image: NDArray[np.float64]
    sight: NDArray[np.float64]


Damage = Callable[[NDArray[np.float64], int, Scene, np.random.Generator], NDArray[np.float64]]
"""(N,3) normalised points, a strength of 1 to 5, the scene and draws → (M,3). M follows from N and
the strength alone. Draws are the same for every strength: a stronger damage is more of the same."""


def damaged(
    points: NDArray, name: str, key: tuple[str | int, ...], rotation: NDArray, seed: int = 0
) -> NDArray[np.float32]:
    """A damaged copy of one cloud: a function of the arguments alone.

    Args:
        points: (N,3) float32, camera frame. One that reaches behind the camera has been moved from
            where it was seen, and is taken as seen along z from far away.
        name: see ``parse``; strength 0 is the identity.
        key: of the cloud, (object id, view).
        rotation: (3,3) R_camera_object.

    Returns:
        (M,3) float32 in the same frame; M is the same for all clouds of N points.

    Raises:
        InputError: no such damage, or points that are not finite.
    """
    kind, strength = _parts(name)
    if strength == 0:
        return np.array(points, np.float32)
    cloud = given.cloud(points, f"the cloud {key}").astype(np.float64)
    if not len(cloud) or not np.isfinite(cloud).all():
        raise InputError(
            f"the cloud {key} has no points, or some that are not finite, and cannot be damaged"
        )
    centre = cloud.mean(axis=0)
    radius = float(np.sqrt(((cloud - centre) ** 2).sum(axis=1)).max()) or 1.0
    scene = _scene(cloud, centre, radius, np.asarray(rotation, np.float64))
    rng = generator(seed, "damage", kind, *key)
    found = KINDS[kind]((cloud - centre) / radius, strength, scene, rng)
    return (found * radius + centre).astype(np.float32)


def parse(texts: str | Iterable[str]) -> tuple[str, ...]:
    """Damages as records name them: "jitter:3". A name alone is its five strengths.

    Args:
        texts: such names, or "all".

    Raises:
        InputError: an unknown name, or a strength that is not 1 to 5.
    """
    names: list[str] = []
    for text in given.several(texts, "damages"):
        if not isinstance(text, str):
            raise InputError(f"a damage is named by a text such as 'jitter:3', got {text!r}")
        kind, colon, _ = text.partition(":")
        if text == ALL:
            names += [f"{each}:{strength}" for each in KINDS for strength in STRENGTHS]
        elif colon:
            kind, strength = _parts(text)
            if strength == 0:
                raise InputError(f"{text!r} damages nothing: that test is made anyway")
            names.append(f"{kind}:{strength}")
        else:
            _parts(f"{kind}:1")
            names += [f"{kind}:{strength}" for strength in STRENGTHS]
    return tuple(dict.fromkeys(names))


def _parts(name: str) -> tuple[str, int]:
    kind, _, strength = name.partition(":")
    if kind not in KINDS:
        raise InputError(f"no damage named {kind!r}{close_matches(kind, [*KINDS, ALL])}")
    if strength not in map(str, (0, *STRENGTHS)):
        raise InputError(
            f"the damage {name!r} has the strength {strength!r}; expected one of "
            f"{', '.join(map(str, STRENGTHS))}, as in {kind}:3"
        )
    return kind, int(strength)


class DamagedClouds:
    """A test set whose clouds are damaged; all else is as it was, ``num_points`` too."""

    def __init__(self, clouds: Clouds, name: str) -> None:
        self.clouds, self.name = clouds, name

    def __getattr__(self, attribute: str) -> Any:
        return getattr(self.clouds, attribute)

    def __len__(self) -> int:
        return len(self.clouds)

    def points(
        self,
        indices: NDArray | list[int],
        rng: np.random.Generator | None = None,
        distinct: bool = False,
    ) -> NDArray[np.float32]:
        """(B,M,3) float32."""
        own = self.clouds
        return np.stack(
            [
                damaged(
                    points, self.name, (str(own.object_ids[i]), int(own.views[i])), own.rotations[i]
                )
                for i, points in zip(indices, own.points(indices, rng, distinct), strict=True)
            ]
        )

    def points_and_normals(
        self, indices: NDArray | list[int], rng: Any = None, distinct: bool = False
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Refused: nothing says what the normals of moved and added points are."""
        raise InputError(
            f"the clouds damaged by {self.name} have no normals; a model that takes normals cannot "
            f"be tested on damaged clouds"
        )


def _scene(cloud: NDArray, centre: NDArray, radius: float, axes: NDArray) -> Scene:
    if (cloud[:, 2] > 0).all():
        distances = np.sqrt((cloud**2).sum(axis=1))
        rays = cloud / distances[:, None]
        image = cloud[:, :2] / cloud[:, 2:]
        sight = centre / np.sqrt((centre**2).sum())
    else:
        sight = np.array([0.0, 0.0, 1.0])
        distances, rays = cloud[:, 2], np.broadcast_to(sight, cloud.shape)
        image = cloud[:, :2]
    return Scene(axes, rays, distances / radius, image, sight)


def _count(per_strength: int, strength: int, points: int) -> int:
    """So many of 1,024 points for each step of strength, as a number of these points."""
    return max(1, round(per_strength * strength * points / _POINTS))


def _most(per_strength: int, points: int) -> int:
    return _count(per_strength, STRENGTHS[-1], points)


def _jitter(p: NDArray, strength: int, scene: Scene, rng: np.random.Generator) -> NDArray:
    return p + 0.01 * strength * rng.standard_normal(p.shape)


def _scale(p: NDArray, strength: int, scene: Scene, rng: np.random.Generator) -> NDArray:
    largest = 1.5 + 0.1 * strength
    factors = 1 / largest + rng.random(3) * (largest - 1 / largest)
    along = portable.product(p, scene.axes) * factors
    return portable.product(along, scene.axes.T)


def _rotate(p: NDArray, strength: int, scene: Scene, rng: np.random.Generator) -> NDArray:
    angle = np.pi / 6 * strength / 5 * rng.uniform(-1, 1)
    cosine, sine = portable.cosine_sine(angle)
    x, y, z = scene.sight
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    # Rodrigues' formula.
    turn = np.eye(3) + sine * cross + (1 - cosine) * portable.product(cross, cross)
    return portable.product(p, turn.T)


def _drop_global(p: NDArray, strength: int, scene: Scene, rng: np.random.Generator) -> NDArray:
    kept = int(len(p) * (1 - 0.125 * (strength + 1)))
    return p[np.sort(rng.permutation(len(p))[: max(1, kept)])]


def _cluster_sizes(strength: int, points: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """How 100 points of 1,024 for each step of strength are shared out over 1 to 7 clusters."""
    clusters = int(rng.integers(1, 8))
    owners = rng.integers(0, clusters, _most(100, points))
    return np.bincount(owners[: _count(100, strength, points)], minlength=clusters)


def _drop_local(p: NDArray, strength: int, scene: Scene, rng: np.random.Generator) -> NDArray:
    sizes = _cluster_sizes(strength, len(p), rng)
    there = np.ones(len(p), bool)
    for size in sizes:
        order = rng.permutation(len(p))
        seed = order[there[order]][0]
        away = np.where(there, ((p - p[seed]) ** 2).sum(axis=1), np.inf)
        gone = min(int(size), int(there.sum()) - 1)
        there[np.argsort(away, kind="stable")[:gone]] = False
    return p[there]


def _add_global(p: NDArray, strength: int, scene: Scene, rng: np.random.Generator) -> NDArray:
    most = _most(10, len(p))
    direction = rng.standard_normal((most, 3))
    direction /= np.sqrt((direction**2).sum(axis=1, keepdims=True))
    inside = direction * np.cbrt(rng.random((most, 1)))
    return np.concatenate([p, inside[: _count(10, strength, len(p))]])


def _add_local(p: NDArray, strength: int, scene: Scene, rng: np.random.Generator) -> NDArray:
    clusters, most = int(rng.integers(1, 8)), _most(100, len(p))
    seeds = p[rng.permutation(len(p))[:clusters]]
    owners = rng.integers(0, len(seeds), most)
    sigma = rng.uniform(0.075, 0.125, len(seeds))
    added = seeds[owners] + sigma[owners, None] * rng.standard_normal((most, 3))
    # What lies outside the unit ball is mirrored at its surface.
    added /= np.maximum((added**2).sum(axis=1, keepdims=True), 1)
    return np.concatenate([p, added[: _count(100, strength, len(p))]])


def _flying_pixels(p: NDArray, strength: int, scene: Scene, rng: np.random.Generator) -> NDArray:
    """Of the points nearest to an outline in the image, 4 % of all for each step fly off.

    A time-of-flight pixel that sees two surfaces says a depth between them (Foix, Alenyà and Torras
    2011). Behind the object stands a wall, one radius from its farthest point.
    """
    count = min(len(p), max(1, round(0.04 * strength * len(p))))
    neighbours = min(_NEIGHBOURS + 1, len(p))
    _, near = cKDTree(scene.image).query(scene.image, k=neighbours)
    near = near.reshape(len(p), neighbours)
    aside = scene.image[near] - scene.image[:, None]
    width = np.sqrt((aside**2).sum(axis=2)).mean(axis=1)
    # Neighbours all on one side: the point is on the outline.
    offset = np.sqrt((aside.mean(axis=1) ** 2).sum(axis=1))
    edge = offset / np.where(width > 0, width, 1)
    flying = np.argsort(-edge, kind="stable")[:count]
    gap = scene.distances.max() + 1 - scene.distances
    away = rng.random(len(p)) * gap
    moved = p.copy()
    moved[flying] += away[flying, None] * scene.rays[flying]
    return moved


def _quantisation(p: NDArray, strength: int, scene: Scene, rng: np.random.Generator) -> NDArray:
    """Distances in whole steps of 0.01, 0.02, 0.04, 0.08, 0.16 radii, as of a coarse disparity."""
    step = 0.01 * 2 ** (strength - 1)
    off = np.rint(scene.distances / step) * step - scene.distances
    return p + off[:, None] * scene.rays


def _uneven_density(p: NDArray, strength: int, scene: Scene, rng: np.random.Generator) -> NDArray:
    """The farther a point, the likelier it is lost: a tenth of all points for each step.

    A point at a share x of the way from the nearest to the farthest goes with a weight of x.
    """
    gone = min(len(p) - 1, round(0.1 * strength * len(p)))
    near, far = scene.distances.min(), scene.distances.max()
    share = (scene.distances - near) / (far - near if far > near else 1)
    # Exponential clocks: the first to ring is drawn in proportion to its rate.
    clocks = rng.standard_exponential(len(p)) / np.maximum(share, 1e-9)
    return p[np.sort(np.argsort(clocks, kind="stable")[gone:])]


MODELNET_C: tuple[str, ...] = (
    "scale", "jitter", "rotate-about-view", "drop-global", "drop-local", "add-global", "add-local",
)  # fmt: skip
"""The kinds that ModelNet-C has, and its mean errors are over."""

KINDS: dict[str, Damage] = {
    "scale": _scale,
    "jitter": _jitter,
    "rotate-about-view": _rotate,
    "drop-global": _drop_global,
    "drop-local": _drop_local,
    "add-global": _add_global,
    "add-local": _add_local,
    "flying-pixels": _flying_pixels,
    "quantisation": _quantisation,
    "uneven-density": _uneven_density,
}
"""Name → damage, in the order of tables."""
