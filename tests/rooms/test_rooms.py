"""Simulated rooms through the loader of real ones: what comes out is what was put in."""

from __future__ import annotations

import builtins
import errno
import json
import os
import shutil
from collections import Counter

import numpy as np
import pytest
from trimesh.proximity import closest_point

from partialbench.dataset.categories import PS15
from partialbench.dataset.seeding import generator
from partialbench.dataset.shards import file_sha256
from partialbench.dataset.sources import View
from partialbench.errors import ConfigurationMismatchError, InputError, PartialbenchError
from partialbench.geometry.rotations import geodesic_angle
from renderers.rooms import generate
from renderers.rooms.furniture import KINDS
from renderers.rooms.generate import GENERATION, generate_rooms, split_of
from renderers.rooms.layout import furnish
from renderers.rooms.source import SimulatedRooms
from renderers.sources.open import open_source
from renderers.sources.scannet.frames import read_label_map, read_scene
from renderers.sources.scannet.occluder import ScanHprOccluder
from renderers.sources.scannet.scan2cad import R_canonical_cad
from renderers.sources.scannet.source import ScanNetInstances


@pytest.fixture(scope="module")
def whole(rooms):
    """The rooms as they are."""
    return ScanNetInstances(rooms.scannet, rooms.scan2cad, split_file=rooms.split_file)


@pytest.fixture(scope="module", params=["segmentation", "labels only"])
def source(rooms, whole, request, tmp_path_factory):
    """The rooms as they are, and without segmentation and aggregation, as the real sample is."""
    if request.param == "segmentation":
        return whole
    folder = tmp_path_factory.mktemp("labels") / "rooms"
    ignore = shutil.ignore_patterns("*.segs.json", "*.aggregation.json")
    shutil.copytree(rooms.scannet, folder, ignore=ignore)
    return ScanNetInstances(folder, rooms.scan2cad, split_file=rooms.split_file)


def truth_of(rooms) -> dict[str, dict]:
    pieces = json.loads(rooms.truth_file.read_bytes())
    return {f"{p['scene']}/{p['index']}": p for p in pieces}


def test_truth_comes_back(rooms, source):
    """At least 95 % found; of every other one its label, pose within 1°, centre within 5 cm."""
    truth = truth_of(rooms)
    assert {p["class_name"] for p in truth.values()} == set(PS15)
    refs = [ref for split in source.splits() for ref in source.objects(split)]
    assert len(refs) >= 0.95 * len(truth)
    for ref in refs[::2]:
        piece, shape = truth[ref.object_id], source.load(ref)
        assert PS15[ref.label] == shape.class_name == piece["class_name"]
        error = geodesic_angle(shape.R_scan_object, np.array(piece["R_scan_object"]))
        assert np.rad2deg(error) < 1
        centre = shape.origin + shape.scale_m * shape.R_scan_object @ shape.box_centre
        np.testing.assert_allclose(centre, piece["centre"], atol=0.05)
        np.testing.assert_allclose(
            shape.box_half_extent * shape.scale_m, piece["half_extent"], atol=1e-9
        )
        assert shape.residual_m < 0.08


def test_points_lie_on_the_furniture(rooms, whole):
    """Back in the scan, points are within a few centimetres of the CAD's true surface."""
    truth = truth_of(rooms)
    for ref in whole.objects("train")[::4]:
        piece, shape = truth[ref.object_id], whole.load(ref)
        room = furnish(int(ref.location[4:8]), seed=0)
        half = np.array(piece["half_extent"])
        [cad] = [
            p.cad for p in room.pieces if np.allclose(p.cad.size_m / 2, half, rtol=0, atol=1e-12)
        ]
        mesh = cad.mesh.copy()
        mesh.vertices = (mesh.vertices * cad.scale) @ R_canonical_cad(cad.class_name).T
        metric = (shape.points[::40] - shape.box_centre) * shape.scale_m
        distance = closest_point(mesh, metric)[1]
        assert np.median(distance) < 0.02
        assert np.percentile(distance, 95) < 0.05


def test_the_views_are_accepted(rooms):
    source = ScanNetInstances(rooms.scannet, rooms.scan2cad, "standing", rooms.split_file)
    kinds = Counter()
    for ref in source.objects("train")[:8]:
        shape = source.load(ref)
        rngs = [generator(0, ref.object_id, view) for view in range(2)]
        views = ScanHprOccluder().views(shape, source.poses(shape, rngs), rngs)
        kinds.update(isinstance(view, View) for view in views)
    assert kinds[True] >= 0.9 * kinds.total()


