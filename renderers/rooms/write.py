"""A simulated scan in the official file formats of ScanNet and Scan2CAD.

The scan is written in a frame of its own (the room turned about z and moved), and Scan2CAD's world
is y up, as in the real annotations, so that a reader has to follow every transform.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from partialbench.geometry import portable
from renderers.rooms.furniture import KINDS
from renderers.rooms.layout import Room
from renderers.rooms.scan import FLOOR, WALL, Scan

SEGMENT_M = 0.25
"""Segments are the parts of a piece (or of a wall, of the floor) in one cell of this size."""
MIN_ANNOTATED = 50
"""Pieces that the scan shows with fewer vertices than this are not annotated."""
_STRUCTURE = {WALL: ("wall", 1), FLOOR: ("floor", 2)}

_COLUMNS = (
    "id", "raw_category", "category", "count", "nyu40id", "eigen13id", "nyuClass", "nyu40class",
    "eigen13class", "ModelNet40", "ModelNet10", "ShapeNetCore55", "synsetoffset", "wnsynsetid",
    "wnsynsetkey", "mpcat40", "mpcat40index",
)  # fmt: skip


def write_scene(
    folder: Path, room: Room, scan: Scan, rng: np.random.Generator
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Write one scene's files into an existing folder named after the scene.

    Returns:
        Scan2CAD's entry for the scene, and the truth: for every annotated piece its index there,
        class, R_scan_object, box centre and half extent (canonical axes, metres), vertices seen.
    """
    scene_id = folder.name
    T_scan_room = np.eye(4)
    T_scan_room[:3, :3] = portable.axis_rotation("z", rng.uniform(-np.pi, np.pi))
    T_scan_room[:3, 3] = rng.uniform((-2, -2, -0.1), (2, 2, 0.1))
    vertices = portable.product(scan.vertices, T_scan_room[:3, :3].T) + T_scan_room[:3, 3]
    labels = np.zeros(len(vertices), np.uint16)
    colours = np.full((len(vertices), 3), 128, np.uint8)
    for owner in np.unique(scan.piece[scan.piece >= WALL]).tolist():
        labels[scan.piece == owner] = _names(owner, room)[1]
        colours[scan.piece == owner] = 64 + 37 * (owner + 3) * np.array([1, 3, 5]) % 160
    _write_ply(folder / f"{scene_id}_vh_clean_2.ply", vertices, colours, scan.faces, None)
    _write_ply(folder / f"{scene_id}_vh_clean_2.labels.ply", vertices, colours, scan.faces, labels)
    _write_segments(folder, scene_id, room, scan)
    T_room_scan = np.eye(4)
    T_room_scan[:3, :3] = T_scan_room[:3, :3].T
    T_room_scan[:3, 3] = -portable.apply(T_room_scan[:3, :3], T_scan_room[:3, 3])
    alignment = " ".join(f"{v:.6f}" for v in T_room_scan.ravel())
    (folder / f"{scene_id}.txt").write_text(
        f"axisAlignment = {alignment}\nsceneType = {room.room_type}\n"
    )
    return _annotation(scene_id, room, scan, T_scan_room, rng)


def _names(owner: int, room: Room) -> tuple[str, int]:
    """The raw category and nyu40 id of a piece, of the walls or of the floor."""
    if owner in _STRUCTURE:
        return _STRUCTURE[owner]
    kind = KINDS[room.pieces[owner].cad.class_name]
    return kind.raw, kind.nyu40


def _write_ply(
    path: Path, vertices: NDArray, colours: NDArray, faces: NDArray, labels: NDArray | None
) -> None:
    fields = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"),
              ("blue", "u1"), ("alpha", "u1")]  # fmt: skip
    if labels is not None:
        fields.append(("label", "<u2"))
    rows = np.zeros(len(vertices), fields)
    for i, name in enumerate("xyz"):
        rows[name] = vertices[:, i]
    for i, name in enumerate(("red", "green", "blue")):
        rows[name] = colours[:, i]
    rows["alpha"] = 255
    if labels is not None:
        rows["label"] = labels
    triangles = np.zeros(len(faces), [("n", "u1"), ("v", "<i4", 3)])
    triangles["n"], triangles["v"] = 3, faces
    types = {"<f4": "float", "u1": "uchar", "<u2": "ushort"}
    header = "\n".join(
        ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}",
         *(f"property {types[kind]} {name}" for name, kind in fields),
         f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    )  # fmt: skip
    path.write_bytes(header.encode() + rows.tobytes() + triangles.tobytes())


