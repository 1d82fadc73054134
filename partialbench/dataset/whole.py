"""The whole objects behind the rows of a data folder, where their source is at hand."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.objects import stored_id
from partialbench.dataset.render import source_of
from partialbench.dataset.seeding import generator
from partialbench.dataset.sources import OrientedCloud

if TYPE_CHECKING:
    import trimesh


def whole_objects(
    folder: Path, split: str, object_ids: Sequence[str], points: int
) -> dict[str, NDArray[np.float32]]:
    """Object id → (points,3) on its whole surface, object frame, of those that can be had.

    Only the built-in shapes are made anew from what a folder records; objects of a data set that
    was read from files are not looked for, and are missing in the answer.
    """
    source, _ = source_of(folder)
    if source is None:
        return {}
    wanted = set(object_ids)
    refs = {stored_id(ref.object_id).decode(): ref for ref in source.objects(split)}
    return {
        name: _sample(source.load(refs[name]), points, name)
        for name in sorted(wanted & refs.keys())
    }


def _sample(
    shape: trimesh.Trimesh | NDArray | OrientedCloud, points: int, name: str
) -> NDArray[np.float32]:
    rng = generator(0, "whole", name)
    if hasattr(shape, "faces"):  # a mesh
        import trimesh  # not by who has no meshes, nor the extra that brings it

        found, _ = trimesh.sample.sample_surface(shape, points, seed=int(rng.integers(2**31)))
        return np.asarray(found, np.float32)
    cloud = shape.points if isinstance(shape, OrientedCloud) else shape
    return np.asarray(cloud, np.float32)[rng.integers(0, len(cloud), points)]
