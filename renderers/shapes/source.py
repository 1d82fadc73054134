"""The parametric families as a source of the benchmark: no download, no licence."""

from __future__ import annotations

import hashlib
from typing import Any

import trimesh

from partialbench.dataset.categories import MODELNET40
from partialbench.dataset.sources import ObjectRef, RejectedObject
from partialbench.errors import InputError
from renderers.shapes.catalogue import FAMILIES, make
from renderers.shapes.family import GENERATION

MODELNET40_COUNTS: dict[str, tuple[int, int]] = {
    "airplane": (626, 100), "bathtub": (106, 50), "bed": (515, 100), "bench": (173, 20),
    "bookshelf": (572, 100), "bottle": (335, 100), "bowl": (64, 20), "car": (197, 100),
    "chair": (889, 100), "cone": (167, 20), "cup": (79, 20), "curtain": (138, 20),
    "desk": (200, 86), "door": (109, 20), "dresser": (200, 86), "flower_pot": (149, 20),
    "glass_box": (171, 100), "guitar": (155, 100), "keyboard": (145, 20), "lamp": (124, 20),
    "laptop": (149, 20), "mantel": (284, 100), "monitor": (465, 100), "night_stand": (200, 86),
    "person": (88, 20), "piano": (231, 100), "plant": (240, 100), "radio": (104, 20),
    "range_hood": (115, 100), "sink": (128, 20), "sofa": (680, 100), "stairs": (124, 20),
    "stool": (90, 20), "table": (392, 100), "tent": (163, 20), "toilet": (344, 100),
    "tv_stand": (267, 100), "vase": (475, 100), "wardrobe": (87, 20), "xbox": (103, 20),
}  # fmt: skip
"""ModelNet40's official number of training and test objects (9,843 and 2,468 in all)."""

TEST_START = 1_000_000
"""Test objects are the indices from here on, so that no count makes the splits meet."""


class ParametricShapes:
    """Objects of the families; implements ``partialbench.dataset.sources.Source``.

    Args:
        counts: (training, test) objects of every class, or "modelnet40" for the official numbers.
        seed: another seed is another, disjoint set of objects.

    Raises:
        InputError: counts is neither.
    """

    class_names: tuple[str, ...] = MODELNET40
    frame = "aligned"

    def __init__(self, counts: tuple[int, int] | str = (100, 20), seed: int = 0) -> None:
        self.rejected: list[RejectedObject] = []
        self.seed = int(seed)
        if counts == "modelnet40":
            self.counts = {name: MODELNET40_COUNTS[name] for name in FAMILIES}
        elif (
            isinstance(counts, tuple | list)
            and len(counts) == 2
            and all(isinstance(n, int) and 0 <= n <= TEST_START for n in counts)
        ):
            self.counts = {name: (int(counts[0]), int(counts[1])) for name in FAMILIES}
        else:
            raise InputError(
                f"counts is {counts!r}: expected two whole numbers, the training and test objects "
                f"of each class, from 0 to {TEST_START:,}, or 'modelnet40'"
            )

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> ParametricShapes:
        """The source that ``describe`` described; ``InputError`` for another generation's."""
        if description["generation"] != GENERATION:
            raise InputError(
                f"the data were made with generation {description['generation']} of the shapes, "
                f"this release makes generation {GENERATION}"
            )
        source = cls(seed=description["seed"])
        source.counts = {name: (int(a), int(b)) for name, (a, b) in description["counts"].items()}
        return source

    def splits(self) -> tuple[str, ...]:
        return ("train", "test")

    def objects(self, split: str) -> list[ObjectRef]:
        """Class by class in label order; ids run on from train to test as in ModelNet40.

        Object ``chair_0007`` of the training split is index 6; ``location`` is the index.
        """
        if split not in self.splits():
            raise InputError(f"no split {split!r}: the shapes have 'train' and 'test'")
        refs: list[ObjectRef] = []
        for name, (train, test) in self.counts.items():
            start, count, first = 0, train, 1
            if split == "test":
                start, count, first = TEST_START, test, train + 1
            label = MODELNET40.index(name)
            refs.extend(
                ObjectRef(f"{name}_{first + i:04d}", label, split, str(start + i))
                for i in range(count)
            )
        return refs

    def load(self, ref: ObjectRef) -> trimesh.Trimesh:
        """The object's mesh, made anew; the same bytes every time."""
        return make(MODELNET40[ref.label], int(ref.location), self.seed)

    def digest(self, ref: ObjectRef) -> str:
        """SHA-256 of what the mesh is a pure function of."""
        key = f"shapes/{GENERATION}/{self.seed}/{MODELNET40[ref.label]}/{ref.location}"
        return hashlib.sha256(key.encode()).hexdigest()

    def describe(self) -> dict[str, Any]:
        return {
            "name": "parametric",
            "generation": GENERATION,
            "seed": self.seed,
            "counts": {name: list(pair) for name, pair in self.counts.items()},
        }
