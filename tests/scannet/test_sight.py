"""Standing cameras have their object in sight."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from partialbench.dataset.seeding import generator
from renderers.sources.scannet.reader import NO_PLACE
from renderers.sources.scannet.sight import surface_of
from renderers.sources.scannet.source import ScanNetInstances
from tests.scannet.scenes import (
    CHAIR,
    NYU40,
    Thing,
    annotate,
    floor,
    write_annotations,
    write_ply,
    write_scene,
)


def write_with_wall(root, thing: Thing, wall: trimesh.Trimesh, label: str) -> ScanNetInstances:
    """A floor, a thing and a wall, by labels alone."""
    write_annotations(root, [write_scene(root, "scene0001_00", [thing])])
    meshes, raws = [floor(), thing.mesh(), wall], ["floor", thing.raw, label]
    whole = trimesh.util.concatenate(meshes)
    numbers = [NYU40.get(raw, 0) for raw in raws]
    labels = np.repeat(numbers, [len(m.vertices) for m in meshes])
    stem = root / "scans" / "scene0001_00" / "scene0001_00_vh_clean_2"
    write_ply(stem.with_name(stem.name + ".ply"), whole.vertices, whole.faces)
    write_ply(stem.with_name(stem.name + ".labels.ply"), whole.vertices, whole.faces, labels)
    write_annotations(root, [annotate("scene0001_00", [thing])])
    return ScanNetInstances(root, root / "full_annotations.json", viewpoints="standing")


def cameras(source: ScanNetInstances, count: int = 60) -> np.ndarray:
    [ref] = [ref for split in source.splits() for ref in source.objects(split)]
    shape = source.load(ref)
    poses = source.poses(shape, [generator(0, "sight", i) for i in range(count)])
    return np.array([
        shape.scale_m * shape.R_scan_object @ (-R.T @ t) + shape.origin for R, t in poses
    ])  # fmt: skip


def wall(x: float, y: tuple[float, float] = (-3, 3), thick: float = 0.02) -> trimesh.Trimesh:
    """Two faces a side: a decimated scan has next to no vertices in a flat wall."""
    mesh = trimesh.creation.box((thick, y[1] - y[0], 2.4))
    mesh.apply_translation((x, sum(y) / 2, 1.2))
    return mesh


@pytest.mark.parametrize("label", ["wall", "nothing"])
def test_nobody_looks_through_a_wall_whatever_its_label(tmp_path, label):
    chair = Thing("chair", CHAIR, (0.5, 0.5, 0.9), (0.7, 0))
    eyes = cameras(write_with_wall(tmp_path, chair, wall(0.0), label))
    assert (eyes[:, 0] > 0).all()
    assert np.ptp(eyes[:, 1]) > 1


def test_through_an_opening_the_object_is_in_sight(tmp_path):
    """Half the wall is missing: some cameras look through, none from behind what is there."""
    chair = Thing("chair", CHAIR, (0.5, 0.5, 0.9), (0.7, 0))
    eyes = cameras(write_with_wall(tmp_path, chair, wall(0.0, (-3, -0.6)), "wall"), 200)
    beyond = eyes[eyes[:, 0] < 0]
    assert len(beyond) > 5
    # Where the line to the chair's middle passes x = 0.
    share = beyond[:, 0] / (beyond[:, 0] - 0.7)
    assert (beyond[:, 1] * (1 - share) > -0.6 - 0.3).all()


def test_an_object_walled_in_is_turned_away(tmp_path):
    chair = Thing("chair", CHAIR, (0.5, 0.5, 0.9), (0.7, 0))
    box = trimesh.creation.box((0.62, 0.62, 2.4))
    box.apply_translation((0.7, 0, 1.2))
    source = write_with_wall(tmp_path, chair, box, "wall")
    with pytest.raises(ValueError, match=NO_PLACE):
        source.objects("train")


def test_the_floor_and_what_an_object_leans_on_hide_nothing():
    square = trimesh.creation.box((2, 2, 0.1))
    surface = surface_of(square.vertices, square.faces)
    blockers = surface.without(np.zeros(0, np.int64), square.faces)
    on_top = np.array([[0.3, 0.2, 0.06], [-0.5, 0, 0.05]])
    assert blockers.free_share(np.array([0, 0, 1.5]), on_top) == 1
    assert blockers.free_share(np.array([0, 0, -1.5]), on_top) == 0
    own = surface.without(np.arange(len(square.vertices)), square.faces)
    assert own.free_share(np.array([0, 0, -1.5]), on_top) == 1
