"""The BOP benchmark's layout, for object pose estimators: depth images, true poses, models.

Source: the format as https://bop.felk.cvut.cz/datasets/ and the benchmark's toolkit define it:
millimetres, one unit of ours being 1,000; ``cam_R_m2c`` and ``cam_t_m2c`` from model to camera,
x right, y down, z forward as ours; a pixel's centre is its integer index there and half a pixel
further here, so principal points move by −0.5. A scene is a shard, an image a row, and a model an
object: ``objects.json`` says which.
"""

from __future__ import annotations

import io
import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from partialbench import extras
from partialbench.dataset import card
from partialbench.dataset.export.parts import Done, Origin, Part
from partialbench.dataset.manifest import Manifest, ShardEntry
from partialbench.dataset.objects import stored_id
from partialbench.dataset.sources import ObjectRef
from partialbench.errors import InputError
from partialbench.geometry.symmetry import GROUPS, Symmetry

MM_PER_UNIT = 1000.0
FINEST_DEPTH_MM = 0.1
"""Millimetres a step of the 16-bit depth images, where they reach as far."""


def require_depth(folder: Path, manifest: Manifest) -> None:
    """Raises ``InputError`` for a folder without depth images."""
    occluder = manifest.configuration["occluder"]
    if occluder.get("keep_depth"):
        return
    hint = "render it with --keep-depth"
    if occluder["name"] != "mitsuba":
        hint = "its clouds are made of points, without images: choose parquet or webdataset"
    raise InputError(f"{folder} has no depth images, which a BOP data set is made of; {hint}")


def parts(origin: Origin) -> list[Part]:
    """A scene a shard (test/000000), and the models."""
    extras.load("PIL")
    manifest = origin.manifest
    numbers = object_numbers(origin)
    return [
        Part("models", 0, partial(_write_models, origin)),
        *(
            Part(f"{split}/{number:06d}", entry.rows, partial(_write, origin, entry, numbers))
            for split in manifest.splits()
            for number, entry in enumerate(origin.shards(split))
        ),
    ]


def object_numbers(origin: Origin) -> dict[tuple[str, bytes], int]:
    """(split, object_id as stored) → obj_id, counted from 1 in listing order."""
    refs = _refs(origin)
    return {(r.split, stored_id(r.object_id)): n for n, r in enumerate(refs, start=1)}


def _refs(origin: Origin) -> list[ObjectRef]:
    """The objects that have rows, in the source's order."""
    assert origin.source is not None
    used = {
        (split, name)
        for split in origin.manifest.splits()
        for entry in origin.shards(split)
        for name in origin.column(entry, "object_id")
    }
    found = [
        ref
        for split in origin.manifest.splits()
        for ref in origin.source.objects(split)
        if (split, stored_id(ref.object_id)) in used
    ]
    if len(found) != len(used):
        raise InputError(
            f"the source lists {len(found)} of the {len(used)} objects of {origin.folder}; give "
            f"the --source it was made from"
        )
    return found


def finish(origin: Origin, done: list[Done]) -> dict[str, bytes]:
    """The card, which object each model is, and the test images' targets."""
    refs = _refs(origin)
    names = origin.manifest.class_names
    objects = {
        str(number): {"split": r.split, "object_id": r.object_id, "class": names[r.label]}
        for number, r in enumerate(refs, start=1)
    }
    numbers, targets = object_numbers(origin), []
    for scene, entry in enumerate(origin.shards("test")):
        ids = origin.column(entry, "object_id")
        targets += [
            {"scene_id": scene, "im_id": im, "obj_id": numbers["test", name], "inst_count": 1}
            for im, name in enumerate(ids)
        ]
    return {
        "dataset_info.md": card.card_text(origin.folder, origin.manifest).encode(),
        "objects.json": _json(objects),
        **({"test_targets_bop19.json": _json(targets)} if targets else {}),
    }