def test_files_are_the_official_ones(rooms):
    label_map = read_label_map(rooms.scannet / "scannetv2-labels.combined.tsv")
    assert {label_map.class_of[kind.raw]: name for name, kind in KINDS.items()} == {
        name: name for name in PS15
    }
    for name, kind in KINDS.items():
        assert label_map.nyu40_ids[name] == {kind.nyu40}
    folder = rooms.scannet / "scans" / "room0000_00"
    names = {p.name.removeprefix("room0000_00") for p in folder.iterdir()}
    assert names == {
        "_vh_clean_2.ply", "_vh_clean_2.labels.ply", "_vh_clean_2.0.010000.segs.json",
        ".aggregation.json", ".txt", "room.json",
    }  # fmt: skip
    scene = read_scene(folder, label_map)
    # Labels and segmentation say the same, vertex by vertex.
    by_group = np.zeros(len(scene.labels), int)
    for group in scene.groups:
        by_group[np.isin(scene.segments, group.segments)] = label_map.nyu40_of[group.label]
    np.testing.assert_array_equal(by_group, scene.labels)
    assert np.mean(scene.labels == 0) < 0.05


def test_rooms_are_the_same_bits_again_for_any_workers(rooms, tmp_path):
    again = generate_rooms(tmp_path / "again", 2, seed=0, workers=2)
    for index in (0, 1):
        scene = f"room{index:04d}_00"
        for path in sorted((rooms.scannet / "scans" / scene).iterdir()):
            copy = again.scannet / "scans" / scene / path.name
            assert file_sha256(path) == file_sha256(copy), path.name


def test_a_folder_is_continued_and_never_mixed(rooms, tmp_path):
    folder = tmp_path / "rooms"
    shutil.copytree(rooms.scannet, folder)
    before = (folder / "full_annotations.json").read_bytes()
    shutil.rmtree(folder / "scans" / "room0001_00")
    (folder / "scans" / ".room0001_00" / "room0001_00").mkdir(parents=True)  # a killed run's
    untouched = (folder / "scans" / "room0000_00" / "room.json").stat().st_mtime_ns
    generate_rooms(folder, 5, seed=0)
    assert (folder / "full_annotations.json").read_bytes() == before
    assert (folder / "scans" / "room0000_00" / "room.json").stat().st_mtime_ns == untouched
    with pytest.raises(ConfigurationMismatchError, match="'seed': 1"):
        generate_rooms(folder, 5, seed=1)
    with pytest.raises(ConfigurationMismatchError, match="ideal"):
        generate_rooms(folder, 5, seed=0, sensor="ideal")


def test_wrong_arguments(tmp_path):
    with pytest.raises(InputError, match="at least 1"):
        generate_rooms(tmp_path / "rooms", 0)
    with pytest.raises(InputError, match="no sensor named 'kinect'"):
        generate_rooms(tmp_path / "rooms", 1, sensor="kinect")
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(InputError, match="is not empty"):
        generate_rooms(tmp_path, 1)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_folder_that_cannot_be_used_or_is_full_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(generate, "import_open3d", lambda: None)
    (tmp_path / "file").write_text("")
    with pytest.raises(PartialbenchError, match=r"file/rooms: Not a directory.*XDG_CACHE_HOME"):
        generate_rooms(tmp_path / "file" / "rooms", 1)

    def fill(job):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(generate, "_make_room", fill)
    with pytest.raises(PartialbenchError, match=r"rooms: No space left.*XDG_CACHE_HOME"):
        generate_rooms(tmp_path / "rooms", 1)


def test_without_open3d_the_error_names_what_is_missing(tmp_path, monkeypatch):
    real = builtins.__import__

    def refuse(name, *args, **kwargs):
        if name == "open3d":
            raise OSError("libGL.so.1: cannot open shared object file")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(PartialbenchError, match=r"libGL\.so\.1.*libgl1"):
        generate_rooms(tmp_path / "rooms", 1)


def test_both_splits_hold_whole_cycles_of_room_types():
    splits = [split_of(index) for index in range(50)]
    assert splits[:15] == ["train"] * 5 + ["test"] * 5 + ["train"] * 5
    assert splits.count("test") == 10


def test_simulated_rooms_are_a_source_kept_in_the_cache(rooms, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    kept = tmp_path / "partialbench" / f"rooms-{GENERATION}-kinect-v1-seed0-5"
    kept.parent.mkdir()
    shutil.copytree(rooms.scannet, kept)
    source = SimulatedRooms(rooms=5)
    described = source.describe()
    assert (described["name"], described["rooms"], described["seed"]) == ("rooms", 5, 0)
    assert str(tmp_path) not in json.dumps(described)
    assert open_source("rooms", described=described).describe() == described
    assert len(source.objects("train")) == sum(source.counts()["train"].values()) > 20
