"""From a scene and its aligned CAD models to instances: which vertices, which class, which pose.

Where the scene has segmentation and aggregation files, an instance is the annotated object that
lies in the CAD's box. Where it has none, it is the vertices in the CAD's box that carry the class's
label.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from partialbench.errors import InputError
from renderers.sources.scannet.filters import (
    DISAGREEMENT,
    FEW_POINTS,
    FRAGMENTED,
    MISFIT,
    OUTSIDE,
    Rules,
    in_large_pieces,
    pieces,
)
from renderers.sources.scannet.frames import LabelMap, Scene
from renderers.sources.scannet.scan2cad import AlignedModel, BoxPose, SceneAnnotation, box_pose

CATEGORIES: dict[str, str] = {
    "02747177": "trash bin", "02773838": "bag", "02801938": "basket", "02808440": "bathtub",
    "02818832": "bed", "02828884": "bench", "02871439": "bookshelf", "02876657": "bottle",
    "02880940": "bowl", "02933112": "cabinet", "02946921": "can", "02954340": "cap",
    "03001627": "chair", "03046257": "clock", "03085013": "keyboard", "03207941": "dishwasher",
    "03211117": "display", "03325088": "faucet", "03337140": "file cabinet", "03467517": "guitar",
    "03593526": "jar", "03636649": "lamp", "03642806": "laptop", "03691459": "loudspeaker",
    "03761084": "microwave", "03790512": "motorbike", "03928116": "piano", "03938244": "pillow",
    "03991062": "pot", "04004475": "printer", "04223580": "sink", "04256520": "sofa",
    "04330267": "stove", "04379243": "table", "04401088": "telephone", "04446521": "toilet",
    "04554684": "washer",
}  # fmt: skip
"""Scan2CAD's 35 categories by synset offset, and WordNet's sink and toilet."""

CLASSES_OF: dict[str, tuple[str, ...]] = {
    "02808440": ("bathtub", "sink"),
    "02818832": ("bed",),
    "02871439": ("bookshelf",),
    "02880940": ("sink",),
    "02933112": ("dresser", "night_stand", "desk", "sink"),
    "03001627": ("chair", "toilet"),
    "03211117": ("monitor",),
    "03337140": ("dresser", "night_stand"),
    "03636649": ("lamp",),
    "03991062": ("sink",),
    "04004475": ("printer",),
    "04223580": ("sink",),
    "04256520": ("sofa",),
    "04330267": ("stove",),
    "04379243": ("table", "desk", "night_stand"),
    "04446521": ("toilet",),
}
"""CAD category → the PS15 classes it may stand for; the scan's label decides between them.

