"""Scan2CAD's ``full_annotations.json``: which CAD model stands where in which scan.

    M = T·R·S of {translation, rotation (quaternion w x y z), scale}
    p_scan = inv(M_scan) · M_cad · p_cad

CAD frames are ShapeNet's: y up, front −z. ``bbox`` is the half extent around ``center`` there.
Source: Avetisyan et al., "Scan2CAD", CVPR 2019, and the notes of its data set.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from partialbench.errors import InputError
from partialbench.geometry import portable

SYMMETRIES = {
    "__SYM_NONE": "none",
    "__SYM_ROTATE_UP_2": "z-180",
    "__SYM_ROTATE_UP_4": "z-90",
    "__SYM_ROTATE_UP_INF": "z-inf",
}
"""Scan2CAD's ``sym`` → ``geometry.symmetry.GROUPS``."""

FRONT: dict[str, str] = {
    "bathtub": "-x", "bed": "-y", "chair": "-y", "desk": "-x", "dresser": "-x", "lamp": "-y",
    "monitor": "-x", "night_stand": "-x", "printer": "-y", "bookshelf": "-y", "sink": "-y",
    "sofa": "-x", "stove": "-y", "table": "-x", "toilet": "-y",
}  # fmt: skip
"""Where the front of each class points in the canonical frame (z up).

Read off the aligned ModelNet40 clouds: the tall part of chair, bed, toilet and the flat back of
bookshelf and sink lie at +y; the back of sofa and the flat back sheet of desk, dresser and
night_stand at +x; monitors have their screen at −x. Bathtub and table have no front there but are
wide along y, as ShapeNet's are along x. Lamps have none either. Printer and stove, which ModelNet40
lacks, follow the chair.
"""

# Rows are canonical x, y, z in terms of CAD x, y, z: up is CAD y, front is CAD −z.
_TURNS = {
    "-y": np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]]),
    "-x": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
}


@dataclass(frozen=True)
class AlignedModel:
    """One CAD model of a scene.

    Attributes:
        index: position in the scene's list; names the instance.
        catid, cad_id: ShapeNet synset offset (8 digits) and model.
        symmetry: name in ``geometry.symmetry.GROUPS``.
        M_scan_cad: (4,4) float64.
        centre, half_extent: (3,) float64, CAD frame.
        problem: why it cannot be used, "" when it can.
    """

    index: int
    catid: str
    cad_id: str
    symmetry: str
    M_scan_cad: NDArray[np.float64]
    centre: NDArray[np.float64]
    half_extent: NDArray[np.float64]
    problem: str = ""


@dataclass(frozen=True)
class SceneAnnotation:
    """A scene's models, of all its entries; ``problem`` says why some or none can be used."""

    scene_id: str
    models: tuple[AlignedModel, ...]
    problem: str = ""


@dataclass(frozen=True)
class BoxPose:
    """Where an instance's canonical frame is, and its CAD's box in it.

    p_scan = R_scan_object · p_object + centre, metres on both sides: the CAD's scale is in
    ``half_extent`` and in ``stretch``, not in the pose.

    Attributes:
        R_scan_object: (3,3) float64, in SO(3).
        centre: (3,) float64 box centre in the scan frame, metres.
        half_extent: (3,) float64 box half extent along the canonical axes, metres.
        stretch: (3,) float64 metres per CAD unit along the canonical axes.
    """

    R_scan_object: NDArray[np.float64]
    centre: NDArray[np.float64]
    half_extent: NDArray[np.float64]
    stretch: NDArray[np.float64]

    def to_object(self, points: NDArray) -> NDArray[np.float64]:
        """(n,3) scan-frame points → canonical frame, metres, box centre at the origin."""
        return portable.product(points - self.centre, self.R_scan_object)


def R_canonical_cad(class_name: str) -> NDArray[np.float64]:
    """(3,3) float64 turn from ShapeNet's frame to the class's canonical frame."""
    return _TURNS[FRONT[class_name]]


def trs_matrix(trs: dict[str, Any]) -> NDArray[np.float64]:
    """(4,4) float64 T·R·S; InputError when a part is absent, not finite, or has no volume."""
    try:
        translation = np.asarray(trs["translation"], np.float64)
        w, x, y, z = np.asarray(trs["rotation"], np.float64)
        scale = np.asarray(trs["scale"], np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"trs is damaged ({type(error).__name__}: {error})") from error
    if translation.shape != (3,) or scale.shape != (3,):
        raise InputError("trs needs three numbers of translation and of scale")
    if not np.isfinite([*translation, *scale, w, x, y, z]).all():
        raise InputError("trs has values that are not finite")
    if (scale <= 0).any():
        raise InputError(f"trs has scale {scale.tolist()}, expected positive values")
    if np.linalg.norm([w, x, y, z]) < 1e-6:
        raise InputError("trs has a rotation quaternion of length zero")
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix() * scale
    matrix[:3, 3] = translation
    return matrix


