"""Releases in HDF5: their splits, names and normals are taken, and every quirk is told."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from partialbench.cli import app
from partialbench.dataset.loader import ShardDataset
from partialbench.dataset.shards import read_columns
from partialbench.dataset.verify import verify
from partialbench.errors import InputError
from renderers.scanobjectnn import CLASSES, import_scanobjectnn
from renderers.sources.clouds import CompleteClouds, normalise_cloud
from renderers.sources.open import open_source

NAMES = ["airplane", "bathtub", "bed"]


def store(path: Path, rng, labels: list[int], **more: object) -> np.ndarray:
    points = rng.normal(size=(len(labels), 40, 3)).astype(np.float32)
    normals = points / np.linalg.norm(points, axis=2, keepdims=True)
    fields = {"data": points, "label": np.array(labels, np.uint8)[:, None], "normal": normals}
    with h5py.File(path, "w") as file:
        for name, value in (fields | more).items():
            file[name] = value
    return points


@pytest.fixture
def release(tmp_path: Path, rng) -> tuple[Path, np.ndarray]:
    root = tmp_path / "modelnet40_ply_hdf5_2048"
    root.mkdir()
    points = store(root / "ply_data_train0.h5", rng, [0, 2, 1])
    store(root / "ply_data_test0.h5", rng, [2])
    (root / "shape_names.txt").write_text("\n".join(["mug", "pan", "pot"]) + "\n")
    for split in ("train", "test"):
        (root / f"{split}_files.txt").write_text(f"data/{root.name}/ply_data_{split}0.h5\n")
    (root / "ply_data_train_0_id2file.json").write_text(
        json.dumps(["mug/mug_0001.ply", "pot/pot_0007.ply", "pan/pan_0002.ply"])
    )
    return root, points


def test_the_release_has_its_splits_names_and_normals(release) -> None:
    root, points = release
    for path in (root, root / "ply_data_train0.h5"):
        source = open_source(path, up="z")
        assert source.class_names == ("mug", "pan", "pot")
        train = source.objects("train")
        assert [(r.object_id, r.label) for r in train] == [
            ("mug/mug_0001", 0), ("pot/pot_0007", 2), ("pan/pan_0002", 1),
        ]  # fmt: skip
        cloud = source.load(train[1])
        np.testing.assert_allclose(cloud.points, normalise_cloud(points[1]), atol=1e-7)
        expected = points[1] / np.linalg.norm(points[1], axis=1, keepdims=True)
        np.testing.assert_allclose(cloud.normals, expected, atol=1e-6)
    both = open_source(root)
    assert [r.object_id for r in both.objects("test")] == ["ply_data_test0/00000"]
    assert "3 classes, 3 training, 1 test objects; splits from train_files.txt" in both.listing
    assert "y up, as it is published" in both.listing
    # As published: y is up.
    assert both.describe()["up"] == "y"
    turned = both.load(both.objects("train")[1])
    x, y, z = open_source(root, up="z").load(both.objects("train")[1]).normals.T
    np.testing.assert_allclose(turned.normals, np.stack([x, -z, y], axis=1), atol=1e-7)


def test_names_that_begin_as_modelnet40s_are_all_of_them(release, rng) -> None:
    root, _ = release
    (root / "shape_names.txt").write_text("\n".join(NAMES))
    (root / "ply_data_train_0_id2file.json").unlink()
    store(root / "ply_data_train0.h5", rng, [0, 8, 33])
    source = open_source(root)
    assert [source.class_names[r.label] for r in source.objects("train")] == [
        "airplane", "chair", "table",
    ]  # fmt: skip


def test_what_lists_and_files_disagree_on_is_left_out_or_told(release, rng) -> None:
    root, _ = release
    store(root / "ply_data_train1.h5", rng, [0])
    (root / "test_files.txt").write_text("ply_data_test0.h5\nply_data_test1.h5\n")
    rejected = {(r.location, r.reason, r.failed) for r in open_source(root).rejected}
    assert rejected == {
        ("ply_data_train1.h5", "is in none of train_files.txt, test_files.txt", True),
        ("ply_data_test1.h5", "is in a list, but not in the folder", True),
    }
    (root / "test_files.txt").write_text("ply_data_train0.h5\n")
    with pytest.raises(InputError, match=r"ply_data_train0.h5 is in both lists"):
        open_source(root)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"label": np.array([0, 1.5, 1])}, "row 1 of label is 1.5, expected a whole number"),
        ({"label": np.array([0, np.nan, 1])}, "row 1 of label is nan"),
        ({"label": np.array([0, -1, 1])}, "row 1 of label is -1"),
        ({"label": np.array([0, 3, 1])}, "labels up to 3, but 3 names of classes"),
        ({"label": np.zeros((3, 3))}, r"label has shape \(3, 3\), expected \(M,\)"),
        ({"label": np.zeros(2)}, "the counts differ: {'data': 3, 'label': 2}"),
        ({"label": np.array([0, 1, 2])}, "row 1 has label 1 .pan., its id2file.json says 'pot"),
        ({"data": np.zeros((3, 40, 4), "f4")}, r"float32 \(3, 40, 4\), expected floats \(M,N,3\)"),
    ],
)
def test_arrays_of_another_kind_are_told(release, rng, more, message: str) -> None:
    root, _ = release
    store(root / "ply_data_train0.h5", rng, [0, 2, 1], **more)
    with pytest.raises(InputError, match=message):
        open_source(root)


def test_lists_are_read_however_they_were_saved(release) -> None:
    root, _ = release
    (root / "shape_names.txt").write_bytes("\ufeffTöpfe\r\npan\r\npot\r\n\r\n".encode())
    (root / "train_files.txt").write_bytes("ply_data_train0.h5\r\n".encode("utf-16"))
    (root / "test_files.txt").write_bytes("\ufeffply_data_test0.h5".encode())
    (root / "ply_data_train_0_id2file.json").write_bytes(b'\xef\xbb\xbf["a.ply", "b.ply", "c.ply"]')
    source = open_source(root)
    assert source.class_names == ("Töpfe", "pan", "pot")
    assert [r.object_id for r in source.objects("train")] == ["a", "b", "c"]
    assert source.rejected == []
    (root / "shape_names.txt").write_bytes("Töpfe\npan\npot".encode("latin-1"))
    assert open_source(root).class_names == ("Töpfe", "pan", "pot")


@pytest.mark.parametrize(
    ("names", "message"),
    [("mug\n\npan\npot\n", "line 2 is empty"), ("mug\npan\nmug\n", "line 3 is 'mug' for the")],
)
def test_a_class_is_the_number_of_its_line(release, names: str, message: str) -> None:
    root, _ = release
    (root / "shape_names.txt").write_text(names)
    with pytest.raises(InputError, match=message):
        open_source(root)


def test_a_broken_file_of_a_release_is_left_out(release) -> None:
    root, _ = release
    whole = (root / "ply_data_train0.h5").read_bytes()
    (root / "ply_data_train1.h5").write_bytes(whole[: len(whole) // 2])
    with (root / "train_files.txt").open("a") as listed:
        listed.write("ply_data_train1.h5\n")
    source = open_source(root)
    assert len(source.objects("train")) == 3
    [left] = source.rejected
    assert (left.location, left.failed) == ("ply_data_train1.h5", True)
    assert "is not a readable HDF5 file" in left.reason
    with pytest.raises(InputError, match="is not a readable HDF5 file"):
        open_source(root / "ply_data_train1.h5")


def test_two_releases_in_one_folder_are_not_mixed(release) -> None:
    root, _ = release
    (root.parent / "other").mkdir()
    (root.parent / "other" / "ply_data_test0.h5").write_bytes(
        (root / "ply_data_test0.h5").read_bytes()
    )
    with pytest.raises(InputError, match=r"has ply_data_test0.h5 in .*; give one of these folders"):
        open_source(root.parent)


def test_two_lists_of_classes_are_not_chosen_from(release) -> None:
    root, _ = release
    (root / "shape_names.txt").rename(root / "modelnet40_shape_names.txt")
    assert open_source(root).class_names == ("mug", "pan", "pot")
    (root / "modelnet10_shape_names.txt").write_text("pan\nmug\npot\n")
    with pytest.raises(InputError, match=r"modelnet10_shape_names.*, which name other classes"):
        open_source(root)


def test_a_mesh_in_both_splits_and_a_broken_list_are_told(release) -> None:
    root, _ = release
    (root / "ply_data_test_0_id2file.json").write_text('["pot/pot_0007.ply"]')
    assert "1 meshes are in both splits by the id2file.json lists (pot/pot_0007" in (
        open_source(root).listing
    )
    (root / "ply_data_test_0_id2file.json").write_text("[")
    with pytest.raises(InputError, match=r"id2file\.json: cannot be read as JSON"):
        open_source(root)


def test_what_a_mac_leaves_beside_the_files_is_no_file_of_the_release(release) -> None:
    root, _ = release
    (root / "._ply_data_train0.h5").write_bytes(b"Mac OS X")
    assert open_source(root).rejected == []


OWN = {
    "class_names": np.array([b"a", b"b"]),
    "train/points": np.random.default_rng(0).normal(size=(3, 3, 30)),
    "train/label": np.array([0, 1, 0]),
    "train/object_id": np.array([b"o0", b"o1", b"o2"]),
}


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("class_names", np.array([0, 1]), r"class_names is int64 \(2,\), expected strings"),
        ("class_names", "a,b", r"class_names is object \(\), expected strings of shape"),
        ("class_names", np.array([b"K\xe4se", b"b"]), r"holds b'K\\xe4se', which is no UTF-8"),
        ("class_names", np.array([b"a", b"a"]), "class_names has a name twice: a, a"),
        ("class_names", np.array([b"a", b"a "]), "class_names has a name twice: a, a "),
        ("class_names", np.array([b"a", b" "]), "name 1 of class_names is empty"),
        ("train/object_id", np.arange(3), r"object_id is int64 \(3,\), expected strings"),
        ("train/object_id", np.array([b"a\xff", b"b", b"c"]), "which is no UTF-8"),
        ("train/label", np.array([0, 1.5, 0]), "row 1 of label is 1.5, expected a whole number"),
        ("train/label", np.eye(3), r"label has shape \(3, 3\)"),
        ("train/label", np.array([b"a", b"b", b"a"]), "label is |S1, expected whole numbers"),
        ("train/points", np.zeros((3, 3, 3)), r"points have shape \(3, 3, 3\), expected"),
        ("train", np.zeros((3, 30, 3)), "train is an array, expected a group of points"),
    ],
)
def test_quirks_of_the_own_layout_are_told(tmp_path: Path, name: str, value, message: str) -> None:
    with h5py.File(tmp_path / "c.h5", "w") as file:
        for key, content in {**OWN, name: value}.items():
            if key == name or not key.startswith(name):
                file[key] = content
    with pytest.raises(InputError, match=message):
        CompleteClouds(tmp_path / "c.h5")


def test_a_third_split_of_the_own_layout_is_told(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "c.h5", "w") as file:
        for key, content in OWN.items():
            file[key] = content
            if key.startswith("train"):
                file[key.replace("train", "val")] = content
    source = CompleteClouds(tmp_path / "c.h5")
    assert source.listing.endswith("3 training, 0 test objects; left out: the groups val")
    assert [(r.location, r.failed) for r in source.rejected] == [("val", True)]


@pytest.fixture
def scans(tmp_path: Path, rng) -> Path:
    folder = tmp_path / "h5" / "main_split"
    folder.mkdir(parents=True)
    for split, count in (("training", 5), ("test", 3)):
        store(folder / f"{split}_objectdataset.h5", rng, [k % 15 for k in range(9, 9 + count)],
              label=np.arange(9, 9 + count) % 15, mask=np.ones((count, 40)))  # fmt: skip
    return folder


def test_scanobjectnn_has_classes_and_no_pose(scans: Path, tmp_path: Path) -> None:
    manifest = import_scanobjectnn(scans.parent, tmp_path / "out")
    assert manifest.dataset_id == "scanobjectnn"
    assert (manifest.rows("train"), manifest.rows("test")) == (5, 3)
    assert manifest.configuration["pose"] == "none"
    assert "their poses are not known" in manifest.listing
    assert verify(tmp_path / "out").problems == []
    data = ShardDataset(tmp_path / "out", "train", 40)
    assert not data.has_poses
    assert [data.class_names[label] for label in data.labels[:2]] == ["table", "bed"]
    assert CLASSES.index("toilet") == 14
    with h5py.File(scans / "training_objectdataset.h5") as file:
        points = file["data"][1].astype(float)
    centred = points - points.mean(axis=0)
    expected = centred / np.linalg.norm(centred, axis=1).max()
    got = read_columns(tmp_path / "out" / "train-00000.h5")["points"][1]
    np.testing.assert_allclose(np.sort(got, axis=0), np.sort(expected, axis=0), atol=1e-6)


def test_scanobjectnn_is_imported_not_rendered(scans: Path, tmp_path: Path, rng) -> None:
    with pytest.raises(InputError, match="partialbench import scanobjectnn"):
        open_source(scans)
    run = CliRunner().invoke(
        app, ["import", "scanobjectnn", str(scans), "--out", str(tmp_path / "o")]
    )
    assert run.exit_code == 0, run.stderr
    for name in ("training_augmented.h5", "test_augmented.h5"):
        store(scans / name, rng, [0, 1])
    with pytest.raises(
        InputError, match=r"has 2 pairs of files .*: training_augmented.h5, training"
    ):
        import_scanobjectnn(scans, tmp_path / "out")
    one = import_scanobjectnn(scans / "test_objectdataset.h5", tmp_path / "out")
    assert one.configuration["source"]["files"]["train"] == "training_objectdataset.h5"


def test_an_import_that_loses_a_row_fails(tmp_path: Path, rng) -> None:
    for split in ("train", "test"):
        points = rng.normal(size=(3, 20, 3))
        points[1, 4] = np.nan if split == "train" else 0.5
        np.save(tmp_path / f"{split}_points.npy", points)
        np.save(tmp_path / f"{split}_labels.npy", np.array([0, 20, 39]))
        np.save(tmp_path / f"{split}_gt_rot.npy", np.tile(np.eye(3), (3, 1, 1)))
    command = ["import", "papnet", str(tmp_path), "--out", str(tmp_path / "out")]
    run = CliRunner().invoke(app, command)
    assert run.exit_code == 1
    assert "1 row(s) were lost" in str(run.exception)
    assert "row_000001" in (tmp_path / "out" / "failures.jsonl").read_text()
    assert CliRunner().invoke(app, [*command, "--allow-failures"]).exit_code == 0
