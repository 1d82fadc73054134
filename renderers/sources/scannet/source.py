"""PS15's source: the instances of ScanNet scans that Scan2CAD aligned a CAD model to."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.categories import PS15
from partialbench.dataset.executors import map_in_order
from partialbench.dataset.shards import file_sha256
from partialbench.dataset.sources import ObjectRef, RejectedObject
from partialbench.errors import InputError
from partialbench.geometry import portable
from partialbench.geometry.camera import sample_pose
from renderers.sources.scannet.filters import Rules
from renderers.sources.scannet.frames import LABEL_MAP, scene_files, scene_folder
from renderers.sources.scannet.labels import NUMBERINGS
from renderers.sources.scannet.reader import Listed, ScanInstance, SceneReader
from renderers.sources.scannet.scan2cad import SceneAnnotation, read_annotations
from renderers.sources.scannet.sight import spread
from renderers.sources.scannet.splits import read_split_files, space_of, split_by_hash
from renderers.viewpoints import look_at, standing_pose

PAPER_COUNTS = {"train": 22_670, "test": 5_650}
"""Samples of the paper's PS15 (section 5.1)."""
PAPER_VIEWS = 10
VIEWPOINTS = ("uniform", "standing")
SIGHT_TRIES = 50
"""Draws of a standing camera before it is put in the middle of a place, where listing looked."""


