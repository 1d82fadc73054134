"""Every family by its class name, in ModelNet40's order."""

from __future__ import annotations

import difflib

import trimesh

from partialbench.dataset.categories import MODELNET40
from partialbench.errors import InputError
from renderers.shapes import (
    aircraft,
    bathing,
    bedroom,
    benches,
    buildings,
    cabinets,
    cars,
    cases,
    crockery,
    desks,
    electronics,
    hearths,
    instruments,
    keyboards,
    lighting,
    markers,
    panels,
    people,
    pianos,
    plants,
    pots,
    sanitary,
    seating,
    sofas,
    tables,
    vases,
    vessels,
)
from renderers.shapes.family import Family

_LISTED: tuple[Family, ...] = (
    aircraft.airplane,
    bathing.bathtub,
    bedroom.bed,
    bedroom.dresser,
    benches.bench,
    buildings.stairs,
    buildings.tent,
    cabinets.night_stand,
    cabinets.tv_stand,
    cabinets.wardrobe,
    cars.car,
    cases.bookshelf,
    cases.glass_box,
    crockery.bowl,
    crockery.cup,
    desks.desk,
    electronics.laptop,
    electronics.monitor,
    electronics.radio,
    electronics.xbox,
    hearths.mantel,
    hearths.range_hood,
    instruments.guitar,
    keyboards.keyboard,
    lighting.lamp,
    markers.cone,
    panels.curtain,
    panels.door,
    people.person,
    pianos.piano,
    plants.plant,
    pots.flower_pot,
    sanitary.sink,
    sanitary.toilet,
    seating.chair,
    sofas.sofa,
    tables.stool,
    tables.table,
    vases.vase,
    vessels.bottle,
)

FAMILIES: dict[str, Family] = {
    f.name: f for f in sorted(_LISTED, key=lambda f: MODELNET40.index(f.name))
}
"""Class name → family, in label order."""


def family_of(class_name: str) -> Family:
    """The family of a class; an unknown name raises InputError with close matches."""
    if class_name in FAMILIES:
        return FAMILIES[class_name]
    near = difflib.get_close_matches(class_name, FAMILIES, n=3)
    hint = f"did you mean {' or '.join(near)}?" if near else f"there are {', '.join(FAMILIES)}"
    raise InputError(f"no shape family named {class_name!r}: {hint}")


def make(class_name: str, index: int, seed: int = 0) -> trimesh.Trimesh:
    """One object, a pure function of its arguments, bit by bit.

    Args:
        class_name: a ModelNet40 class.
        index: any whole number; `source.ParametricShapes` says which indices are test objects.

    Returns:
        A mesh in the class's aligned frame (z up), bounding-box centre at the origin, unit ball.

    Raises:
        InputError: there is no family of that name.
    """
    return family_of(class_name).mesh(index, seed)
