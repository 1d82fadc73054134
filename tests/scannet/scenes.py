"""A small scan with known truth, written by hand: a floor, and boxes with labels, as text PLY.

It shares no code with the readers under test, nor with the simulated rooms' writer.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

LABEL_MAP = """id\traw_category\tcategory\tcount\tnyu40id\tModelNet40\tShapeNetCore55
1\twall\twall\t9\t1\t\t
3\tfloor\tfloor\t9\t2\t\t
2\tchair\tchair\t9\t5\tchair\tchair
4\ttable\ttable\t9\t7\ttable\ttable
14\tdesk\tdesk\t9\t14\tdesk\ttable
50\tprinter\tprinter\t9\t40\t\tprinter
51\ttrash can\ttrash can\t9\t39\t\ttrash_bin
1200\tarmchair\tchair\t9\t5\tchair\tchair
"""
NYU40 = {"wall": 1, "floor": 2, "chair": 5, "table": 7, "desk": 14, "printer": 40, "trash can": 39}
CHAIR, TABLE, PRINTER, BIN = "03001627", "04379243", "04004475", "02747177"


@dataclass
class Thing:
    """A box with a back: full size in metres (canonical axes), its place, and its annotation."""

    raw: str
    catid: str
    size: tuple[float, float, float]
    at: tuple[float, float]
    yaw: float = 0.0
    sym: str = "__SYM_NONE"
    stretch: tuple[float, float, float] = (1.3, 0.8, 1.1)
    annotated: bool = True
    overrides: dict = field(default_factory=dict)
    detail: int = 4

    def mesh(self) -> trimesh.Trimesh:
        """In the scan frame: a seat of half height and a thin back at canonical +y."""
        x, y, z = self.size
        seat = trimesh.creation.box((x, y, z / 2))
        seat.apply_translation((0, 0, -z / 4))
        back = trimesh.creation.box((x, y / 10, z))
        back.apply_translation((0, 0.45 * y, 0))
        mesh = trimesh.util.concatenate(seat, back)
        for _ in range(self.detail):
            mesh = mesh.subdivide()
        mesh.vertices = mesh.vertices @ self.R().T + self.centre()
        return mesh

    def R(self) -> np.ndarray:
        return Rotation.from_euler("z", self.yaw).as_matrix()

    def centre(self) -> np.ndarray:
        return np.array([*self.at, self.size[2] / 2])


# Hand-written turns: columns are the CAD's x, y, z seen in the canonical frame.
CAD_AXES = {
    CHAIR: np.array([[-1, 0, 0], [0, 0, 1], [0, 1, 0]]),
    PRINTER: np.array([[-1, 0, 0], [0, 0, 1], [0, 1, 0]]),
    TABLE: np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    BIN: np.array([[-1, 0, 0], [0, 0, 1], [0, 1, 0]]),
}


def write_scene(root: Path, scene_id: str, things: list[Thing], segmented: bool = False) -> dict:
    """Write the scene's files under root/scans; returns its annotation."""
    folder = root / "scans" / scene_id
    folder.mkdir(parents=True)
    (root / "scannetv2-labels.combined.tsv").write_text(LABEL_MAP)
    meshes, raws = [floor(), *(t.mesh() for t in things)], ["floor", *(t.raw for t in things)]
    whole = trimesh.util.concatenate(meshes)
    owner = np.repeat(np.arange(len(meshes)), [len(m.vertices) for m in meshes])
    labels = np.array([NYU40[raw] for raw in raws])[owner]
    write_ply(folder / f"{scene_id}_vh_clean_2.ply", whole.vertices, whole.faces)
    write_ply(folder / f"{scene_id}_vh_clean_2.labels.ply", whole.vertices, whole.faces, labels)
    if segmented:
        groups = [
            {"id": i, "objectId": i, "segments": [10 * i + 3], "label": raw}
            for i, raw in enumerate(raws)
        ]
        (folder / f"{scene_id}_vh_clean_2.0.010000.segs.json").write_text(
            json.dumps({"segIndices": (10 * owner + 3).tolist()})
        )
        (folder / f"{scene_id}.aggregation.json").write_text(json.dumps({"segGroups": groups}))
    return annotate(scene_id, things)


def floor() -> trimesh.Trimesh:
    """6 × 6 m at z = 0 with a vertex every 12 cm."""
    steps = np.arange(-3, 3.01, 0.12)
    x, y = np.meshgrid(steps, steps, indexing="ij")
    index = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (
        i.ravel() for i in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:])
    )
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    return trimesh.Trimesh(vertices, faces, process=False)


def annotate(scene_id: str, things: list[Thing]) -> dict:
    """Scan2CAD's entry: the world is the scan turned by −90° about x and moved."""
    R_world = Rotation.from_euler("x", -90, degrees=True)
    t_world = np.array([0.3, -0.7, 1.9])
    models = []
    for thing in (t for t in things if t.annotated):
        axes = CAD_AXES.get(thing.catid, CAD_AXES[CHAIR])
        scale = np.array(thing.stretch)
        half = np.abs(axes.T @ thing.size) / 2 / scale
        offset = np.array([0.1, -0.2, 0.05])  # the CAD's box is not centred in its frame
        rotation = R_world.as_matrix() @ thing.R() @ axes
        centre = R_world.apply(thing.centre()) + t_world
        models.append({
            "trs": {
                "translation": (centre - rotation @ (scale * offset)).tolist(),
                "rotation": np.roll(Rotation.from_matrix(rotation).as_quat(), 1).tolist(),
                "scale": scale.tolist(),
            },
            "bbox": half.tolist(), "center": offset.tolist(), "sym": thing.sym,
            "catid_cad": thing.catid, "id_cad": "cad", **thing.overrides,
        })  # fmt: skip
    quaternion = np.roll(R_world.as_quat(), 1).tolist()
    trs = {"translation": t_world.tolist(), "rotation": quaternion, "scale": [1.0, 1.0, 1.0]}
    return {"id_scan": scene_id, "trs": trs, "aligned_models": models}


def write_ply(path: Path, vertices, faces, labels=None) -> None:
    """Text PLY with float32 coordinates."""
    head = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    head += [f"property float {c}" for c in "xyz"]
    head += [] if labels is None else ["property ushort label"]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    rows = [" ".join(f"{v:.7g}" for v in p) for p in vertices]
    if labels is not None:
        rows = [f"{row} {label}" for row, label in zip(rows, labels, strict=True)]
    rows += [f"3 {a} {b} {c}" for a, b, c in faces]
    path.write_text("\n".join([*head, *rows]) + "\n")


def write_annotations(root: Path, entries: list) -> Path:
    path = root / "full_annotations.json"
    path.write_text(json.dumps(entries))
    return path


def relabel(scene: Path, old: int, new: int) -> int:
    """Replace a label in a scene's text PLY; returns how many vertices had it."""
    path = scene / f"{scene.name}_vh_clean_2.labels.ply"
    head, body = path.read_text().split("end_header\n")
    rows = body.splitlines()
    count = int(head.split("element vertex ")[1].split()[0])
    changed = [
        row[: -len(f" {old}")] + f" {new}" if i < count and row.endswith(f" {old}") else row
        for i, row in enumerate(rows)
    ]
    path.write_text(head + "end_header\n" + "\n".join(changed) + "\n")
    return sum(a != b for a, b in zip(rows, changed, strict=True))