@dataclass
class ScanNetInstances:
    """A `partialbench.dataset.sources.Source` over a ScanNet folder and a Scan2CAD file.

    Args:
        scannet: holds ``scans/<scene>/`` (or ``<scene>/``) and the label map.
        scan2cad: ``full_annotations.json``, or the folder that holds it.
        viewpoints: "uniform" (the paper's poses: Haar rotation, t_x, t_y ~ U(−2, 2),
            t_z ~ U(2, 5)) or "standing" (a person with a camera in the room).
        split_file: one or more files, as ``splits.read_split_files`` takes them, or what it made of
            them; a scene in no list is left out. Default: four of five spaces by hash, see
            ``split_of``.
        label_map: default ``scannetv2-labels.combined.tsv`` in ``scannet`` or beside it.
        rules: thresholds, as ``filters.Rules.of`` takes them.
        labels: what the numbers in labels files are, "nyu40" or "scannet"; "auto" decides for each
            file by its floor and its aligned objects.
        workers: processes that list scenes.
        on_scene: called with (scenes listed, scenes in all).

    Raises:
        InputError: the folder, the annotations, the label map or the split file cannot be used.
    """

    scannet: Path
    scan2cad: Path
    viewpoints: str = "uniform"
    split_file: Path | Sequence[Path] | dict[str, str] | None = None
    label_map: Path | None = None
    rules: Rules | Mapping[str, float] = field(default_factory=Rules)
    labels: str = "auto"
    workers: int = 1
    on_scene: Callable[[int, int], None] | None = None
    class_names: tuple[str, ...] = PS15
    frame: str = "aligned"
    name: str = "scannet"

    def __post_init__(self) -> None:
        self.scannet, self.scan2cad = Path(self.scannet).absolute(), Path(self.scan2cad).absolute()
        if self.scan2cad.is_dir():
            self.scan2cad /= "full_annotations.json"
        if self.viewpoints not in VIEWPOINTS:
            raise InputError(
                f"viewpoints {self.viewpoints!r} is not one of {', '.join(VIEWPOINTS)}"
            )
        if self.labels not in ("auto", *NUMBERINGS):
            raise InputError(f"labels {self.labels!r} is not one of auto, {', '.join(NUMBERINGS)}")
        if not self.scannet.is_dir():
            raise InputError(
                f"{self.scannet} is no folder; give --scannet the folder that holds scans/, or "
                f"scans/ itself"
            )
        self.rules: Rules = Rules.of(self.rules)
        self.label_map = Path(self.label_map or _label_map_of(self.scannet))
        given = self.split_file
        if given is not None and not isinstance(given, dict):
            given = read_split_files([given] if isinstance(given, str | Path) else given)
        self._splits = given
        self._listed: dict[str, Listed] | None = None
        self._open()

    def _open(self) -> None:
        assert isinstance(self.rules, Rules)
        assert self.label_map is not None
        self._reader = SceneReader(
            self.scannet, self.label_map, self.rules, self.viewpoints, self.labels
        )
        _ = self._reader.known_labels  # a label map that cannot be read is said at once
        self._annotations = {a.scene_id: a for a in read_annotations(self.scan2cad)}
        self._scene: tuple[str, dict[int, ScanInstance], str] | None = None

    # A worker is sent the paths and reads for itself: all of Scan2CAD would be megabytes a task.
    def __getstate__(self) -> dict[str, Any]:
        left_out = ("_reader", "_annotations", "_scene")
        state = {k: v for k, v in self.__dict__.items() if k not in left_out}
        return {**state, "_listed": None, "on_scene": None}

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

    def beside(self, ref: ObjectRef) -> list[ObjectRef]:
        """What may be put before an object: the others of its scan, or of its split where it is
        the scan's only one."""
        split = [other for other in self.objects(ref.split) if other.object_id != ref.object_id]
        return [other for other in split if other.location == ref.location] or split

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
            R_camera_scan, position = self._standing(shape, rng)
            t = portable.apply(R_camera_scan, shape.origin - position) / shape.scale_m
            poses.append((portable.product(R_camera_scan, shape.R_scan_object), t))
        return poses

    def _standing(
        self, shape: ScanInstance, rng: np.random.Generator
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """R_camera_scan and position of a camera that has the object in sight."""
        rules = self._reader.rules
        heights = (rules.lowest_m, rules.highest_m)
        targets = spread(shape.in_scan())
        for _ in range(SIGHT_TRIES):
            pose = standing_pose(
                rng, shape.places, shape.floor_z, shape.origin, shape.scale_m, heights
            )
            if (
                shape.blockers is None
                or shape.blockers.free_share(pose[1], targets) >= rules.min_sight
            ):
                return pose
        place = shape.places[rng.integers(len(shape.places))]
        position = np.array([*place, shape.floor_z + sum(heights) / 2])
        return look_at(position, shape.origin), position

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
            "rules": self._reader.rules.describe(),
            "labels": self.labels,
            "labels_read_by": dict(sorted(self._labels_read_by().items())),
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
        """Scene id → by what its labels were read, and what that changed."""
        return {scene: listed.notes for scene, listed in self._list().items() if listed.notes}

    @property
    def listing(self) -> str:
        """How the folder was understood, in words."""
        by = ", ".join(f"{n} by {how}" for how, n in sorted(self._labels_read_by().items()))
        counts = {split: len(self.objects(split)) for split in ("train", "test")}
        return (
            f"{len(self._list())} scenes, {counts['train']} training and {counts['test']} test "
            f"instances; labels: {by}"
        )

    def _labels_read_by(self) -> Counter[str]:
        notes = (listed.notes for listed in self._list().values())
        return Counter(note["labels"] for note in notes if "labels" in note)

    def _list(self) -> dict[str, Listed]:
        if self._listed is None:
            scenes = [s for s in sorted(self._all_scenes()) if self.split_of(s) is not None]
            # A scene is sent with its own annotation: all of Scan2CAD would be megabytes a task.
            jobs = [(scene, self._annotations.get(scene)) for scene in scenes]
            listed: dict[str, Listed] = {}
            for result in map_in_order(self._reader.listed, jobs, self.workers, chunksize=4):
                listed[scenes[len(listed)]] = result
                if self.on_scene:
                    self.on_scene(len(listed), len(scenes))
            if not any(r.instances for r in listed.values()):
                raise InputError(self._nothing(listed))
            self._listed = listed
        return self._listed

    def _all_scenes(self) -> set[str]:
        scans = self.scannet / "scans"
        folder = scans if scans.is_dir() else self.scannet
        present = {path.name for path in folder.iterdir() if path.is_dir() and scene_files(path)}
        return present | set(self._annotations)

    def _nothing(self, listed: dict[str, Listed]) -> str:
        reasons = Counter(reason for r in listed.values() for _, reason, _, _ in r.rejected)
        first = "; ".join(f"{reason} ({n}×)" for reason, n in reasons.most_common(3))
        first = first or "no scene is in either split"
        scans = self.scannet / "scans"
        folder = scans if scans.is_dir() else self.scannet
        return (
            f"no PS15 instance in {folder} with {self.scan2cad.name}: {first}. "
            f"Expected {folder}/<scene>/<scene>_vh_clean_2.ply and its labels"
        )

    def _scene_instances(self, scene_id: str) -> tuple[dict[int, ScanInstance], str]:
        if self._scene is None or self._scene[0] != scene_id:
            annotation = self._annotations.get(scene_id)
            folder = scene_folder(self.scannet, scene_id)
            if annotation is None or folder is None:
                raise InputError(f"scene {scene_id!r} is not in both ScanNet and Scan2CAD")
            found = self._reader.read(annotation).instances
            digests = [file_sha256(path) for _, path in sorted(scene_files(folder).items())]
            whole = hashlib.sha256(json.dumps([digests, _plain(annotation)]).encode()).hexdigest()
            self._scene = scene_id, found, whole
        return self._scene[1], self._scene[2]


def _label_map_of(scannet: Path) -> Path:
    """Where the label map is: in the folder, or beside it where the folder is scans/ itself."""
    inside, beside = scannet / LABEL_MAP, scannet.parent / LABEL_MAP
    return beside if beside.is_file() and not inside.is_file() else inside


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