def box_pose(model: AlignedModel, class_name: str, max_shear: float = 0.02) -> BoxPose:
    """The canonical pose and box of an aligned model, scale separated from rotation.

    The linear part A of M_scan_cad is split by the polar decomposition A = Q·P: Q the rotation, P
    the stretch in the CAD frame (diagonal, since M_scan is a similarity).

    Args:
        max_shear: off-diagonal share of the stretch above which the pose counts as sheared.

    Raises:
        InputError: A is mirrored, singular or sheared.
    """
    linear = model.M_scan_cad[:3, :3]
    if np.linalg.det(linear) <= 0 or np.linalg.svd(linear, compute_uv=False)[-1] < 1e-6:
        raise InputError("the CAD is mirrored or flat in the scan: its pose is no rotation")
    rotation = portable.polar_rotation(linear)
    stretch = portable.product(rotation.T, linear)
    diagonal = np.diag(stretch)
    shear = np.abs(stretch - np.diag(diagonal)).max() / diagonal.min()
    if shear > max_shear:
        raise InputError(f"the CAD is sheared in the scan by {shear:.2g} (allowed: {max_shear:g})")
    turn = R_canonical_cad(class_name)
    centre = portable.apply(linear, model.centre) + model.M_scan_cad[:3, 3]
    axes = np.abs(turn)
    return BoxPose(
        rotation @ turn.T, centre, axes @ (diagonal * model.half_extent), axes @ diagonal
    )


def read_annotations(path: Path) -> list[SceneAnnotation]:
    """Every scene of ``full_annotations.json``; damaged entries come with their ``problem``.

    Entries of one scene are joined, the later one's models numbered after the earlier one's; each
    entry's models are placed by its own ``trs``.

    Raises:
        InputError: the file cannot be read or is no list of scenes.
    """
    try:
        entries = json.loads(Path(path).read_bytes())
    except OSError as error:
        raise InputError(
            f"cannot read Scan2CAD's annotations {path}: {error}. Give --scan2cad the path of "
            f"full_annotations.json"
        ) from error
    except ValueError as error:
        raise InputError(f"{path} is not valid JSON: {error}") from error
    if not isinstance(entries, list) or not all(
        isinstance(e, dict) and isinstance(e.get("id_scan"), str) for e in entries
    ):
        raise InputError(f"{path} is no list of scenes with an id_scan each")
    scenes: dict[str, SceneAnnotation] = {}
    for entry in entries:
        before = scenes.get(entry["id_scan"], SceneAnnotation(entry["id_scan"], ()))
        added = _scene(entry, len(before.models))
        problems = "; ".join(filter(None, (before.problem, added.problem)))
        models = before.models + added.models
        scenes[before.scene_id] = SceneAnnotation(before.scene_id, models, problems)
    return list(scenes.values())


def _scene(entry: dict[str, Any], first: int) -> SceneAnnotation:
    """One entry, its models numbered from ``first``."""
    scene_id = entry["id_scan"]
    try:
        M_scan = trs_matrix(entry.get("trs", {}))
        models = entry["aligned_models"]
        if not isinstance(models, list):
            raise InputError("aligned_models is no list")
    except (InputError, KeyError) as error:
        return SceneAnnotation(scene_id, (), f"damaged annotation of the scene: {error}")
    M_scan_world = np.eye(4)
    M_scan_world[:3, :3] = portable.inverse(M_scan[:3, :3])
    M_scan_world[:3, 3] = -portable.apply(M_scan_world[:3, :3], M_scan[:3, 3])
    return SceneAnnotation(
        scene_id, tuple(_model(i, m, M_scan_world) for i, m in enumerate(models, first))
    )


def _model(index: int, entry: dict[str, Any], M_scan_world: NDArray) -> AlignedModel:
    catid = cad_id = ""
    nothing = np.full(3, np.nan)
    try:
        if not isinstance(entry, dict):
            raise InputError(f"the model is {json.dumps(entry)[:40]}, expected a JSON object")
        catid, cad_id = str(entry.get("catid_cad", "")), str(entry.get("id_cad", ""))
        # A table program takes an offset for a number and drops its zeros.
        catid = catid.zfill(8) if catid.isdecimal() else catid
        matrix = portable.product(M_scan_world, trs_matrix(entry.get("trs", {})))
        centre = np.asarray(entry["center"], np.float64)
        half_extent = np.asarray(entry["bbox"], np.float64)
        if centre.shape != (3,) or half_extent.shape != (3,):
            raise InputError("center and bbox need three numbers each")
        if not np.isfinite([*centre, *half_extent]).all() or (half_extent <= 0).any():
            raise InputError(f"bbox is {half_extent.tolist()}, expected positive half extents")
        if entry.get("sym") not in SYMMETRIES:
            raise InputError(
                f"sym is {entry.get('sym')!r}, expected one of {', '.join(SYMMETRIES)}"
            )
    except (InputError, KeyError, TypeError, ValueError) as error:
        problem = f"damaged annotation: {error}"
        return AlignedModel(index, catid, cad_id, "none", np.eye(4), nothing, nothing, problem)
    symmetry = SYMMETRIES[entry["sym"]]
    return AlignedModel(index, catid, cad_id, symmetry, matrix, centre, half_extent)