def _write(
    origin: Origin, entry: ShardEntry, numbers: dict[tuple[str, bytes], int], scene: Path
) -> None:
    from PIL import Image

    columns = origin.columns(entry)
    cameras, truths = {}, {}
    (scene / "depth").mkdir(parents=True)
    for im, image in enumerate(columns["depth"]):
        farthest = float(image.max()) * MM_PER_UNIT
        scale = max(FINEST_DEPTH_MM, farthest / 65535)
        steps = np.rint(image.astype(np.float64) * MM_PER_UNIT / scale).astype(np.uint16)
        content = io.BytesIO()
        Image.fromarray(steps).save(content, "png", compress_level=1)
        (scene / "depth" / f"{im:06d}.png").write_bytes(content.getvalue())
        K = columns["K"][im].copy()
        K[:2, 2] -= 0.5
        cameras[str(im)] = {"cam_K": K.ravel().tolist(), "depth_scale": scale}
        truths[str(im)] = [
            {
                "cam_R_m2c": columns["R_camera_object"][im].ravel().tolist(),
                "cam_t_m2c": (columns["t_camera_object"][im] * MM_PER_UNIT).tolist(),
                "obj_id": numbers[entry.split, columns["object_id"][im]],
            }
        ]
    (scene / "scene_camera.json").write_bytes(_json(cameras))
    (scene / "scene_gt.json").write_bytes(_json(truths))


def _write_models(origin: Origin, folder: Path) -> None:
    assert origin.source is not None
    trimesh = extras.load("trimesh")
    symmetries = _symmetries(origin)
    folder.mkdir(parents=True)
    info = {}
    for number, ref in enumerate(_refs(origin), start=1):
        mesh = origin.source.load(ref)
        if not isinstance(mesh, trimesh.Trimesh):
            raise InputError(
                f"{ref.location} is a {type(mesh).__name__}; a BOP data set has meshes as models"
            )
        vertices = np.asarray(mesh.vertices, np.float64) * MM_PER_UNIT
        model = trimesh.Trimesh(vertices, mesh.faces, process=False, validate=False)
        (folder / f"obj_{number:06d}.ply").write_bytes(model.export(file_type="ply"))
        group = symmetries[ref.split, stored_id(ref.object_id)]
        info[str(number)] = {**_extent(vertices[np.unique(mesh.faces)]), **as_symmetries(group)}
    (folder / "models_info.json").write_bytes(_json(info))


def _symmetries(origin: Origin) -> dict[tuple[str, bytes], Symmetry]:
    """Of every object, as its rows have it."""
    found = {}
    for split in origin.manifest.splits():
        for entry in origin.shards(split):
            names, groups = (origin.column(entry, name) for name in ("object_id", "symmetry"))
            for name, group in zip(names, groups, strict=True):
                found[split, name] = GROUPS[group.decode()]
    return found


def as_symmetries(group: Symmetry) -> dict[str, Any]:
    """A group as models_info.json has it: transformations (16 numbers, row by row) and axes."""
    found: dict[str, Any] = {}
    turns = []
    for element in group.elements[1:]:
        matrix = np.eye(4)
        matrix[:3, :3] = element
        turns.append(matrix.ravel().tolist())
    if turns:
        found["symmetries_discrete"] = turns
    if group.continuous:
        found["symmetries_continuous"] = [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]
    return found


def _extent(vertices: NDArray[np.float64]) -> dict[str, float]:
    """Box and diameter (the largest distance between two vertices) in millimetres."""
    from scipy.spatial import ConvexHull, QhullError
    from scipy.spatial.distance import cdist

    low, high = vertices.min(axis=0), vertices.max(axis=0)
    try:
        outer = vertices[ConvexHull(vertices).vertices]
    except QhullError:  # flat
        outer = np.unique(vertices, axis=0)
    diameter = max(
        float(cdist(outer[start : start + 1000], outer).max())
        for start in range(0, len(outer), 1000)
    )
    box = {f"min_{axis}": float(low[i]) for i, axis in enumerate("xyz")}
    size = {f"size_{axis}": float((high - low)[i]) for i, axis in enumerate("xyz")}
    return {"diameter": diameter, **box, **size}


def _json(data: Any) -> bytes:
    return (json.dumps(data, indent=1) + "\n").encode()
