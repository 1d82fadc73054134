"""PS15's source: the instances of ScanNet scans that Scan2CAD aligned a CAD model to."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.categories import PS15
from partialbench.dataset.executors import map_in_order
from partialbench.dataset.rows import BROKEN_INPUT, reason_of
from partialbench.dataset.shards import file_sha256
from partialbench.dataset.sources import ObjectRef, RejectedObject
from partialbench.errors import InputError
from partialbench.geometry import portable
from partialbench.geometry.camera import sample_pose
from renderers.sources.scannet.filters import Rules
from renderers.sources.scannet.frames import (
    FLOOR_IDS,
    LABEL_MAP,
    LabelMap,
    read_label_map,
    read_scene,
    scene_files,
    scene_folder,
    space_of,
)
from renderers.sources.scannet.instances import Instance, box_residual_m, segment
from renderers.sources.scannet.scan2cad import SceneAnnotation, read_annotations
from renderers.sources.scannet.splits import read_split_file, split_by_hash
from renderers.viewpoints import places_for, standing_places, standing_pose

PAPER_COUNTS = {"train": 22_670, "test": 5_650}
"""Samples of the paper's PS15 (section 5.1)."""
PAPER_VIEWS = 10
VIEWPOINTS = ("standing", "uniform")
NO_PLACE = "no place to stand: no free floor within sight of it"


@dataclass(frozen=True)
class ScanInstance:
    """One scanned object, normalised, with what its viewpoints need.

    p_scan = scale_m · R_scan_object · p_object + origin.

    Attributes:
        points: (n,3) float32, canonical frame (z up), bounding-box centre at the origin, largest
            norm 1.
        normals: (n,3) float32 of the scan's surface there, same frame.
        symmetry: ``geometry.symmetry.GROUPS`` name, Scan2CAD's for the instance's CAD model.
        R_scan_object: (3,3) float64 in SO(3).
        scale_m: metres per object unit.
        origin: (3,) float64 of the object frame in the scan frame, metres.
        places: (k,2) float64 where a person could stand and see it, scan frame, metres.
        floor_z: height of the floor, scan frame, metres.
        class_name: one of PS15's.
        box_centre, box_half_extent: (3,) float64 the CAD's box in the object frame, object units.
        residual_m: median distance between the box's faces and the points' extent, metres.
        details: how the instance was found.
    """

    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    symmetry: str
    R_scan_object: NDArray[np.float64]
    scale_m: float
    origin: NDArray[np.float64]
    places: NDArray[np.float64]
    floor_z: float
    class_name: str
    box_centre: NDArray[np.float64]
    box_half_extent: NDArray[np.float64]
    residual_m: float
    details: dict[str, Any]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray:
        """The points, so that whatever takes an (n,3) cloud takes an instance."""
        return np.array(self.points, dtype=dtype, copy=copy)


@dataclass(frozen=True)
class _Listed:
    """What listing found in one scene.

    Attributes:
        instances: (index in the annotation, class name).
        rejected: (object id, reason, details, failed).
        notes: as ``Scene.notes``.
    """

    instances: tuple[tuple[int, str], ...]
    rejected: tuple[tuple[str, str, dict[str, Any], bool], ...]
    notes: dict[str, Any]


