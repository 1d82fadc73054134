"""Every family by its class name, in ModelNet40's order."""

from __future__ import annotations

import difflib

from partialbench.dataset.categories import MODELNET40
from partialbench.errors import InputError
from renderers.shapes import (
    aircraft,
    bathing,
    bedroom,
    cabinets,
    desks,
    electronics,
    hearths,
    instruments,
    lighting,
    markers,
    seating,
    vessels,
)
from renderers.shapes.family import Family

_LISTED: tuple[Family, ...] = (
    aircraft.airplane,
    bathing.bathtub,
    bedroom.bed,
    bedroom.dresser,
    cabinets.night_stand,
    cabinets.tv_stand,
    cabinets.wardrobe,
    desks.desk,
    electronics.laptop,
    electronics.monitor,
    electronics.radio,
    electronics.xbox,
    hearths.mantel,
    hearths.range_hood,
    instruments.guitar,
    lighting.lamp,
    markers.cone,
    seating.chair,
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
