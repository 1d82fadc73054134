"""One scene of ScanNet with its annotation of Scan2CAD → its instances, each in its own frame."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.rows import BROKEN_INPUT, reason_of
from partialbench.geometry import portable
from renderers.sources.scannet.filters import Rules
from renderers.sources.scannet.frames import (
    LabelMap,
    Scene,
    read_label_map,
    read_scene,
    scene_folder,
    settle_labels,
)
from renderers.sources.scannet.instances import (
    Instance,
    box_residual_m,
    labelled_boxes,
    segment,
)
from renderers.sources.scannet.labels import FLOOR_IDS
from renderers.sources.scannet.scan2cad import SceneAnnotation
from renderers.sources.scannet.sight import Blockers, Surface, spread, surface_of
from renderers.viewpoints import places_for, standing_places

NO_PLACE = "no place to stand: no free floor within sight of it"


@functools.lru_cache(maxsize=4)
def _label_map(path: Path, written_ns: int) -> LabelMap:
    return read_label_map(path)


@dataclass(frozen=True)
class ScanInstance:
    """One scanned object, normalised, with what its viewpoints need.

    p_scan = scale_m · R_scan_object · p_object + origin.

    Attributes:
        points: (n,3) float32, canonical frame (z up), bounding-box centre at the origin, largest
            norm 1.
        normals: (n,3) float32 of the scan's surface there, same frame.
        faces: (f,3) uint32 of the scan's mesh, those whose corners are all among the points.
        symmetry: ``geometry.symmetry.GROUPS`` name, Scan2CAD's for the instance's CAD model.
        R_scan_object: (3,3) float64 in SO(3).
        scale_m: metres per object unit.
        origin: (3,) float64 of the object frame in the scan frame, metres.
        places: (k,2) float64 where a person could stand and see it, scan frame, metres.
        blockers: what else of the scan may stand before it; None where nobody asked for places.
        floor_z: height of the floor, scan frame, metres.
        class_name: one of PS15's.
        box_centre, box_half_extent: (3,) float64 the CAD's box in the object frame, object units.
        residual_m: median distance between the box's faces and the points' extent, metres.
        details: how the instance was found.
    """

    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    faces: NDArray[np.uint32]
    symmetry: str
    R_scan_object: NDArray[np.float64]
    scale_m: float
    origin: NDArray[np.float64]
    places: NDArray[np.float64]
    blockers: Blockers | None
    floor_z: float
    class_name: str
    box_centre: NDArray[np.float64]
    box_half_extent: NDArray[np.float64]
    residual_m: float
    details: dict[str, Any]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray:
        """The points, so that whatever takes an (n,3) cloud takes an instance."""
        return np.array(self.points, dtype=dtype, copy=copy)

    def in_scan(self) -> NDArray[np.float64]:
        """(n,3) the points where they are in the scan, metres."""
        return self.scale_m * portable.product(self.points, self.R_scan_object.T) + self.origin


@dataclass(frozen=True)
class SceneRead:
    """What reading a scene gave.

    Attributes:
        instances: index in the annotation → instance.
        rejected: (index, reason, details) of the models that gave none.
        notes: as ``Scene.notes``.
    """

    instances: dict[int, ScanInstance]
    rejected: list[tuple[int, str, dict[str, Any]]]
    notes: dict[str, Any]


@dataclass(frozen=True)
class Listed:
    """What listing found in one scene, small enough to send between processes.

    Attributes:
        instances: (index in the annotation, class name).
        rejected: (object id, reason, details, failed).
        notes: as ``Scene.notes``.
    """

    instances: tuple[tuple[int, str], ...]
    rejected: tuple[tuple[str, str, dict[str, Any], bool], ...]
    notes: dict[str, Any]


@dataclass(frozen=True)
class SceneReader:
    """Reads scenes; picklable and small.

    Attributes:
        scannet, label_map, rules, viewpoints, labels: as `ScanNetInstances` takes them.
    """

    scannet: Path
    label_map: Path
    rules: Rules
    viewpoints: str
    labels: str

    @property
    def known_labels(self) -> LabelMap:
        """The label map; a process reads it once, however many scenes it lists."""
        if not self.label_map.is_file():
            return read_label_map(self.label_map)  # says what is missing
        return _label_map(self.label_map, self.label_map.stat().st_mtime_ns)

    def listed(self, job: tuple[str, SceneAnnotation | None]) -> Listed:
        """What a scene gives, or why it gives nothing; it raises for no fault of the files."""
        scene_id, annotation = job
        if annotation is None:
            return Listed((), ((scene_id, "the scene has no annotation", {}, False),), {})
        if scene_folder(self.scannet, scene_id) is None:
            reason = "the annotated scene is not in the ScanNet folder"
            return Listed((), ((scene_id, reason, {}, False),), {})
        broken: list[tuple[str, str, dict[str, Any], bool]] = []
        if annotation.problem:
            broken.append((scene_id, annotation.problem, {}, True))
        if broken and not annotation.models:
            return Listed((), tuple(broken), {})
        try:
            read = self.read(annotation)
        except BROKEN_INPUT as error:
            return Listed((), (*broken, (scene_id, reason_of(error), {}, True)), {})
        # A model that is damaged is lost, not turned away by a rule.
        damaged = {model.index for model in annotation.models if model.problem}
        rejected = ((f"{scene_id}/{i}", reason, details, i in damaged) for i, reason, details in
                    read.rejected)  # fmt: skip
        found = ((index, instance.class_name) for index, instance in read.instances.items())
        return Listed(tuple(found), (*broken, *rejected), read.notes)

    def read(self, annotation: SceneAnnotation) -> SceneRead:
        """The instances of an annotated scene.

        Raises:
            InputError: a file is missing or damaged, or its labels have no certain meaning.
        """
        folder = scene_folder(self.scannet, annotation.scene_id)
        assert folder is not None
        scene = self.settled(read_scene(folder, self.known_labels), annotation)
        instances, turned_away = segment(scene, annotation, self.known_labels, self.rules)
        rejected = [(r.index, r.reason, r.details) for r in turned_away]
        places, floor_z = standing_places(scene.vertices, np.isin(scene.labels, FLOOR_IDS))
        standing = self.viewpoints == "standing" and len(scene.faces) > 0
        surface = surface_of(scene.vertices, scene.faces) if standing and instances else None
        found = {}
        for instance in instances:
            shape = _normalised(instance, scene, floor_z)
            if self.viewpoints == "standing":
                shape = self._with_places(shape, places, scene, instance, surface)
                if len(shape.places) == 0:
                    details = {"free_places": len(places)}
                    rejected.append((instance.index, NO_PLACE, details))
                    continue
            found[instance.index] = shape
        return SceneRead(found, sorted(rejected, key=lambda r: r[0]), scene.notes)

    def settled(self, scene: Scene, annotation: SceneAnnotation) -> Scene:
        """The scene with nyu40 labels; as ``frames.settle_labels``."""
        boxes = labelled_boxes(scene, annotation, self.known_labels, self.rules)
        return settle_labels(scene, boxes, self.known_labels, self.labels)

    def _with_places(
        self,
        shape: ScanInstance,
        places: NDArray,
        scene: Scene,
        instance: Instance,
        surface: Surface | None,
    ) -> ScanInstance:
        """The instance with the places from whose middle it is in sight."""
        rules = self.rules
        near = places_for(
            places, shape.floor_z, shape.origin, shape.scale_m,
            (rules.lowest_m, rules.highest_m), (rules.nearest_m, rules.farthest_m),
        )  # fmt: skip
        if surface is None:
            return replace(shape, places=near)
        blockers = surface.without(instance.vertices, scene.faces)
        targets = spread(shape.in_scan())
        eye_z = shape.floor_z + (rules.lowest_m + rules.highest_m) / 2
        in_sight = [
            blockers.free_share(np.array([*place, eye_z]), targets) >= rules.min_sight
            for place in near
        ]
        return replace(shape, places=near[np.array(in_sight, np.bool_)], blockers=blockers)


def _normalised(instance: Instance, scene: Scene, floor_z: float) -> ScanInstance:
    pose, vertices, normals = instance.pose, scene.vertices, scene.normals
    position = np.full(len(vertices), -1)
    position[instance.vertices] = np.arange(len(instance.vertices))
    faces = position[scene.faces]
    metric = pose.to_object(vertices[instance.vertices])
    middle = (metric.min(axis=0) + metric.max(axis=0)) / 2
    scale_m = float(np.linalg.norm(metric - middle, axis=1).max())
    origin = pose.centre + portable.apply(pose.R_scan_object, middle)
    return ScanInstance(
        points=((metric - middle) / scale_m).astype(np.float32),
        normals=(normals[instance.vertices] @ pose.R_scan_object).astype(np.float32),
        faces=faces[(faces >= 0).all(axis=1)].astype(np.uint32),
        symmetry=instance.symmetry,
        R_scan_object=pose.R_scan_object,
        scale_m=scale_m,
        origin=origin,
        places=np.zeros((0, 2)),
        blockers=None,
        floor_z=floor_z,
        class_name=instance.class_name,
        box_centre=-middle / scale_m,
        box_half_extent=pose.half_extent / scale_m,
        residual_m=box_residual_m(vertices[instance.vertices], pose),
        details=instance.details,
    )
