"""From one object to its rows: load → poses → views → draw. Runs in a worker process.

What comes out depends only on the job and the object: every random draw is keyed by (seed, data
set, split, object id, view, purpose).
"""

from __future__ import annotations

import pickle
import uuid
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.names import printable
from partialbench.dataset.objects import stored_id
from partialbench.dataset.others import Others, draw_others
from partialbench.dataset.schema import FIELDS
from partialbench.dataset.seeding import generator
from partialbench.dataset.settings import SETTINGS
from partialbench.dataset.shards import Columns, PackedImages, pack_image, row_digests
from partialbench.dataset.sources import (
    FEW_POINTS,
    ObjectRef,
    Occluder,
    RejectedView,
    Source,
    View,
)
from partialbench.errors import InputError
from partialbench.geometry import portable
from partialbench.geometry.camera import sample_pose
from partialbench.geometry.symmetry import symmetry_of

CANONICAL_PLACE = np.array([0.0, 0.0, 3.5])
"""Where an object is that no camera places: at the middle of the paper's depths."""

ALIGNED_POSE = (np.eye(3), CANONICAL_PLACE)
"""The pose of the setting "aligned"."""

LEAST_VISIBLE = 16
"""Distinct points that a view shows at least, by default: fewer tell nothing of a shape."""

BROKEN_INPUT = (InputError, ArithmeticError, LookupError, OSError, ValueError, RuntimeError)
"""The errors by which a damaged input shows itself: recorded, and the run goes on."""


@dataclass(frozen=True)
class Job:
    """Everything a worker needs besides the object: sent with every task, unpickled once a process.

    Attributes:
        dataset_id: enters the random keys.
        setting: of ``settings.SETTINGS``.
        views: split → viewpoints per object.
        points: P, points per row.
        seed: of the whole data set.
        min_visible: a view that shows fewer distinct points is turned away.
    """

    source: Source
    occluder: Occluder
    dataset_id: str
    setting: str
    views: dict[str, int]
    points: int
    seed: int
    min_visible: int = LEAST_VISIBLE


@dataclass
class ObjectRows:
    """What became of one object.

    Attributes:
        columns: its rows (possibly none), without their depth images.
        depth: the rows' depth images where they are kept, already packed.
        source_sha256: digest of what it was made from, "" when it could not be read.
        failures: JSON records of what gave no row.
        notices: what the source says of the object's file, such as lines that were left out.
    """

    object_id: str
    columns: Columns | None
    source_sha256: str = ""
    failures: list[dict[str, Any]] = field(default_factory=list)
    depth: PackedImages | None = None
    notices: tuple[str, ...] = ()


def make_rows(job: Job, ref: ObjectRef) -> ObjectRows:
    """Rows of one object. Never raises for what is wrong with the object: it is recorded."""
    try:
        return _make_rows(job, ref)
    except BROKEN_INPUT as error:
        return ObjectRows(ref.object_id, None, failures=[failure_record(ref, error)])


def failure_record(ref: ObjectRef, error: BaseException | str) -> dict[str, Any]:
    """The line of failures.jsonl for an object that an error stopped."""
    return {
        "kind": "failed", "split": ref.split, "object_id": ref.object_id,
        "location": printable(ref.location),
        "reason": error if isinstance(error, str) else reason_of(error),
    }  # fmt: skip


def reason_of(error: BaseException) -> str:
    """What an error says, with its type where it is none of ours."""
    kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
    return kind + (str(error) or repr(error))


def _make_rows(job: Job, ref: ObjectRef) -> ObjectRows:
    encoded = stored_id(ref.object_id)
    shape = job.source.load(ref)
    views = job.views[ref.split]
    key = (job.dataset_id, ref.split, ref.object_id)
    class_symmetry = symmetry_of(job.source.class_names[ref.label]).name
    rows: list[dict[str, Any]] = []
    images: list[bytes] = []
    failures = []
    image_shape = (0, 0)
    others: list[Any] = []
    if getattr(job.occluder, "occluders", 0):
        others = draw_others(job.source, ref, generator(job.seed, *key, "others"))
    for v, view in enumerate(_views(job, shape, key, views, others)):
        if isinstance(view, RejectedView):
            failures.append(
                {"kind": "rejected", "split": ref.split, "object_id": ref.object_id, "view": v,
                 "location": printable(ref.location), "reason": view.reason,
                 "details": view.details}
            )  # fmt: skip
            continue
        chosen = draw(len(view.points), job.points, generator(job.seed, *key, v, "draw"))
        rows.append(_row(view, chosen, ref.label, encoded, v, view.symmetry or class_symmetry))
        if view.depth is not None:
            images.append(pack_image(view.depth))
            image_shape = view.depth.shape
    return ObjectRows(
        ref.object_id,
        _stack(rows),
        job.source.digest(ref),
        failures,
        PackedImages(image_shape, images) if images else None,
        tuple(getattr(shape, "metadata", {}).get("notices", ())),
    )


