"""What stands in the rooms: sizes, places, names in ScanNet and ShapeNet, and the CAD models.

A CAD model here is what Scan2CAD calls one: a mesh in ShapeNet's frame (y up, front −z) with the
diagonal of its bounding box 1. The scene stretches it to its real size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from partialbench.dataset.seeding import generator
from partialbench.geometry import portable
from renderers.rooms.appliances import FAMILIES as APPLIANCES
from renderers.shapes.catalogue import make
from renderers.sources.scannet.scan2cad import R_canonical_cad
from renderers.whole import sample_surface

LARGEST_M = 2.3
"""No piece of furniture is longer than this, whatever its class's own measure."""
STRETCH = (0.92, 1.08)
"""Each CAD axis is stretched by its own factor on top of the size, as annotators do."""

# Scan2CAD marks a symmetry that its annotator saw; a mesh has it when 99 % of its turned surface is
# within this share of its bounding box's diagonal of the surface itself.
SYMMETRY_TOLERANCE = 0.02
SYMMETRY_SAMPLES = 2000


@dataclass(frozen=True)
class Kind:
    """A PS15 class as furniture.

    Attributes:
        raw, nyu40: its raw category in ScanNet and that one's nyu40 id.
        catid: synset offset of the CAD category that stands for it.
        place: "wall" (its back to a wall), "floor" (anywhere) or "top" (on a table-like piece).
        measure: the canonical axis its size is given along, "x", "y" or "z".
        size_m: (low, high) extent along that axis, metres.
    """

    raw: str
    nyu40: int
    catid: str
    place: str
    measure: str
    size_m: tuple[float, float]


KINDS: dict[str, Kind] = {
    "bathtub": Kind("bathtub", 36, "02808440", "wall", "y", (1.4, 1.8)),
    "bed": Kind("bed", 4, "02818832", "wall", "y", (1.9, 2.2)),
    "chair": Kind("chair", 5, "03001627", "floor", "z", (0.80, 1.05)),
    "desk": Kind("desk", 14, "04379243", "wall", "y", (1.1, 1.7)),
    "dresser": Kind("dresser", 17, "02933112", "wall", "z", (0.8, 1.2)),
    "lamp": Kind("lamp", 35, "03636649", "floor", "z", (1.3, 1.7)),
    "monitor": Kind("monitor", 40, "03211117", "top", "y", (0.5, 0.75)),
    "night_stand": Kind("nightstand", 32, "02933112", "wall", "z", (0.5, 0.65)),
    "printer": Kind("printer", 40, "04004475", "top", "x", (0.42, 0.6)),
    "bookshelf": Kind("bookshelf", 10, "02871439", "wall", "z", (1.3, 2.0)),
    "sink": Kind("sink", 34, "04223580", "wall", "x", (0.5, 0.85)),
    "sofa": Kind("couch", 6, "04256520", "wall", "y", (1.5, 2.2)),
    "stove": Kind("stove", 38, "04330267", "wall", "z", (0.85, 0.95)),
    "table": Kind("table", 7, "04379243", "floor", "y", (0.9, 1.6)),
    "toilet": Kind("toilet", 33, "04446521", "wall", "z", (0.70, 0.85)),
}
"""PS15 class → how it stands in a room."""

SUPPORTS = ("desk", "table", "dresser")
"""What a "top" piece may stand on, in order of preference."""
SINK_RIM_M = 0.85
"""A sink that does not reach down to the floor hangs with its rim at this height."""


@dataclass(frozen=True)
class Cad:
    """A CAD model as a scene uses it.

    Attributes:
        class_name: PS15's.
        cad_id: unique name.
        mesh: in ShapeNet's frame, diagonal 1, box centre at the origin.
        scale: (3,) metres per CAD unit along the CAD axes.
        symmetry: Scan2CAD's ``__SYM_…``.
    """

    class_name: str
    cad_id: str
    mesh: trimesh.Trimesh
    scale: NDArray[np.float64]
    symmetry: str

    @property
    def half_extent(self) -> NDArray[np.float64]:
        """(3,) of the mesh's box along the CAD axes, CAD units."""
        return self.mesh.extents / 2

    @property
    def size_m(self) -> NDArray[np.float64]:
        """(3,) full extent along the canonical axes, metres."""
        turn = np.abs(R_canonical_cad(self.class_name))
        return turn @ (2 * self.half_extent * self.scale)


def make_cad(class_name: str, index: int, seed: int) -> Cad:
    """One piece of furniture, a pure function of its arguments.

    Args:
        class_name: one of PS15's.
        index, seed: as ``renderers.shapes.catalogue.make`` takes them.
    """
    if class_name in APPLIANCES:
        shape = APPLIANCES[class_name].mesh(index, seed)
    else:
        shape = make(class_name, index, seed)
    turn = R_canonical_cad(class_name)
    diagonal = math.hypot(*shape.extents)
    vertices = np.asarray(shape.vertices) @ turn / diagonal
    vertices -= (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    mesh = trimesh.Trimesh(vertices, shape.faces, process=False)

    rng = generator(seed, "rooms", "size", class_name, index)
    kind = KINDS[class_name]
    canonical = np.abs(turn) @ mesh.extents
    size = rng.uniform(*kind.size_m) / canonical["xyz".index(kind.measure)]
    size = min(size, LARGEST_M / canonical.max())
    factors = rng.uniform(*STRETCH, 3)
    symmetry = rotational_symmetry(mesh, generator(seed, "rooms", "symmetry", class_name, index))
    if symmetry in ("__SYM_ROTATE_UP_4", "__SYM_ROTATE_UP_INF"):
        factors[2] = factors[0]
    return Cad(class_name, f"{class_name}_{index}", mesh, size * factors, symmetry)


def rotational_symmetry(mesh: trimesh.Trimesh, rng: np.random.Generator) -> str:
    """The largest of Scan2CAD's symmetries about CAD y that the surface has."""
    surface = sample_surface(mesh, 10 * SYMMETRY_SAMPLES, rng)
    tree = cKDTree(surface)

    def maps_onto_itself(degrees: float) -> bool:
        turn = portable.axis_rotation("y", np.deg2rad(degrees))
        turned = portable.product(surface[:SYMMETRY_SAMPLES], turn.T)
        return bool(np.percentile(tree.query(turned)[0], 99) < SYMMETRY_TOLERANCE)

    if not maps_onto_itself(180):
        return "__SYM_NONE"
    if not maps_onto_itself(90):
        return "__SYM_ROTATE_UP_2"
    return "__SYM_ROTATE_UP_INF" if maps_onto_itself(37) else "__SYM_ROTATE_UP_4"