@dataclass
class ScanNetInstances:
    """A `partialbench.dataset.sources.Source` over a ScanNet folder and a Scan2CAD file.

    Args:
        scannet: holds ``scans/<scene>/`` (or ``<scene>/``) and the label map.
        scan2cad: ``full_annotations.json``.
        viewpoints: "standing" (a person with a camera in the room) or "uniform" (the paper's poses:
            Haar rotation, t_x, t_y ~ U(−2, 2), t_z ~ U(2, 5)).
        split_file: JSON object {"train": [...], "test": [...]} of scene ids or space ids; a scene
            in neither is left out; or what ``read_split_file`` made of one. Default: four of five
            spaces by hash, see ``split_of``.
        label_map: default ``scannet/scannetv2-labels.combined.tsv``.
        rules: thresholds of ``filters``.
        workers: processes that list scenes.

    Raises:
        InputError: the folder, the annotations, the label map or the split file cannot be used.
    """

    scannet: Path
    scan2cad: Path
    viewpoints: str = "standing"
    split_file: Path | dict[str, str] | None = None
    label_map: Path | None = None
    rules: Rules = field(default_factory=Rules)
    workers: int = 1
    class_names: tuple[str, ...] = PS15
    frame: str = "aligned"
    name: str = "scannet"

    def __post_init__(self) -> None:
        self.scannet, self.scan2cad = Path(self.scannet).absolute(), Path(self.scan2cad).absolute()
        if self.viewpoints not in VIEWPOINTS:
            raise InputError(
                f"viewpoints {self.viewpoints!r} is not one of {', '.join(VIEWPOINTS)}"
            )
        if not self.scannet.is_dir():
            raise InputError(
                f"{self.scannet} is no folder; give --scannet the folder that holds scans/"
            )
        self.label_map = self.label_map or self.scannet / LABEL_MAP
        given = self.split_file
        self._splits = given if given is None or isinstance(given, dict) else read_split_file(given)
        self._listed: dict[str, _Listed] | None = None
        self._open()

    def _open(self) -> None:
        assert self.label_map is not None
        self._labels: LabelMap = read_label_map(self.label_map)
        self._annotations = {a.scene_id: a for a in read_annotations(self.scan2cad)}
        self._scene: tuple[str, dict[int, ScanInstance], str] | None = None

    # A worker is sent the paths and reads for itself: all of Scan2CAD would be megabytes a task.
    def __getstate__(self) -> dict[str, Any]:
        left_out = ("_labels", "_annotations", "_scene")
        state = {k: v for k, v in self.__dict__.items() if k not in left_out}
        return {**state, "_listed": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._open()

    def split_of(self, scene_id: str) -> str | None:
        """The split of a scene; rescans of one space stay together. None: in neither.

        ScanNet's own lists are not ours to ship: without a split file, a space is in "train" when
        the first 8 bytes of SHA-256(space id), as a fraction, are below 0.8.
        """
        space = space_of(scene_id)
        if self._splits is not None:
            return self._splits.get(scene_id, self._splits.get(space))
        return split_by_hash(space)

    def splits(self) -> tuple[str, ...]:
        """The splits that have objects."""
        return tuple(split for split in ("train", "test") if self.objects(split))

    def objects(self, split: str) -> list[ObjectRef]:
        """The split's instances, by scene id and then by position in the annotation."""
        return [
            ObjectRef(f"{scene_id}/{index}", PS15.index(name), split, scene_id)
            for scene_id, listed in self._list().items()
            if self.split_of(scene_id) == split
            for index, name in listed.instances
        ]

    @property
    def rejected(self) -> list[RejectedObject]:
        """Scenes and aligned models that give no instance, with their reasons."""
        return [
            RejectedObject(
                object_id, self.split_of(scene_id) or "", reason, scene_id, details, failed
            )
            for scene_id, listed in self._list().items()
            for object_id, reason, details, failed in listed.rejected
        ]

    def load(self, ref: ObjectRef) -> ScanInstance:
        """The instance; the last scene read stays in memory."""
        instances, _ = self._scene_instances(ref.location)
        index = int(ref.object_id.rsplit("/", 1)[1])
        if index not in instances:
            raise InputError(f"{ref.object_id}: no such instance; were the files changed since?")
        return instances[index]

    def digest(self, ref: ObjectRef) -> str:
        """SHA-256 over the scene's files and its annotation."""
        return self._scene_instances(ref.location)[1]

    def poses(
        self, shape: ScanInstance, rngs: list[np.random.Generator]
    ) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """One (R_camera_object, t_camera_object) per generator, t in object units."""
        if self.viewpoints == "uniform":
            return [sample_pose(rng) for rng in rngs]
        poses = []
        for rng in rngs:
            R_camera_scan, position = standing_pose(
                rng, shape.places, shape.floor_z, shape.origin, shape.scale_m
            )
            t = portable.apply(R_camera_scan, shape.origin - position) / shape.scale_m
            poses.append((portable.product(R_camera_scan, shape.R_scan_object), t))
        return poses

    def describe(self) -> dict[str, Any]:
        """The options; digests of the annotations, the label map and what is listed."""
        assert self.label_map is not None
        listing = [
            (ref.split, ref.object_id, ref.label)
            for split in ("train", "test")
            for ref in self.objects(split)
        ]
        return {
            "name": self.name,
            "viewpoints": self.viewpoints,
            "rules": self.rules.describe(),
            "annotations": file_sha256(self.scan2cad),
            "label_map": file_sha256(self.label_map),
            "split": "sha256(space) < 0.8" if self._splits is None else dict(self._splits),
            "scenes": len(self._list()),
            # Scenes downloaded later, or mended, are another data set, not the rest of this one.
            "listing_sha256": hashlib.sha256(json.dumps(listing).encode()).hexdigest(),
        }

    def counts(self) -> dict[str, dict[str, int]]:
        """Split → class name → number of instances."""
        found = {}
        for split in ("train", "test"):
            labels = Counter(ref.label for ref in self.objects(split))
            found[split] = {name: labels[i] for i, name in enumerate(PS15)}
        return found

    def notes(self) -> dict[str, dict[str, Any]]:
        """Scene id → what reading it changed (labels above nyu40's range), where it did."""
        return {scene: listed.notes for scene, listed in self._list().items() if listed.notes}

    def _list(self) -> dict[str, _Listed]:
        if self._listed is None:
            scenes = [s for s in sorted(self._all_scenes()) if self.split_of(s) is not None]
            results = list(map_in_order(self._list_scene, scenes, self.workers, chunksize=4))
            listed = dict(zip(scenes, results, strict=True))
            if not any(r.instances for r in results):
                raise InputError(self._nothing(listed))
            self._listed = listed
        return self._listed

    def _all_scenes(self) -> set[str]:
        scans = self.scannet / "scans"
        folder = scans if scans.is_dir() else self.scannet
        present = {path.name for path in folder.iterdir() if path.is_dir() and scene_files(path)}
        return present | set(self._annotations)

    def _list_scene(self, scene_id: str) -> _Listed:
        annotation = self._annotations.get(scene_id)
        if annotation is None:
            return _Listed((), ((scene_id, "the scene has no annotation", {}, False),), {})
        if scene_folder(self.scannet, scene_id) is None:
            reason = "the annotated scene is not in the ScanNet folder"
            return _Listed((), ((scene_id, reason, {}, False),), {})
        if annotation.problem:
            return _Listed((), ((scene_id, annotation.problem, {}, True),), {})
        try:
            found, rejected, notes = self._read(annotation)
        except BROKEN_INPUT as error:
            return _Listed((), ((scene_id, reason_of(error), {}, True),), {})
        return _Listed(
            tuple((index, instance.class_name) for index, instance in found.items()),
            tuple((f"{scene_id}/{i}", reason, details, False) for i, reason, details in rejected),
            notes,
        )

    def _nothing(self, listed: dict[str, _Listed]) -> str:
        reasons = Counter(reason for r in listed.values() for _, reason, _, _ in r.rejected)
        first = "; ".join(f"{reason} ({n}×)" for reason, n in reasons.most_common(3))
        first = first or "no scene is in either split"
        return (
            f"no PS15 instance in {self.scannet} with {self.scan2cad.name}: {first}. "
            f"Expected {self.scannet}/scans/<scene>/<scene>_vh_clean_2.ply and its labels"
        )

    def _scene_instances(self, scene_id: str) -> tuple[dict[int, ScanInstance], str]:
        if self._scene is None or self._scene[0] != scene_id:
            annotation = self._annotations.get(scene_id)
            folder = scene_folder(self.scannet, scene_id)
            if annotation is None or folder is None:
                raise InputError(f"scene {scene_id!r} is not in both ScanNet and Scan2CAD")
            found, _, _ = self._read(annotation)
            digests = [file_sha256(path) for _, path in sorted(scene_files(folder).items())]
            whole = hashlib.sha256(json.dumps([digests, _plain(annotation)]).encode()).hexdigest()
            self._scene = scene_id, found, whole
        return self._scene[1], self._scene[2]

    def _read(
        self, annotation: SceneAnnotation
    ) -> tuple[dict[int, ScanInstance], list[tuple[int, str, dict[str, Any]]], dict[str, Any]]:
        """Instances by index, rejections (index, reason, details), and reading notes of a scene."""
        folder = scene_folder(self.scannet, annotation.scene_id)
        assert folder is not None
        scene = read_scene(folder, self._labels)
        instances, turned_away = segment(scene, annotation, self._labels, self.rules)
        places, floor_z = standing_places(scene.vertices, np.isin(scene.labels, FLOOR_IDS))
        rejected = [(r.index, r.reason, r.details) for r in turned_away]
        found = {}
        for instance in instances:
            shape = _normalised(instance, scene.vertices, scene.normals, places, floor_z)
            if self.viewpoints == "standing" and len(shape.places) == 0:
                rejected.append((instance.index, NO_PLACE, {"free_places": len(places)}))
                continue
            found[instance.index] = shape
        return found, sorted(rejected, key=lambda r: r[0]), scene.notes


def _normalised(
    instance: Instance, vertices: NDArray, normals: NDArray, places: NDArray, floor_z: float
) -> ScanInstance:
    pose = instance.pose
    metric = pose.to_object(vertices[instance.vertices])
    middle = (metric.min(axis=0) + metric.max(axis=0)) / 2
    scale_m = float(np.linalg.norm(metric - middle, axis=1).max())
    origin = pose.centre + portable.apply(pose.R_scan_object, middle)
    return ScanInstance(
        points=((metric - middle) / scale_m).astype(np.float32),
        normals=(normals[instance.vertices] @ pose.R_scan_object).astype(np.float32),
        symmetry=instance.symmetry,
        R_scan_object=pose.R_scan_object,
        scale_m=scale_m,
        origin=origin,
        places=places_for(places, floor_z, origin, scale_m),
        floor_z=floor_z,
        class_name=instance.class_name,
        box_centre=-middle / scale_m,
        box_half_extent=pose.half_extent / scale_m,
        residual_m=box_residual_m(vertices[instance.vertices], pose),
        details=instance.details,
    )


def _plain(annotation: SceneAnnotation) -> list[Any]:
    return [
        [m.index, m.catid, m.cad_id, m.symmetry, m.M_scan_cad.tolist(), m.centre.tolist(),
         m.half_extent.tolist(), m.problem] for m in annotation.models
    ]  # fmt: skip


def counts_table(counts: dict[str, dict[str, int]], views: int = PAPER_VIEWS) -> str:
    """Instances and samples (before the view rules) per class, and the paper's totals, as Markdown.

    Args:
        counts: as ``ScanNetInstances.counts`` gives them.
        views: viewpoints per instance.
    """
    lines = ["| class | train instances | test instances |", "|---|---:|---:|"]
    lines += [f"| {name} | {counts['train'][name]} | {counts['test'][name]} |" for name in PS15]
    totals = {split: sum(per_class.values()) for split, per_class in counts.items()}
    lines += [
        f"| all | {totals['train']} | {totals['test']} |",
        f"| × {views} viewpoints | {totals['train'] * views:,} | {totals['test'] * views:,} |",
        f"| paper's samples | {PAPER_COUNTS['train']:,} | {PAPER_COUNTS['test']:,} |",
    ]
    return "\n".join(lines) + "\n"
