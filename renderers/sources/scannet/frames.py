"""Readers for the files of one ScanNet scene, each with errors that say what is wrong.

    <scene>_vh_clean_2.ply                  vertices and faces, metres, z up          required
    <scene>_vh_clean_2.labels.ply           property label: an id per vertex         ┐ one of
    <scene>_vh_clean_2.0.010000.segs.json   segIndices: a segment per vertex         ┐ the two
    <scene>.aggregation.json                segGroups: objectId, segments, label     ┘
    scannetv2-labels.combined.tsv           raw category → nyu40 id, ModelNet40 name

``<scene>_vh_clean.aggregation.json`` is not read: its segments are those of the full-resolution
mesh (``<scene>_vh_clean.segs.json``), whose numbers mean others here. The scan frame is the mesh's
own. ``<scene>.txt`` and its ``axisAlignment`` are not read: it turns
the scan about z, and Scan2CAD's poses are relative to the mesh as stored.
"""

from __future__ import annotations

import csv
import json
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.categories import PS15
from partialbench.dataset.ply import require_whole
from partialbench.errors import InputError
from renderers.sources.formats.ply import read_with
from renderers.sources.scannet.labels import decide_numbering, to_nyu40

LABEL_MAP = "scannetv2-labels.combined.tsv"

# A class's nyu40 ids are those that hold at least this share of its raw categories' instances: it
# keeps "bookshelf" and "shelves" for bookshelf and drops "otherfurniture" for bed (one bunk bed).
NYU40_SHARE = 0.05

SAME_PLACE_M = 0.01
"""So far may a labelled vertex be from the mesh's; in ScanNet they are the same to the last bit."""


@dataclass(frozen=True)
class LabelMap:
    """``scannetv2-labels.combined.tsv`` as far as PS15 needs it.

    Attributes:
        class_of: raw category → PS15 class name.
        nyu40_of: raw category → nyu40 id.
        nyu40_of_id: ScanNet's own category id (column "id") → nyu40 id.
        nyu40_ids: PS15 class name → the nyu40 ids its instances carry.
    """

    class_of: dict[str, str]
    nyu40_of: dict[str, int]
    nyu40_of_id: dict[int, int]
    nyu40_ids: dict[str, frozenset[int]]


@dataclass(frozen=True)
class SegmentGroup:
    """One annotated object of an aggregation file: its segments and raw category."""

    object_id: int
    label: str
    segments: NDArray[np.int64]


@dataclass
class Scene:
    """One scan.

    Attributes:
        scene_id: e.g. "scene0470_00".
        vertices: (n,3) float64, metres, scan frame, z up.
        faces: (f,3) int64.
        normals: (n,3) float64 unit vertex normals (zero where a vertex has no face).
        labels: (n,) int64 nyu40 ids, 0 = unlabelled; of a scene without segmentation that
            ``settle_labels`` has not seen, the labels file's own numbers.
        groups: the annotated objects, or None where the scene came without segmentation files.
        segments: (n,) int64 segment of each vertex, or None likewise.
        notes: by what the labels were read, and what that changed.
    """

    scene_id: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    normals: NDArray[np.float64]
    labels: NDArray[np.int64]
    groups: list[SegmentGroup] | None
    segments: NDArray[np.int64] | None
    notes: dict[str, Any]


def read_label_map(path: Path) -> LabelMap:
    """The label map; InputError when it is absent or lacks a column.

    A raw category's PS15 class is its ModelNet40 column; printer and stove, which ModelNet40 does
    not have, go by the ShapeNetCore55 column.
    """
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file, delimiter="\t")
            columns = {"id", "raw_category", "nyu40id", "ModelNet40", "ShapeNetCore55", "count"}
            if absent := sorted(columns - set(reader.fieldnames or ())):
                raise InputError(f"{path} lacks the column(s) {', '.join(absent)}")
            rows = list(reader)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(
            f"cannot read ScanNet's label map {path}: {error}. It is part of the ScanNet download: "
            f"put it into the --scannet folder, beside scans/, or give --label-map"
        ) from error
    class_of: dict[str, str] = {}
    nyu40_of: dict[str, int] = {}
    nyu40_of_id: dict[int, int] = {}
    counts: dict[str, Counter[int]] = {name: Counter() for name in PS15}
    for line, row in enumerate(rows, 2):
        try:
            nyu40, count = int(row["nyu40id"]), int(row["count"])
            nyu40_of_id[int(row["id"])] = nyu40
        except (TypeError, ValueError) as error:
            raise InputError(f"{path}, line {line}: expected numbers: {error}") from error
        raw = row["raw_category"]
        nyu40_of[raw] = nyu40
        name = row["ModelNet40"] if row["ModelNet40"] in PS15 else row["ShapeNetCore55"]
        if name in PS15 and (row["ModelNet40"] in PS15 or name in ("printer", "stove")):
            class_of[raw] = name
            counts[name][nyu40] += count
    nyu40_ids = {
        name: frozenset(i for i, n in found.items() if n >= NYU40_SHARE * found.total())
        for name, found in counts.items()
    }
    return LabelMap(class_of, nyu40_of, nyu40_of_id, nyu40_ids)


