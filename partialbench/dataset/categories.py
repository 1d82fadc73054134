"""Class names of PM40 and PS15, and the map between the classes they share."""

from __future__ import annotations

MODELNET40: tuple[str, ...] = (
    "airplane", "bathtub", "bed", "bench", "bookshelf", "bottle", "bowl", "car", "chair", "cone",
    "cup", "curtain", "desk", "door", "dresser", "flower_pot", "glass_box", "guitar", "keyboard",
    "lamp", "laptop", "mantel", "monitor", "night_stand", "person", "piano", "plant", "radio",
    "range_hood", "sink", "sofa", "stairs", "stool", "table", "tent", "toilet", "tv_stand", "vase",
    "wardrobe", "xbox",
)  # fmt: skip
"""The 40 classes of ModelNet40 in their official order; the index is the label."""

PS15: tuple[str, ...] = (
    "bathtub", "bed", "chair", "desk", "dresser", "lamp", "monitor", "night_stand", "printer",
    "bookshelf", "sink", "sofa", "stove", "table", "toilet",
)  # fmt: skip
"""The 15 classes of PS15 in release order.

The release leaves 8 and 12 unnamed. We take printer and stove: Scan2CAD categories that fit the
alphabetical order of their neighbours.
"""

PS15_TO_PM40: dict[int, int] = {
    index: MODELNET40.index(name) for index, name in enumerate(PS15) if name in MODELNET40
}
"""The 13 shared classes: PS15 label → PM40 label. Source: TerenceHsu666/PAPNet@878adcc."""