def _write_segments(folder: Path, scene_id: str, room: Room, scan: Scan) -> None:
    cell = np.floor(scan.vertices / SEGMENT_M).astype(np.int64)
    _, first, inverse = np.unique(
        np.column_stack([scan.piece, cell]), axis=0, return_index=True, return_inverse=True
    )
    # As in ScanNet, a segment is named after one of its vertices.
    segments = first[inverse.reshape(-1)]
    groups: list[dict[str, Any]] = []
    for owner in np.unique(scan.piece[scan.piece >= WALL]).tolist():
        groups.append({
            "id": len(groups), "objectId": len(groups), "label": _names(owner, room)[0],
            "segments": np.unique(segments[scan.piece == owner]).tolist(),
        })  # fmt: skip
    name = f"{scene_id}_vh_clean_2.0.010000.segs.json"
    _write_json(folder / name, {"sceneId": scene_id, "segIndices": segments.tolist()})
    _write_json(
        folder / f"{scene_id}.aggregation.json",
        {"sceneId": f"scannet.{scene_id}", "segGroups": groups, "segmentsFile": f"scannet.{name}"},
    )


def _annotation(
    scene_id: str, room: Room, scan: Scan, T_scan_room: NDArray, rng: np.random.Generator
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    # Scan2CAD's world is the scan laid over: its y is up, its origin somewhere near the middle.
    M_world_scan = np.eye(4)
    M_world_scan[:3, :3] = portable.axis_rotation("x", -np.pi / 2)
    M_world_scan[:3, 3] = rng.uniform(-2, 2, 3)
    models: list[dict[str, Any]] = []
    truth: list[dict[str, Any]] = []
    for index, piece in enumerate(room.pieces):
        seen = int((scan.piece == index).sum())
        if seen < MIN_ANNOTATED:
            continue
        M_scan_cad = portable.product(T_scan_room, piece.M_room_cad)
        rotation = M_scan_cad[:3, :3] / piece.cad.scale
        kind = KINDS[piece.cad.class_name]
        models.append({
            "trs": _trs(
                portable.product(M_world_scan[:3, :3], rotation),
                portable.product(M_world_scan, M_scan_cad)[:3, 3], piece.cad.scale,
            ),
            "bbox": piece.cad.half_extent.tolist(), "center": [0.0, 0.0, 0.0],
            "sym": piece.cad.symmetry, "catid_cad": kind.catid, "id_cad": piece.cad.cad_id,
        })  # fmt: skip
        truth.append({
            "scene": scene_id, "index": len(truth), "class_name": piece.cad.class_name,
            "R_scan_object": portable.product(T_scan_room[:3, :3], piece.R_room_object).tolist(),
            "centre": portable.apply(T_scan_room, np.append(piece.centre, 1.0))[:3].tolist(),
            "half_extent": (piece.cad.size_m / 2).tolist(), "vertices": seen,
        })  # fmt: skip
    entry = {
        "id_scan": scene_id, "n_aligned_models": len(models), "aligned_models": models,
        "trs": _trs(M_world_scan[:3, :3], M_world_scan[:3, 3], np.ones(3)),
    }  # fmt: skip
    return entry, truth


def _trs(rotation: NDArray, translation: NDArray, scale: NDArray) -> dict[str, list[float]]:
    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    return {"translation": translation.tolist(), "rotation": [w, x, y, z], "scale": scale.tolist()}


def write_label_map(path: Path) -> None:
    """The rows of ScanNet's label map that the rooms use, with its columns."""
    rows = [("wall", 1, "wall", "", ""), ("floor", 2, "floor", "", "")]
    for name, kind in KINDS.items():
        own = name in ("printer", "stove")
        rows.append((kind.raw, kind.nyu40, name, "" if own else name, name if own else ""))
    lines = ["\t".join(_COLUMNS)]
    for number, (raw, nyu40, category, modelnet, shapenet) in enumerate(rows, 1):
        values = {
            "id": number, "raw_category": raw, "category": category, "count": 1, "nyu40id": nyu40,
            "ModelNet40": modelnet, "ShapeNetCore55": shapenet,
        }  # fmt: skip
        lines.append("\t".join(str(values.get(column, "")) for column in _COLUMNS))
    path.write_text("\n".join(lines) + "\n")


def _write_json(path: Path, data: Any) -> None:
    path.write_text(json.dumps(data, separators=(",", ":"), allow_nan=False))
