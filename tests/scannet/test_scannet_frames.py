from __future__ import annotations

import json

import numpy as np
import pytest

from partialbench.errors import InputError
from renderers.sources.scannet.frames import read_label_map, read_scene, settle_labels
from renderers.sources.scannet.splits import space_of
from tests.scannet.scenes import CHAIR, LABEL_MAP, Thing, relabel, write_scene


@pytest.fixture
def scene(scannet):
    return scannet / "scans" / "scene0001_00"


@pytest.fixture
def label_map(scannet):
    return read_label_map(scannet / "scannetv2-labels.combined.tsv")


def test_label_map_knows_classes_and_ids(label_map):
    assert label_map.class_of["armchair"] == "chair"
    assert label_map.class_of["printer"] == "printer"  # ModelNet40 has no printer
    assert "trash can" not in label_map.class_of
    assert label_map.nyu40_of_id[1200] == 5
    assert label_map.nyu40_ids["desk"] == {14}
    assert label_map.nyu40_ids["bathtub"] == frozenset()


def test_rare_nyu40_ids_of_a_class_are_dropped(tmp_path):
    path = tmp_path / "map.tsv"
    rare = "60\tbunk chair\tchair\t1\t39\tchair\tchair\n"
    path.write_text(LABEL_MAP.replace("\t9\t", "\t90\t") + rare)
    assert read_label_map(path).nyu40_ids["chair"] == {5}
    path.write_text(LABEL_MAP.replace("\t9\t", "\t9\t") + rare)
    assert read_label_map(path).nyu40_ids["chair"] == {5, 39}


def test_scene_is_read_vertex_by_vertex(scene, label_map):
    read = read_scene(scene, label_map)
    text = (scene / f"{scene.name}_vh_clean_2.labels.ply").read_text()
    rows = text.split("end_header\n")[1].splitlines()[: len(read.vertices)]
    expected = np.array([row.split() for row in rows], float)
    np.testing.assert_allclose(read.vertices, expected[:, :3], atol=1e-6)
    np.testing.assert_array_equal(read.labels, expected[:, 3])
    assert read.groups is None
    assert read.notes == {}
    floor_top = (read.labels == 2) & (np.abs(read.vertices[:, :2]).max(axis=1) < 2.8)
    floor_top &= np.isclose(read.vertices[:, 2], 0, atol=1e-6)
    np.testing.assert_allclose(read.normals[floor_top], [[0, 0, 1]] * floor_top.sum(), atol=1e-6)


def test_labels_above_40_are_mapped_or_dropped_and_noted(scene, label_map):
    before = read_scene(scene, label_map).labels
    chairs, bins = relabel(scene, 5, 1200), relabel(scene, 39, 999)
    assert chairs > 0
    assert bins > 0
    read = settle_labels(read_scene(scene, label_map), [], label_map)
    np.testing.assert_array_equal(read.labels, np.where(before == 39, 0, before))
    assert read.notes["labels"] == "nyu40"
    assert read.notes["labels_mapped"] == {"1200": chairs}
    assert read.notes["labels_unknown"] == {"999": bins}


def test_segmentation_stands_in_for_missing_labels(tmp_path, label_map):
    write_scene(tmp_path, "scene0002_00", [Thing("chair", CHAIR, (0.5, 0.5, 0.9), (0, 0))], True)
    folder = tmp_path / "scans" / "scene0002_00"
    with_labels = read_scene(folder, label_map)
    (folder / "scene0002_00_vh_clean_2.labels.ply").unlink()
    without = read_scene(folder, label_map)
    np.testing.assert_array_equal(without.labels, with_labels.labels)
    assert [g.label for g in without.groups] == ["floor", "chair"]


def test_missing_files_are_named(scene, label_map):
    labels = scene / f"{scene.name}_vh_clean_2.labels.ply"
    labels.rename(scene / "elsewhere")
    with pytest.raises(InputError, match=r"neither .*labels\.ply nor both of .*segs\.json"):
        read_scene(scene, label_map)
    (scene / f"{scene.name}_vh_clean_2.ply").unlink()
    with pytest.raises(InputError, match=r"scene0001_00_vh_clean_2\.ply is missing"):
        read_scene(scene, label_map)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("_vh_clean_2.ply", b"ply\nformat ascii 1.0\nelement vertex 5\n", "damaged PLY"),
        ("_vh_clean_2.ply", b"not a mesh", "damaged PLY"),
        ("_vh_clean_2.0.010000.segs.json", b'{"segIndices": [1, 2]}', "the mesh has"),
        ("_vh_clean_2.0.010000.segs.json", b'{"segIndices": ["a"]}', "not integers"),
        ("_vh_clean_2.0.010000.segs.json", b'{"segIndices": [1, 2.5]}', "2.5 is no whole number"),
        ("_vh_clean_2.0.010000.segs.json", b"{", "damaged"),
        (".aggregation.json", b'{"groups": []}', "segGroups"),
        (".aggregation.json", b'{"segGroups": [{"label": "chair"}]}', "objectId"),
        (
            ".aggregation.json",
            b'{"segGroups": [{"objectId": 0, "label": "chair", "segments": [97, 98]}]}',
            "names the segments 97, 98, …, none of which the mesh has",
        ),
    ],
)
def test_damaged_files_are_named(tmp_path, label_map, name, content, message):
    write_scene(tmp_path, "scene0002_00", [Thing("chair", CHAIR, (0.5, 0.5, 0.9), (0, 0))], True)
    folder = tmp_path / "scans" / "scene0002_00"
    (folder / f"scene0002_00{name}").write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        read_scene(folder, label_map)
    assert name in str(caught.value)