def scene_folder(root: Path, scene_id: str) -> Path | None:
    """``root/scans/<scene>`` or ``root/<scene>``, whichever is there."""
    for folder in (root / "scans" / scene_id, root / scene_id):
        if folder.is_dir():
            return folder
    return None


def scene_files(folder: Path) -> dict[str, Path]:
    """The files of a scene that are there: mesh, labels, segments, aggregation."""
    scene = folder.name
    names = {
        "mesh": f"{scene}_vh_clean_2.ply",
        "labels": f"{scene}_vh_clean_2.labels.ply",
        "segments": f"{scene}_vh_clean_2.0.010000.segs.json",
        "aggregation": f"{scene}.aggregation.json",
    }
    return {kind: folder / name for kind, name in names.items() if (folder / name).is_file()}


def read_scene(folder: Path, label_map: LabelMap) -> Scene:
    """One scene from its folder.

    Raises:
        InputError: the mesh is missing, or both the labels and the segmentation are; a file is
            damaged or does not fit the mesh.
    """
    scene_id, files = folder.name, scene_files(folder)
    if "mesh" not in files:
        raise InputError(f"{scene_id}: {scene_id}_vh_clean_2.ply is missing")
    segmented = "segments" in files and "aggregation" in files
    if "labels" not in files and not segmented:
        raise InputError(
            f"{scene_id}: neither {scene_id}_vh_clean_2.labels.ply nor both of "
            f"{scene_id}_vh_clean_2.0.010000.segs.json and {scene_id}.aggregation.json are there"
        )
    vertices, faces, _ = _read_mesh(files["mesh"])
    if not np.isfinite(vertices).all():
        raise InputError(f"{files['mesh'].name}: has vertices that are not finite")
    notes: dict[str, Any] = {}
    groups = segments = None
    if segmented:
        segments = _read_segments(files["segments"], len(vertices))
        groups = _read_groups(files["aggregation"])
        _require_segments(files["aggregation"], groups, segments, notes)
    raw = _read_labels(files["labels"], len(vertices)) if "labels" in files else None
    if segments is not None:
        assert groups is not None
        labels = _labels_of_groups(groups, segments, label_map, notes)
    else:
        assert raw is not None
        labels, places = raw
        _require_same_places(files["labels"], places, vertices)
    normals = _normals(vertices, faces)
    return Scene(scene_id, vertices, faces, normals, labels, groups, segments, notes)


def _read_mesh(
    path: Path, names: tuple[str, ...] = ()
) -> tuple[NDArray[np.float64], NDArray[np.int64], dict[str, NDArray]]:
    """Vertices (n,3), metres, and triangles (f,3) of a scan, f ≥ 1; and of these properties of its
    vertices those that ``read_with`` finds."""
    try:
        content = path.read_bytes()
        require_whole(content)
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from error
    except OSError as error:
        raise InputError(f"{path.name}: cannot be read: {error}") from error
    try:
        polygons, beside = read_with(content, names)
        return polygons.vertices, polygons.triangles()[0], beside
    except Exception as error:  # a damaged file surfaces in the parser as almost anything
        raise InputError(f"{path.name}: damaged PLY ({error})") from error