def _views(
    job: Job, shape: Any, key: tuple[str, str, str], count: int, others: list[Any]
) -> list[View | RejectedView]:
    """An object's views; one that a rule turns away is drawn again, if the occluder allows it.

    Every draw has a key of its own, so that a view does not depend on what became of the others.
    """
    setting = SETTINGS[job.setting]
    # A fixed pose stays what it is.
    fixed = setting.whole and setting.turns == "none"
    attempts = 1 if fixed else getattr(job.occluder, "attempts", 1)
    views: list[View | RejectedView] = []
    missing = list(range(count))
    for attempt in range(attempts):
        again = (attempt,) if attempt else ()
        keys = [(*key, v, *again) for v in missing]
        poses = _poses(job, shape, keys)
        rngs = [generator(job.seed, *k, "occluder") for k in keys]
        before = {}
        if others:
            before["others"] = Others(others, [generator(job.seed, *k, "occluders") for k in keys])
        seen = job.occluder.views(shape, poses, rngs, **before)
        for v, view in zip(missing, seen, strict=True):
            views[v : v + 1] = [_with_enough_points(view, job.min_visible)]
        missing = [
            v for v, view in enumerate(views) if isinstance(view, RejectedView) and not view.final
        ]
        if not missing:
            break
    if not setting.whole and setting.turns != "so3":
        views = [
            view if isinstance(view, RejectedView) else _moved(view, _canonical(job, (*key, v)))
            for v, view in enumerate(views)
        ]
    if attempts == 1:
        return views
    return [
        RejectedView(view.reason, {**view.details, "attempts": attempts})
        if isinstance(view, RejectedView) and not view.final
        else view
        for view in views
    ]


def _with_enough_points(view: View | RejectedView, minimum: int) -> View | RejectedView:
    if isinstance(view, RejectedView) or view.n_visible >= minimum:
        return view
    details = {"visible": int(view.n_visible), "minimum": minimum}
    return RejectedView(FEW_POINTS, details, final=view.occluded_fraction is not None)


def _poses(
    job: Job, shape: Any, keys: list[tuple[str | int, ...]]
) -> list[tuple[NDArray, NDArray]]:
    setting = SETTINGS[job.setting]
    if setting.whole and setting.turns != "so3":
        return [_canonical(job, key) for key in keys]
    rngs = [generator(job.seed, *key, "pose") for key in keys]
    # "rotated" is about all of SO(3): where a person could stand does not bear on it.
    choose = None if setting.whole else getattr(job.source, "poses", None)
    return choose(shape, rngs) if choose else [sample_pose(rng) for rng in rngs]


def _canonical(job: Job, key: tuple[str | int, ...]) -> tuple[NDArray, NDArray]:
    """The pose of a setting with the object's axes: canonical, or turned about the object's z."""
    if SETTINGS[job.setting].turns == "none":
        return ALIGNED_POSE
    angle = generator(job.seed, *key, "turn").uniform(0, 2 * np.pi)
    return portable.axis_rotation("z", angle), CANONICAL_PLACE


def _moved(view: View, pose: tuple[NDArray, NDArray]) -> View:
    """What a view shows, in another frame: no camera's, so that there is no image either."""
    R, t = pose
    canonical = portable.product(view.points - view.t_camera_object, view.R_camera_object)
    return replace(
        view,
        points=(portable.product(canonical, R.T) + t).astype(np.float32),
        R_camera_object=R,
        t_camera_object=t,
        K=np.zeros((3, 3)),
    )


def draw(n: int, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """``count`` of the indices 0 … n − 1 in random order: (count,) int64.

    Without replacement; where n < count, all of them first, then repeats drawn at random.
    """
    if n == 0:
        raise InputError("a view has no visible point")
    if n >= count:
        return rng.choice(n, count, replace=False)
    return np.concatenate([rng.permutation(n), rng.integers(0, n, count - n)])


def _row(view: View, chosen: NDArray, label: int, object_id: bytes, index: int,
         symmetry: str) -> dict[str, Any]:  # fmt: skip
    row: dict[str, Any] = {
        "points": view.points[chosen],
        "label": label,
        "object_id": object_id,
        "view": index,
        "R_camera_object": view.R_camera_object,
        "t_camera_object": view.t_camera_object,
        "K": view.K,
        "visible_fraction": view.visible_fraction,
        "n_visible": view.n_visible,
        "symmetry": symmetry.encode(),
    }
    if view.normals is not None:
        if len(view.normals) != len(view.points):
            raise InputError(
                f"the occluder gave {len(view.normals)} normals for {len(view.points)} points"
            )
        row["normals"] = view.normals[chosen]
    if view.occluded_fraction is not None:
        row["occluded_fraction"] = view.occluded_fraction
    return row


def _stack(rows: list[dict[str, Any]]) -> Columns | None:
    if not rows:
        return None
    columns = {
        field.name: np.asarray([row[field.name] for row in rows], field.dtype)
        for field in FIELDS
        if field.name in rows[0]
    }
    for name, values in columns.items():
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise InputError(f"the occluder gave non-finite values in {name!r}")
    columns["row_sha256"] = row_digests(columns)
    return columns


def pickled(job: Job) -> bytes:
    """A job for ``run_pickled``, of this build alone.

    A process may live through several builds (inline, a cluster's workers): an equal job of an
    earlier one would be remembered with files as they were open then.
    """
    return pickle.dumps((uuid.uuid4().bytes, job))


@lru_cache(maxsize=2)
def _unpickled(payload: bytes) -> Job:
    job: Job = pickle.loads(payload)[1]
    return job


def run_pickled(payload: bytes, ref: ObjectRef) -> ObjectRows:
    """``make_rows`` for a ``pickled`` job, unpickled once a process: what an executor is given."""
    return make_rows(_unpickled(payload), ref)