def test_truncated_binary_mesh_is_an_input_error(tmp_path, label_map, scene):
    import trimesh

    path = scene / f"{scene.name}_vh_clean_2.ply"
    trimesh.creation.icosphere().export(path)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(InputError, match="damaged PLY"):
        read_scene(scene, label_map)


def test_truncated_text_mesh_is_an_input_error(label_map, scene):
    path = scene / f"{scene.name}_vh_clean_2.ply"
    whole = path.read_bytes()
    for kept in (len(whole) // 2, len(whole) - 40, len(whole.rstrip().rpartition(b" ")[0])):
        path.write_bytes(whole[:kept])
        with pytest.raises(InputError, match=r"vh_clean_2\.ply: the ASCII PLY was cut short"):
            read_scene(scene, label_map)


def test_segments_of_the_full_resolution_mesh_are_not_taken_for_ours(tmp_path, label_map):
    """ScanNet has an aggregation for each of its two meshes, with the same object numbers."""
    write_scene(tmp_path, "scene0002_00", [Thing("chair", CHAIR, (0.5, 0.5, 0.9), (0, 0))], True)
    folder = tmp_path / "scans" / "scene0002_00"
    own = folder / "scene0002_00.aggregation.json"
    own.rename(folder / "scene0002_00_vh_clean.aggregation.json")
    assert read_scene(folder, label_map).groups is None
    own.write_text('{"segGroups": []}')
    assert read_scene(folder, label_map).groups == []


def test_a_segment_named_twice_or_absent_changes_no_object(tmp_path, label_map):
    write_scene(tmp_path, "scene0002_00", [Thing("chair", CHAIR, (0.5, 0.5, 0.9), (0, 0))], True)
    folder = tmp_path / "scans" / "scene0002_00"
    before = read_scene(folder, label_map)
    path = folder / "scene0002_00.aggregation.json"
    data = json.loads(path.read_text())
    for group in data["segGroups"]:
        group["segments"] = [*group["segments"], 97, *group["segments"]]
    path.write_text(json.dumps(data))
    read = read_scene(folder, label_map)
    np.testing.assert_array_equal(read.labels, before.labels)
    assert [len(g.segments) for g in read.groups] == [len(g.segments) + 1 for g in before.groups]
    assert read.notes == {"segments_absent": 1}


def test_labels_of_another_mesh_are_refused(scene, label_map):
    mesh = scene / f"{scene.name}_vh_clean_2.ply"
    other = scene.parent / "scene0009_00"
    write_scene(scene.parent.parent, "scene0009_00", [])
    mesh.write_bytes((other / "scene0009_00_vh_clean_2.ply").read_bytes())
    with pytest.raises(InputError, match=r"labels \d+ vertices, the mesh has \d+"):
        read_scene(scene, label_map)


def test_labels_in_another_order_are_refused(scene, label_map):
    """As many vertices, each somewhere else: the numbers would be other vertices'."""
    path = scene / f"{scene.name}_vh_clean_2.labels.ply"
    head, body = path.read_text().split("end_header\n")
    count = int(head.split("element vertex ")[1].split()[0])
    rows = body.splitlines(keepends=True)
    path.write_text(head + "end_header\n" + "".join(rows[count - 1 :: -1] + rows[count:]))
    with pytest.raises(InputError, match=r"labels\.ply: vertex 0 is at .*, the mesh's vertex 0 at"):
        read_scene(scene, label_map)


def test_scans_are_read_in_every_dialect_that_meshes_are(scene, label_map):
    before = read_scene(scene, label_map)
    for kind in ("", ".labels"):
        path = scene / f"{scene.name}_vh_clean_2{kind}.ply"
        path.write_bytes(path.read_bytes().replace(b"\n", b"\r"))
    read = read_scene(scene, label_map)
    for name in ("vertices", "faces", "normals", "labels"):
        np.testing.assert_array_equal(getattr(read, name), getattr(before, name))


def test_more_faces_than_a_scan_counts_are_an_input_error(scene, label_map):
    path = scene / f"{scene.name}_vh_clean_2.ply"
    path.write_bytes(path.read_bytes() + b"3 0 1 2\n")
    with pytest.raises(InputError, match=r"1 lines follow the \d+ that the PLY header counts"):
        read_scene(scene, label_map)


def test_label_map_errors(tmp_path):
    with pytest.raises(InputError, match="part of the ScanNet download: put it into the --scannet"):
        read_label_map(tmp_path / "absent.tsv")
    path = tmp_path / "map.tsv"
    path.write_text("id\traw_category\n1\twall\n")
    with pytest.raises(InputError, match="ModelNet40, ShapeNetCore55, count, nyu40id"):
        read_label_map(path)
    path.write_bytes(b"\xef\xbb\xbf" + LABEL_MAP.encode())  # as spreadsheets save it
    assert read_label_map(path).class_of["armchair"] == "chair"
    path.write_text(LABEL_MAP + "9" * 200_000)
    with pytest.raises(InputError, match="field larger than field limit"):
        read_label_map(path)
    path.write_text(LABEL_MAP + "x\tsofa\tsofa\t9\t6\tsofa\tsofa\n")
    with pytest.raises(InputError, match="line 10"):
        read_label_map(path)


def test_rescans_share_a_space():
    assert space_of("scene0470_00") == space_of("scene0470_12") == "scene0470"
