"""The contract between a source of shapes, an occluder and the builder.

    source.objects(split) → ObjectRef → source.load(ref) → shape → occluder.views(...) → View

A source and an occluder are picklable: the builder pickles them once and sends that to its workers
with every task.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ObjectRef:
    """One object of a source, cheap to list and to send to a worker.

    Attributes:
        object_id: unique within the split, e.g. "chair_0001"; enters the random key and the shard.
        label: index into the source's ``class_names``.
        split: "train" or "test".
        location: where the source finds it (a path, an archive member, an index); its own affair.
    """

    object_id: str
    label: int
    split: str
    location: str


@dataclass(frozen=True, eq=False)
class OrientedCloud:
    """A complete cloud whose source knows its normals.

    Attributes:
        points: (n,3) float32, object frame, normalised as ``Source.load`` says.
        normals: (n,3) float32 unit vectors of the surface at each point, object frame; which of
            the two sides they point to does not matter, a view turns them to its camera.
    """

    points: NDArray[np.float32]
    normals: NDArray[np.float32]


FEW_POINTS = "too few points"
"""The reason of a view that shows fewer distinct points than it must."""


@dataclass(eq=False)
class View:
    """What one viewpoint sees of one object.

    Attributes:
        points: (n,3) float32, camera frame, object units, n ≥ 1: of an occluder all candidates, of
            which the builder draws P; of ``render_view`` those that were drawn.
        R_camera_object: (3,3) float64.
        t_camera_object: (3,) float64, object units: p_camera = R·p_object + t.
        K: (3,3) float64 pixel intrinsics; zeros where no image was formed (hidden point removal).
        visible_fraction: share of the surface area (or of the object's points) seen, in [0, 1].
        n_visible: number of distinct surface points behind ``points`` before drawing.
        depth: (H,W) float32 z-depth, 0 = no surface, or None.
        normals: (n,3) float32 unit normals of the surface at ``points``, camera frame, turned to
            the camera (n·p < 0), or None.
        symmetry: name of this object's own symmetry group (``geometry.symmetry.GROUPS``), or None
            for its class's.
        occluded_fraction: share of the object's pixels (or of its points in view) that other
            objects hide, or None where none were put before it.
    """

    points: NDArray[np.float32]
    R_camera_object: NDArray[np.float64]
    t_camera_object: NDArray[np.float64]
    K: NDArray[np.float64]
    visible_fraction: float
    n_visible: int
    depth: NDArray[np.float32] | None = None
    normals: NDArray[np.float32] | None = None
    symmetry: str | None = None
    occluded_fraction: float | None = None

    def __repr__(self) -> str:
        beside = [n for n in ("depth", "normals") if getattr(self, n) is not None]
        return (
            f"<View of {len(self.points)} points{''.join(f', {name}' for name in beside)}; "
            f"{self.visible_fraction:.0%} of the surface seen>"
        )


@dataclass(frozen=True)
class RejectedView:
    """A view that a written rule turned away (not an error); recorded, and the run goes on.

    Attributes:
        reason: the rule, in a short phrase that is the same for every view it turns away.
        details: the values that broke it, as JSON data.
        final: no other pose is drawn for it, as what turned it away are the objects before it: it
            pairs with the view from this pose without them.
    """

    reason: str
    details: dict[str, Any] = field(default_factory=dict)
    final: bool = False


@dataclass(frozen=True)
class RejectedObject:
    """An object a source finds but will not list, with the reason; it goes to failures.jsonl.

    Attributes:
        failed: True for something broken (an unreadable archive member: the run exits 1), False for
            something a rule turned away (a class that the data set does not have).
    """

    object_id: str
    split: str
    reason: str
    location: str = ""
    details: dict[str, Any] = field(default_factory=dict)
    failed: bool = False


class Source(Protocol):
    """Where shapes come from. All attributes are plain data; the object is picklable.

    A source may also have ``poses(shape, rngs) -> list[(R_camera_object, t_camera_object)]``, one
    pose per generator: scanned scenes choose viewpoints where a person could stand. Without it the
    builder draws the paper's poses (``geometry.camera.sample_pose``), as it does for every source
    for complete clouds. It may have ``listing``, a sentence on how its files were understood,
    and ``pose``: "none" where nobody knows the poses of its objects. And ``beside(ref)``, the
    objects that may be put before one, where those are not all others of its split.

    Attributes:
        class_names: label → name, in label order.
        frame: "aligned" (category-level canonical frame) or "original" (as the file has it).
        rejected: what listing the source turned away (unreadable members and the like).
    """

    class_names: tuple[str, ...]
    frame: str
    rejected: list[RejectedObject]

    def splits(self) -> tuple[str, ...]:
        """The splits it has, "train" before "test"."""
        ...

    def objects(self, split: str) -> list[ObjectRef]:
        """The split's objects, in an order that does not depend on the machine."""
        ...

    def load(self, ref: ObjectRef) -> Any:
        """The shape: a ``trimesh.Trimesh``, an (n,3) float32 cloud in the object frame, or an
        ``OrientedCloud`` where the source has the cloud's normals. A mesh's ``metadata["notices"]``
        is what a person should know of its file, a sentence each.

        Normalised: bounding-box centre at the origin, largest norm 1. Raises ``InputError`` when
        the file is not what it should be.
        """
        ...

    def digest(self, ref: ObjectRef) -> str:
        """SHA-256 (hex) of the bytes the object is made from."""
        ...

    def describe(self) -> dict[str, Any]:
        """What defines the source, as JSON data without machine paths: enters the configuration."""
        ...


class Occluder(Protocol):
    """From a shape to what given viewpoints see of it.

    An occluder may also have ``attempts``: how often the builder draws a pose anew for a view that
    is rejected and not ``final`` (once without it). A rejected view of the last attempt is
    recorded. And ``min_visible``: how many distinct points a view of this kind shows at least, by
    default. And ``occluders``: where it is not 0, ``views`` takes ``others``
    (``dataset.others.Others``), which stand before the object.
    """

    def views(
        self, shape: Any, poses: list[tuple[NDArray, NDArray]], rngs: list[np.random.Generator]
    ) -> list[View | RejectedView]:
        """One result per pose (R_camera_object, t_camera_object), each with its own generator."""
        ...

    def describe(self) -> dict[str, Any]:
        """What defines the views, as JSON data: enters the configuration."""
        ...
