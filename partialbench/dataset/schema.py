"""The shard schema as data: the writer, the reader, ``verify`` and the docs all read this table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

FORMAT = "partialbench-shards"
FORMAT_VERSION = 2
READABLE = (1, FORMAT_VERSION)
"""What is read. Format 1 had the table of objects inside each shard; folders of it are complete or
stay as they are."""
OBJECT_ID_BYTES = 96


@dataclass(frozen=True)
class Field:
    """One data set of a shard, one entry per row.

    Attributes:
        shape: per row; "P" stands for the points of a row, "H" and "W" for the image size.
        dtype: as stored.
        frame, unit: of the values; "" where they have none.
        optional: whether a shard may lack it. The row digest does not cover such a field.
    """

    name: str
    shape: tuple[int | str, ...]
    dtype: np.dtype
    frame: str
    unit: str
    meaning: str
    optional: bool = False


def _field(name: str, shape: tuple[int | str, ...], dtype: str, frame: str, unit: str,
           meaning: str, optional: bool = False) -> Field:  # fmt: skip
    return Field(name, shape, np.dtype(dtype), frame, unit, meaning, optional)


FIELDS: tuple[Field, ...] = (
    _field("points", ("P", 3), "<f4", "camera", "object units",
           "seen surface points in random order, drawn without replacement; where fewer were seen, "
           "all of them first and repeats after"),
    _field("label", (), "<i4", "", "", "index into the manifest's class_names"),
    _field("object_id", (), f"S{OBJECT_ID_BYTES}", "", "",
           "the source's name for the object, UTF-8, unique within a split; where it does not fit, "
           "its beginning and a hash (objects.jsonl has the whole)"),
    _field("view", (), "<i4", "", "", "index of the viewpoint among the object's"),
    _field("R_camera_object", (3, 3), "<f8", "camera ← object", "", "p_camera = R·p_object + t"),
    _field("t_camera_object", (3,), "<f8", "camera ← object", "object units", "the t of the same"),
    _field("K", (3, 3), "<f8", "image", "pixels",
           "intrinsics, pixel (0,0) centred at (0.5, 0.5); zeros where no image was formed"),
    _field("visible_fraction", (), "<f4", "", "1", "share of the surface area seen"),
    _field("n_visible", (), "<i4", "", "", "distinct surface points seen before drawing"),
    _field("symmetry", (), "S8", "", "", "the object's symmetry group about its own axes"),
    _field("row_sha256", (32,), "|u1", "", "", "SHA-256 over the fields above, in this order"),
    _field("depth", ("H", "W"), "<f4", "camera", "object units",
           "z-depth image at pixel centres, 0 = no surface", optional=True),
    _field("normals", ("P", 3), "<f4", "camera", "",
           "unit normals of the surface at the points, towards the camera (n·p < 0)",
           optional=True),
    _field("occluded_fraction", (), "<f4", "", "1",
           "share of the object's pixels, or of its points in view, that other objects hide",
           optional=True),
)  # fmt: skip
"""Every field of a row, in the order in which the row digest reads them."""

_NAMES = tuple(f.name for f in FIELDS)
DIGESTED = _NAMES[: _NAMES.index("row_sha256")]
"""The fields that the row digest covers: what may be kept beside the points leaves it as it is."""


def as_markdown() -> str:
    """The row fields as a Markdown table for the docs."""
    lines = ["| field | shape | dtype | frame | unit | meaning |", "|---|---|---|---|---|---|"]
    for f in FIELDS:
        shape = "(" + ",".join(["M", *map(str, f.shape)]) + ")"
        name = f"`{f.name}`" + (" (optional)" if f.optional else "")
        dtype = f.dtype.str.removeprefix("|")  # "|S8": a bar would end the table's cell
        lines.append(f"| {name} | {shape} | `{dtype}` | {f.frame} | {f.unit} | {f.meaning} |")
    return "\n".join(lines) + "\n"