ShapeNet has no dresser, night stand, desk, sink or toilet: annotators took the CAD that looks most
like them (cabinet, table, bathtub, bowl, pot, chair).
"""

SECOND = "another CAD model fits the same object better"

# What a box holds besides its object: unlabelled, wall, floor, floor mat, ceiling.
STRUCTURE_IDS = (0, 1, 2, 20, 22)


@dataclass(frozen=True)
class Instance:
    """One object of PS15 in a scan.

    Attributes:
        index: of the aligned model in the scene's annotation.
        class_name: one of PS15's.
        symmetry: Scan2CAD's for this CAD model, as a ``geometry.symmetry.GROUPS`` name.
        pose: canonical frame and box.
        vertices: indices into the scene's vertices, ascending.
        details: how it was found, as JSON data.
    """

    index: int
    class_name: str
    symmetry: str
    pose: BoxPose
    vertices: NDArray[np.int64]
    details: dict[str, Any]


@dataclass(frozen=True)
class Rejected:
    """An aligned model that gives no instance, and why."""

    index: int
    reason: str
    details: dict[str, Any]


@dataclass(frozen=True, eq=False)
class _Claim:
    """A model and the vertices of its class in its box."""

    model: AlignedModel
    class_name: str
    pose: BoxPose
    vertices: NDArray[np.int64]
    agreement: float


def segment(
    scene: Scene, annotation: SceneAnnotation, label_map: LabelMap, rules: Rules
) -> tuple[list[Instance], list[Rejected]]:
    """The instances of one scene in the order of its annotation, and the models turned away."""
    rejected: list[Rejected] = []
    details: dict[str, Any]
    usable: list[tuple[AlignedModel, BoxPose]] = []
    for model in annotation.models:
        try:
            usable.append((model, box_pose(model, _classes(model)[0], rules.max_shear)))
        except InputError as error:
            details = {"catid_cad": model.catid, "id_cad": model.cad_id}
            rejected.append(Rejected(model.index, str(error), details))
    find = _by_label if scene.groups is None else _by_group
    found = find(scene, usable, label_map, rules)
    instances = []
    for result in found:
        if isinstance(result, Rejected):
            rejected.append(result)
        elif len(result.vertices) < rules.min_points:
            details = {"points": len(result.vertices), "minimum": rules.min_points}
            rejected.append(Rejected(result.index, FEW_POINTS, details))
        elif (misfit := box_misfit(scene.vertices[result.vertices], result.pose, rules)) > (
            rules.max_misfit
        ):
            details = {"share": round(misfit, 4), "maximum": rules.max_misfit}
            rejected.append(Rejected(result.index, MISFIT, details))
        else:
            instances.append(result)
    return (
        sorted(instances, key=lambda i: i.index),
        sorted(rejected, key=lambda r: r.index),
    )


def _classes(model: AlignedModel) -> tuple[str, ...]:
    """The PS15 classes the model may stand for; InputError when there are none."""
    if model.problem:
        raise InputError(model.problem)
    if model.catid not in CATEGORIES:
        raise InputError(f"unknown CAD category {model.catid!r}")
    if model.catid not in CLASSES_OF:
        name = CATEGORIES[model.catid]
        raise InputError(f"CAD category {name} ({model.catid}) is not a PS15 class")
    return CLASSES_OF[model.catid]


def _by_group(
    scene: Scene, usable: list[tuple[AlignedModel, BoxPose]], label_map: LabelMap, rules: Rules
) -> list[Instance | Rejected]:
    """Match every model to the annotated object that fills its box, each object once."""
    assert scene.groups is not None
    assert scene.segments is not None
    order = np.argsort(scene.segments, kind="stable")
    starts = scene.segments[order]
    members = []
    for group in scene.groups:
        low = np.searchsorted(starts, group.segments, "left")
        high = np.searchsorted(starts, group.segments, "right")
        runs = [order[a:b] for a, b in zip(low, high, strict=True)]
        members.append(np.sort(np.concatenate(runs)) if runs else np.zeros(0, np.int64))

    results: list[Instance | Rejected] = []
    details: dict[str, Any]
    claims: list[tuple[float, int, int]] = []  # (−quality, model position, group)
    inside: dict[tuple[int, int], NDArray[np.bool_]] = {}
    for position, (model, pose) in enumerate(usable):
        overlaps: list[tuple[int, int]] = []
        for g, vertices in enumerate(members):
            near = _in_box(scene.vertices[vertices], pose, rules.margin_m)
            if near.any() and 2 * near.sum() >= len(near):
                overlaps.append((int(near.sum()), g))
                inside[position, g] = near
        fitting = [
            (n, g)
            for n, g in overlaps
            if label_map.class_of.get(scene.groups[g].label) in _classes(model)
        ]
        if fitting:
            # How much of the object is in the box, and how much that is.
            claims += [(-n * n / len(members[g]), position, g) for n, g in fitting]
        elif overlaps:
            raw = scene.groups[max(overlaps)[1]].label
            details = {"scan": raw, "cad": CATEGORIES[model.catid]}
            results.append(Rejected(model.index, DISAGREEMENT, details))
        else:
            reason = "no annotated object lies in the CAD's box"
            results.append(Rejected(model.index, reason, {"cad": CATEGORIES[model.catid]}))

    taken: dict[int, int] = {}
    for _, position, g in sorted(claims):
        if position not in taken and g not in taken.values():
            taken[position] = g
    for position in sorted({p for _, p, _ in claims}):
        model, _ = usable[position]
        if position not in taken:
            results.append(Rejected(model.index, SECOND, {"cad": CATEGORIES[model.catid]}))
            continue
        g = taken[position]
        group, near = scene.groups[g], inside[position, taken[position]]
        outside = float(1 - near.mean())
        if outside > rules.max_outside:
            details = {"share": round(outside, 4), "maximum": rules.max_outside}
            results.append(Rejected(model.index, OUTSIDE, details))
            continue
        name = label_map.class_of[group.label]
        pose = box_pose(model, name, rules.max_shear)
        details = {"by": "segmentation", "object_id": group.object_id, "raw_label": group.label}
        results.append(Instance(model.index, name, model.symmetry, pose, members[g][near], details))
    return results


def _by_label(
    scene: Scene, usable: list[tuple[AlignedModel, BoxPose]], label_map: LabelMap, rules: Rules
) -> list[Instance | Rejected]:
    """Box ∩ label; a vertex in several boxes belongs to the one it is deepest in."""
    results: list[Instance | Rejected] = []
    details: dict[str, Any]
    chosen: list[_Claim] = []
    for model, pose in usable:
        near = np.flatnonzero(_in_box(scene.vertices, pose, rules.margin_m))
        labels = scene.labels[near]
        votes = {
            name: int(np.isin(labels, list(label_map.nyu40_ids[name])).sum())
            for name in _classes(model)
        }
        name = max(votes, key=lambda n: votes[n])
        labelled = int((~np.isin(labels, STRUCTURE_IDS)).sum())
        agreement = votes[name] / labelled if labelled else 0.0
        if agreement < rules.min_agreement:
            details = {
                "cad": CATEGORIES[model.catid], "share": round(agreement, 4),
                "minimum": rules.min_agreement, "points_in_box": len(near),
            }  # fmt: skip
            results.append(Rejected(model.index, DISAGREEMENT, details))
            continue
        of_class = near[np.isin(labels, list(label_map.nyu40_ids[name]))]
        pose = box_pose(model, name, rules.max_shear)
        chosen.append(_Claim(model, name, pose, of_class, agreement))
    for claim in _second_models(scene, chosen):
        chosen.remove(claim)
        results.append(Rejected(claim.model.index, SECOND, {"cad": CATEGORIES[claim.model.catid]}))

    best = np.full(len(scene.vertices), np.inf)
    owner = np.full(len(scene.vertices), -1)
    for position, claim in enumerate(chosen):
        local = claim.pose.to_object(scene.vertices[claim.vertices])
        depth = (np.abs(local) / claim.pose.half_extent).max(axis=1)
        closer = depth < best[claim.vertices]
        best[claim.vertices[closer]] = depth[closer]
        owner[claim.vertices[closer]] = position
    for position, claim in enumerate(chosen):
        own = claim.vertices[owner[claim.vertices] == position]
        kept = own
        if len(own):
            kept = own[in_large_pieces(scene.vertices[own], _edges_among(scene, own), rules)]
        loose = 1 - len(kept) / max(len(own), 1)
        if loose > rules.max_outside:
            details = {"share": round(loose, 4), "maximum": rules.max_outside}
            results.append(Rejected(claim.model.index, FRAGMENTED, details))
            continue
        cut = _cut_off(scene, claim, kept, chosen, label_map, rules)
        if cut > rules.max_outside:
            details = {"share": round(cut, 4), "maximum": rules.max_outside}
            results.append(Rejected(claim.model.index, OUTSIDE, details))
            continue
        details = {
            "by": "box and label", "agreement": round(claim.agreement, 4),
            "fragments": round(loose, 4), "cut_off": round(cut, 4),
        }  # fmt: skip
        model = claim.model
        results.append(
            Instance(model.index, claim.class_name, model.symmetry, claim.pose, kept, details)
        )
    return results


def _cut_off(
    scene: Scene,
    claim: _Claim,
    kept: NDArray[np.int64],
    claims: list[_Claim],
    label_map: LabelMap,
    rules: Rules,
) -> float:
    """The share of a claim's object that its box leaves outside.

    Without segmentation the object is what carries its class's label and is connected to the kept
    vertices, within twice the box: beyond, or in another model's box, it is taken for another one.
    """
    wide = _scaled_box(scene.vertices, claim.pose, 2, rules.margin_m)
    wide &= np.isin(scene.labels, list(label_map.nyu40_ids[claim.class_name]))
    for other in claims:
        if other is not claim:
            wide &= ~_in_box(scene.vertices, other.pose, rules.margin_m)
    wide[kept] = True
    near = np.flatnonzero(wide)
    if len(near) == 0:
        return 0.0
    piece = pieces(scene.vertices[near], _edges_among(scene, near), rules.fragment_gap_m)
    own = np.isin(near, kept)
    # A piece of which the box holds next to nothing only touches the object.
    held = np.bincount(piece[own], minlength=piece.max() + 1)
    of_object = held[piece] >= rules.min_fragment * max(len(kept), 1)
    inside = _in_box(scene.vertices[near], claim.pose, rules.margin_m)
    return float((of_object & ~inside).sum() / max(int(of_object.sum()), 1))


def _second_models(scene: Scene, claims: list[_Claim]) -> list[_Claim]:
    """The claims on an object that another of the same class fits better.

    Two models mean one object when each box has the other's centre in its inner half; the one whose
    box is nearer to the points' extent stays.
    """
    residual = [
        box_residual_m(scene.vertices[c.vertices], c.pose) if len(c.vertices) else np.inf
        for c in claims
    ]
    second = []
    for i, a in enumerate(claims):
        for j, b in enumerate(claims):
            if i == j or a.class_name != b.class_name or (residual[i], i) < (residual[j], j):
                continue
            if _centre_within(a.pose, b.pose) and _centre_within(b.pose, a.pose):
                second.append(a)
                break
    return second


def _centre_within(inner: BoxPose, outer: BoxPose) -> bool:
    offset = outer.to_object(inner.centre[None])[0]
    return bool((np.abs(offset) < outer.half_extent / 2).all())


def _edges_among(scene: Scene, chosen: NDArray[np.int64]) -> NDArray[np.int64]:
    """(e,2) mesh edges between chosen vertices, as positions in ``chosen``."""
    position = np.full(len(scene.vertices), -1)
    position[chosen] = np.arange(len(chosen))
    edges = position[scene.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)]
    return edges[(edges >= 0).all(axis=1)]


def _in_box(points: NDArray, pose: BoxPose, margin_m: float) -> NDArray[np.bool_]:
    return _scaled_box(points, pose, 1, margin_m)


def _scaled_box(points: NDArray, pose: BoxPose, scale: float, margin_m: float) -> NDArray[np.bool_]:
    inside = np.abs(pose.to_object(points)) <= scale * pose.half_extent + margin_m
    return np.logical_and.reduce(inside, axis=1)


def labelled_boxes(
    scene: Scene, annotation: SceneAnnotation, label_map: LabelMap, rules: Rules
) -> list[tuple[NDArray[np.int64], frozenset[int]]]:
    """Of every usable model, the vertices in its box and the nyu40 ids of what it may stand for."""
    boxes = []
    for model in annotation.models:
        try:
            classes = _classes(model)
            pose = box_pose(model, classes[0], rules.max_shear)
        except InputError:
            continue  # ``segment`` says so
        inside = np.flatnonzero(_in_box(scene.vertices, pose, 0.0))
        boxes.append((inside, frozenset().union(*(label_map.nyu40_ids[c] for c in classes))))
    return boxes


def box_residual_m(points: NDArray, pose: BoxPose) -> float:
    """How far the (n,3) scan-frame points' extent is from the CAD's box: metres.

    The median over the box's six faces of the distance between the face and the points' first or
    last percentile along that axis; the median forgives two faces that the scan never saw.
    """
    low, high = np.percentile(pose.to_object(points), [1, 99], axis=0)
    return float(np.median(np.abs([*(low + pose.half_extent), *(high - pose.half_extent)])))


def box_misfit(points: NDArray, pose: BoxPose, rules: Rules) -> float:
    """How far the (n,3) scan-frame points' extent is from the CAD's box, as a share of the box.

    As ``box_residual_m``, each face's distance less ``margin_m`` and divided by the box's half
    extent along that axis: a thin box may miss by the margin, a large one by more.
    """
    low, high = np.percentile(pose.to_object(points), [1, 99], axis=0)
    gaps = np.abs([low + pose.half_extent, high - pose.half_extent])
    return float(np.median(np.maximum(gaps - rules.margin_m, 0) / pose.half_extent))