def _normals(vertices: NDArray, faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Area-weighted vertex normals (trimesh's own weigh by angle, an order of magnitude slower)."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    across = np.cross(b - a, c - a)
    total = np.stack(
        [np.bincount(faces.ravel(), np.repeat(across[:, i], 3), len(vertices)) for i in range(3)],
        axis=1,
    )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.divide(total, length, out=np.zeros_like(total), where=length > 0)


def _require_segments(
    path: Path, groups: list[SegmentGroup], segments: NDArray[np.int64], notes: dict[str, Any]
) -> None:
    """``InputError`` where the objects' segments are another mesh's; a note where some are."""
    named = np.unique(np.concatenate([*(g.segments for g in groups), np.zeros(0, np.int64)]))
    absent = named[~np.isin(named, segments)]
    if len(absent) and len(absent) == len(named):
        raise InputError(
            f"{path.name}: names the segments {', '.join(map(str, absent[:3].tolist()))}, …, none "
            f"of which the mesh has; expected the aggregation of its own segs.json"
        )
    if len(absent):
        notes["segments_absent"] = len(absent)


def _labels_of_groups(
    groups: list[SegmentGroup],
    segments: NDArray[np.int64],
    label_map: LabelMap,
    notes: dict[str, Any],
) -> NDArray[np.int64]:
    """nyu40 ids by the annotated objects' names: names have one meaning, numbers may have two."""
    labels = np.zeros(len(segments), np.int64)
    for group in groups:
        members = np.isin(segments, group.segments)
        labels[members] = label_map.nyu40_of.get(group.label, 0)
        if group.label not in label_map.nyu40_of:
            unknown = notes.setdefault("labels_unknown", {})
            unknown[group.label] = unknown.get(group.label, 0) + int(members.sum())
    return labels


def _read_labels(path: Path, vertices: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The file's own numbers, whatever they mean, and where (n,3) its vertices are, metres."""
    places, _, beside = _read_mesh(path, ("label",))
    if "label" not in beside:
        raise InputError(f"{path.name}: its vertices have no property 'label' of one number")
    numbers = beside["label"]
    with np.errstate(invalid="ignore"):  # what is not finite is no whole number either
        labels = numbers.astype(np.int64)
    if (broken := labels != numbers).any():
        raise InputError(f"{path.name}: a label is no whole number: {numbers[broken][0]}")
    if len(labels) != vertices:
        raise InputError(f"{path.name}: labels {len(labels)} vertices, the mesh has {vertices}")
    return labels, places


def _require_same_places(path: Path, places: NDArray, vertices: NDArray) -> None:
    """``InputError`` where the vertices (n,3) that are labelled are not the mesh's, one by one.

    Another mesh, or this one in another order, may have as many.
    """
    off = np.linalg.norm(places - vertices, axis=1)
    if not (off <= SAME_PLACE_M).all():  # NaN is nowhere
        k = int(np.argmax(~(off <= SAME_PLACE_M)))
        raise InputError(
            f"{path.name}: vertex {k} is at {places[k].round(3).tolist()}, the mesh's vertex {k} "
            f"at {vertices[k].round(3).tolist()}; expected the labels of this mesh, in its order"
        )


def settle_labels(
    scene: Scene,
    boxes: list[tuple[NDArray[np.int64], frozenset[int]]],
    label_map: LabelMap,
    numbering: str = "auto",
) -> Scene:
    """The scene with nyu40 ids for labels; ``notes["labels"]`` says by what.

    Args:
        boxes: as ``labels.decide_numbering`` takes them; for scenes without segmentation.
        numbering: "nyu40" or "scannet" for what the labels file holds, or "auto" to decide.
    """
    if scene.groups is not None:
        return replace(scene, notes={"labels": "aggregation", **scene.notes})
    if numbering == "auto":
        try:
            numbering, votes = decide_numbering(
                scene.labels, scene.vertices, scene.normals, boxes, label_map.nyu40_of_id
            )
        except InputError as error:
            raise InputError(f"{scene.scene_id}_vh_clean_2.labels.ply: {error}") from error
    else:
        votes = {}
    labels, changed = to_nyu40(scene.labels, numbering, label_map.nyu40_of_id)
    notes = {"labels": numbering, **({"votes": votes} if votes else {}), **scene.notes, **changed}
    return replace(scene, labels=labels, notes=notes)


def _read_json(path: Path, key: str) -> Any:
    try:
        return json.loads(path.read_bytes())[key]
    except OSError as error:
        raise InputError(f"{path.name}: cannot be read: {error}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path.name}: damaged, expected JSON with the key {key!r}") from error


def _read_segments(path: Path, vertices: int) -> NDArray[np.int64]:
    data = _read_json(path, "segIndices")
    try:
        segments = _whole(data)
    except (TypeError, ValueError) as error:
        raise InputError(f"{path.name}: segIndices are not integers ({error})") from error
    if segments.shape != (vertices,):
        raise InputError(
            f"{path.name}: segIndices has shape {segments.shape}, the mesh has {vertices} vertices"
        )
    return segments


def _whole(numbers: Any) -> NDArray[np.int64]:
    found = np.asarray(numbers, np.int64)
    if (odd := found != np.asarray(numbers, np.float64)).any():
        raise ValueError(f"{np.asarray(numbers)[odd][0]} is no whole number")
    return found


def _read_groups(path: Path) -> list[SegmentGroup]:
    data = _read_json(path, "segGroups")
    try:
        return [
            SegmentGroup(
                # A segment that is named twice is there once.
                int(group["objectId"]),
                str(group["label"]),
                np.unique(_whole(group["segments"])),
            )
            for group in data
        ]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path.name}: a segGroup lacks objectId, label or integer segments ({error})"
        ) from error
