"""Trees of files are understood as a person would, and what is left out is named."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

from partialbench.errors import InputError
from renderers.sources.folder import MeshFolder
from renderers.sources.layout import understand
from renderers.sources.open import open_source

OFF = b"OFF\n4 2 0\n0 0 0\n2 0 0\n2 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n"


def write(root: Path, *names: str, content: bytes = OFF) -> Path:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(content)
    return root


def found(*names: str) -> list[tuple[str, str, str]]:
    return sorted((e.category, e.name, e.split) for e in understand(names).entries)


@pytest.mark.parametrize(
    ("names", "objects", "pattern"),
    [
        (
            ["mug/train/0.off", "mug/test/0.off", "spoon/train/0.off"],
            [("mug", "0", "test"), ("mug", "0", "train"), ("spoon", "0", "train")],
            "<class>/<split>/<file>",
        ),
        (
            ["mug/Train/0.off", "mug/TEST/1.off"],
            [("mug", "0", "train"), ("mug", "1", "test")],
            "<class>/<split>/<file>",
        ),
        (
            ["a/b/mug/train/0.off", "a/b/spoon/train/0.off"],
            [("mug", "0", "train"), ("spoon", "0", "train")],
            "<class>/<split>/<file>",
        ),
        (["mug/train/0.off"], [("mug", "0", "train")], "<class>/<split>/<file>"),
        (
            ["train/mug/0.off", "train/spoon/1.off", "test/mug/2.off"],
            [("mug", "0", "train"), ("mug", "2", "test"), ("spoon", "1", "train")],
            "<split>/<class>/<file>",
        ),
        (
            ["data/train/mug/0.off", "data/train/mug/1.off", "data/test/spoon/2.off"],
            [("mug", "0", "train"), ("mug", "1", "train"), ("spoon", "2", "test")],
            "<split>/<class>/<file>",
        ),
        (
            ["train/mug_0.off", "train/night_stand_01.off", "test/mug-2.off"],
            [("mug", "mug-2", "test"), ("mug", "mug_0", "train"),
             ("night_stand", "night_stand_01", "train")],
            "<split>/<class>_<number>.off",
        ),
        (
            ["trainval/mug/0.off", "trainval/spoon/1.off", "test_set/mug/2.off"],
            [("mug", "0", "train"), ("mug", "2", "test"), ("spoon", "1", "train")],
            "<split>/<class>/<file>",
        ),
        (["mug/a.off", "spoon/b.off"], [("mug", "a", ""), ("spoon", "b", "")], "<class>/<file>"),
        (
            ["ds/mug/a.off", "ds/mug/b.off", "ds/spoon/c.off"],
            [("mug", "a", ""), ("mug", "b", ""), ("spoon", "c", "")],
            "<class>/<file>",
        ),
        (
            ["02691156/1a/models/model_normalized.obj", "02691156/2b/models/model_normalized.obj",
             "03001627/1a/models/model_normalized.obj"],
            [("02691156", "1a", ""), ("02691156", "2b", ""), ("03001627", "1a", "")],
            "<class>/<object>/…/<file>",
        ),
        (
            ["Shape/02691156/1a/models/model_normalized.obj",
             "Shape/02691156/2b/models/model_normalized.obj"],
            [("02691156", "1a", ""), ("02691156", "2b", "")],
            "<class>/<object>/…/<file>",
        ),
        (
            ["raw/apple/apple_001/Scan/Scan.obj", "raw/apple/apple_002/Scan/Scan.obj",
             "raw/pear/pear_001/Scan/Scan.obj"],
            [("apple", "apple_001", ""), ("apple", "apple_002", ""), ("pear", "pear_001", "")],
            "<class>/<object>/…/<file>",
        ),
        (
            ["food/can/google_16k/textured.obj", "food/can/google_16k/nontextured.stl",
             "food/box/google_16k/textured.obj", "food/box/google_16k/nontextured.stl",
             "tool/saw/google_16k/textured.obj", "tool/saw/google_16k/nontextured.stl"],
            [("food", "box", ""), ("food", "can", ""), ("tool", "saw", "")],
            "<class>/<object>/…/<file>",
        ),
        (
            ["mug/train/m_0/model.obj", "mug/train/m_1/model.obj", "spoon/test/s_0/model.obj"],
            [("mug", "m_0", "train"), ("mug", "m_1", "train"), ("spoon", "s_0", "test")],
            "<class>/<split>/<object>/<file>",
        ),
        (
            ["chair/office/1.obj", "chair/office/2.obj", "chair/arm/3.obj", "chair/arm/4.obj",
             "desk/5.obj"],
            [("chair", "arm/3", ""), ("chair", "arm/4", ""), ("chair", "office/1", ""),
             ("chair", "office/2", ""), ("desk", "5", "")],
            "<class>/…/<file>, <class>/<file>",
        ),
        (
            ["car/a.off", "train/b.off", "train/c.off"],  # a class of that name
            [("car", "a", ""), ("train", "b", ""), ("train", "c", "")],
            "<class>/<file>",
        ),
        (["mug_1.off", "spoon_1.off"], [("mug", "mug_1", ""), ("spoon", "spoon_1", "")],
         "<class>_<number>.off"),
    ],
)  # fmt: skip
def test_a_tree_is_understood(names: list[str], objects: list, pattern: str) -> None:
    assert found(*names) == objects
    layout = understand(names)
    assert layout.pattern == pattern
    assert layout.left_out == []


def test_validation_is_the_test_where_there_is_no_other_else_training() -> None:
    assert found("mug/train/0.off", "mug/val/0.off") == [
        ("mug", "0", "test"),
        ("mug", "0", "train"),
    ]
    names = ("mug/train/0.off", "mug/validation/0.off", "mug/test/0.off")
    assert found(*names) == [("mug", "0", "test"), ("mug", "0", "train"), ("mug", "val/0", "train")]
    assert understand(names).notes == ["validation objects join the training objects"]


def test_what_lies_otherwise_is_left_out_by_name() -> None:
    layout = understand(["mug/train/0.off", "stray.off", "spoon/train/1.off"])
    assert layout.left_out == [("stray.off", "lies in no class's folder")]
    layout = understand(["train/mug/0.off", "test/mug/1.off", "old/2.off", "train/3.off"])
    assert sorted(layout.left_out) == [
        ("old/2.off", "lies in no split's folder"),
        ("train/3.off", "lies in no class's folder"),
    ]
    layout = understand(["mug/m/a.obj", "mug/m/b.obj", "mug/n/a.obj", "mug/n/b.obj", "pan/p.obj"])
    assert [entry.name for entry in layout.entries] == ["p"]
    assert layout.left_out[0] == (
        "mug/m/a.obj", "its folder holds a, b: which of them is the object?",
    )  # fmt: skip


def test_what_was_understood_is_said_and_enters_the_description(tmp_path: Path) -> None:
    names = [f"{c}/{s}/{i}.off" for c in "abc" for s, n in (("train", 3), ("test", 2))
             for i in range(n)]  # fmt: skip
    source = MeshFolder(write(tmp_path, *names, "one.off", "two.off"))
    assert source.listing == (
        "<class>/<split>/<file>: 3 classes, 9 training, 6 test objects; 2 files left out: one.off, "
        "two.off"
    )
    assert source.describe()["layout"] == "<class>/<split>/<file>"
    assert [(r.location, r.failed) for r in source.rejected] == [
        ("one.off", True),
        ("two.off", True),
    ]


def test_equal_names_lose_no_object(tmp_path: Path) -> None:
    """Neither from class to class nor from folder to folder."""
    names = ("sofa/train/0.off", "chair/train/0.off", "sofa/x/train/0.off", "sofa/0.off")
    source = MeshFolder(write(tmp_path, *names, "sofa/test/0.off"))
    ids = [(s, r.object_id) for s in source.splits() for r in source.objects(s)]
    assert len(ids) == len(set(ids)) == 5
    assert source.rejected == []


LISTS = {
    "modelnet40_train.txt": "mug_0000\npan_0000\n",
    "modelnet40_test.txt": "mug_0001\npan_0001\n",
    "modelnet10_train.txt": "mug_0000\n",
    "modelnet10_test.txt": "mug_0001\n",
    "modelnet40_shape_names.txt": "mug\npan\n",
    "filelist.txt": "mug/mug_0000.txt\n",
}


def resampled(root: Path, rng, **lists: str) -> Path:
    for category in ("mug", "pan"):
        (root / category).mkdir(parents=True)
        for k in range(2):
            points = rng.normal(size=(30, 3))
            normals = points / np.linalg.norm(points, axis=1, keepdims=True)
            np.savetxt(root / category / f"{category}_000{k}.txt", np.hstack([points, normals]),
                       "%.6f", ",")  # fmt: skip
    for name, content in (LISTS | lists).items():
        (root / name).write_text(content)
    return root


def test_list_files_are_the_splits_and_normals_are_kept(tmp_path: Path, rng) -> None:
    source = open_source(resampled(tmp_path / "modelnet40_normal_resampled", rng))
    listed = {s: [r.object_id for r in source.objects(s)] for s in source.splits()}
    assert listed == {"train": ["mug/mug_0000", "pan/pan_0000"],
                      "test": ["mug/mug_0001", "pan/pan_0001"]}  # fmt: skip
    assert source.rejected == []
    assert "splits from modelnet40_test.txt, modelnet40_train.txt" in source.listing
    cloud = source.load(source.objects("train")[0])
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-6)
    # The body is a ball of sorts about its centre, whose normals look outwards.
    table = np.loadtxt(tmp_path / "modelnet40_normal_resampled/mug/mug_0000.txt", delimiter=",")
    np.testing.assert_allclose(cloud.normals, table[:, 3:], atol=2e-6)


def test_what_a_list_and_the_files_disagree_on_is_told(tmp_path: Path, rng) -> None:
    root = resampled(tmp_path / "a", rng, **{"modelnet40_test.txt": "mug_0001\nmug_0007\n"})
    source = open_source(root)
    reasons = {(r.location, r.reason) for r in source.rejected if r.failed}
    assert reasons == {
        ("modelnet40_test.txt", "names 'mug_0007', which no file gives"),
        ("pan/pan_0001.txt", "is in none of modelnet40_test.txt, modelnet40_train.txt"),
    }
    root = resampled(tmp_path / "b", rng, **{"modelnet40_test.txt": "mug_0001\nmug_0000\n"})
    with pytest.raises(InputError, match="'mug_0000' is in the split"):
        open_source(root)


def test_lists_within_classes_and_in_json(tmp_path: Path) -> None:
    names = [f"{c}/{k}/model.off" for c in ("0269", "0300") for k in "ab"]
    root = write(tmp_path / "a", *names)
    for c in ("0269", "0300"):
        (root / c / "train.lst").write_text("a\n")
        (root / c / "test.lst").write_text("b\n")
    source = open_source(root)
    assert [r.object_id for r in source.objects("train")] == ["0269/a", "0300/a"]
    root = write(tmp_path / "b", *names, content=OFF)
    (root / "split").mkdir()
    (root / "train_files.json").write_text('["shape_data/0269/a", "shape_data/0300/b"]')
    (root / "test_files.json").write_text('["shape_data/0269/b", "shape_data/0300/a"]')
    source = open_source(root)
    assert [r.object_id for r in source.objects("train")] == ["0269/a", "0300/b"]
    (root / "train_files.json").write_text('["a"]')
    with pytest.raises(InputError, match="'a' may be 0269/a, 0300/a; write the class before it"):
        open_source(root)


def test_a_zip_of_clouds_is_one_of_clouds(tmp_path: Path, rng) -> None:
    points = rng.normal(size=(40, 3))
    text = "\n".join(" ".join(map(repr, row)) for row in points.tolist())
    with zipfile.ZipFile(tmp_path / "c.zip", "w") as archive:
        archive.writestr("root/mug/train/0.xyz", text)
        archive.writestr("root/pan/test/0.xyz", text)
        archive.writestr("__MACOSX/root/mug/train/._0.xyz", "rubbish")
    source = open_source(tmp_path / "c.zip")
    assert source.listing.startswith("root/<class>/<split>/<file>: 2 classes, 1 training, 1 test")
    assert source.load(source.objects("train")[0]).shape == (40, 3)


def test_a_long_header_decides_by_its_faces_and_no_body_is_read(
    tmp_path: Path, monkeypatch
) -> None:
    comments = "".join(f"comment element face 3 of line {n}\n" for n in range(900))
    ends = "property float x\nproperty float y\nproperty float z\nelement face {}\n" \
           "property list uchar int vertex_indices\nend_header\n"  # fmt: skip
    for name, faces in (("mesh", 1), ("cloud", 0)):
        head = f"ply\nformat ascii 1.0\n{comments}element vertex 3\n{ends.format(faces)}"
        write(
            tmp_path / name, "mug/a.ply", content=head.encode() + b"0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
        )
    monkeypatch.setattr("renderers.sources.files.Directory.read", lambda *_: pytest.fail("read"))
    assert open_source(tmp_path / "mesh").describe()["name"] == "folder"
    assert open_source(tmp_path / "cloud").describe()["name"] == "custom-clouds"


def test_lists_in_a_folder_of_their_own_are_of_the_classes_beside_it(tmp_path: Path, rng) -> None:
    """As ShapeNet's part annotations come."""
    content = "\n".join(" ".join(map(str, row)) for row in rng.random((20, 3))).encode()
    names = [f"{synset}/{k}.txt" for synset in ("02691156", "03001627") for k in "abc"]
    write(tmp_path, *names, content=content)
    for split, k in (("train", "a"), ("val", "b"), ("test", "c")):
        listed = f'["shape_data/02691156/{k}", "shape_data/03001627/{k}"]'.encode()
        write(tmp_path, f"train_test_split/shuffled_{split}_file_list.json", content=listed)
    source = open_source(tmp_path)
    train = [ref.object_id for ref in source.objects("train")]
    assert train == ["02691156/a", "02691156/b", "03001627/a", "03001627/b"]
    assert [ref.object_id for ref in source.objects("test")] == ["02691156/c", "03001627/c"]
    assert not source.rejected


def test_doubtful_names_of_classes_are_said(tmp_path: Path) -> None:
    names = ("test/a.off", "other/b.off", "caf\u00e9/c.off", "cafe\u0301/d.off", "Other /e.off")
    source = open_source(write(tmp_path, *names))
    assert "'test' is taken for a class" in source.listing
    assert r"'cafe\u0301', 'caf\xe9' are a class each" in source.listing
    assert "'Other ', 'other' are a class each" in source.listing
    assert len(source.class_names) == 5


def test_a_zip_with_backslashes_is_one_with_slashes(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "old.zip", "w") as packed:
        for name in (r"mug\train\a.off", r"mug\test\b.off"):
            info = zipfile.ZipInfo("-")
            info.filename = name
            packed.writestr(info, OFF)
    source = open_source(tmp_path / "old.zip")
    [ref] = source.objects("test")
    assert (ref.object_id, len(source.load(ref).faces)) == ("mug/b", 2)
    with pytest.raises(InputError, match="2 of these formats lie otherwise"):
        open_source(write(tmp_path / "flat", "a.off", "b.off"))


@pytest.mark.parametrize("prefix", ["./", "../", "/", "data//"])
def test_a_zip_may_say_where_its_folder_lay(tmp_path: Path, prefix: str) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as packed:
        for name in ("mug/train/a.off", "mug/test/b.off"):
            packed.writestr(prefix + name, OFF)
    source = open_source(tmp_path / "a.zip")
    assert [r.object_id for split in source.splits() for r in source.objects(split)] == [
        "mug/a", "mug/b",
    ]  # fmt: skip
    assert len(source.load(source.objects("test")[0]).faces) == 2


def test_folders_of_the_same_files_are_objects_of_one_class() -> None:
    names = [f"02691156/{k}/models/{f}.obj" for k in "ab" for f in ("model_normalized", "solid")]
    assert found(*names) == [("02691156", "a", ""), ("02691156", "b", "")]
    classes = [f"data/{c}/{k}.obj" for c in ("mug", "pan") for k in ("0000", "0001")]
    assert {category for category, _, _ in found(*classes)} == {"mug", "pan"}


FOUR = ("mug/0.off", "mug/1.off", "pan/0.off", "pan/1.off")


def splits_of(root: Path) -> tuple[dict[str, list[str]], list[str]]:
    source = open_source(root)
    listed = {s: [r.object_id for r in source.objects(s)] for s in source.splits()}
    return listed, [f"{r.location}: {r.reason}" for r in source.rejected if r.failed]


def test_a_list_may_be_in_json_by_class_or_in_quotes(tmp_path: Path) -> None:
    write(tmp_path, *FOUR)
    write(tmp_path, "train.json", content=b'{"mug": ["0"], "pan": ["0", "1"]}')
    write(tmp_path, "test.txt", content=b'"mug/1"\n')
    assert splits_of(tmp_path) == ({"train": ["mug/0", "pan/0", "pan/1"], "test": ["mug/1"]}, [])


@pytest.mark.parametrize("name", ["splits.json", "train_test_split.json"])
def test_a_file_may_hold_all_splits(tmp_path: Path, name: str) -> None:
    write(tmp_path, *FOUR)
    both = b'{"train": ["mug/0", "pan/0", "pan/1"], "test": {"mug": ["1"]}}'
    write(tmp_path, name, content=both)
    assert splits_of(tmp_path) == ({"train": ["mug/0", "pan/0", "pan/1"], "test": ["mug/1"]}, [])


def test_a_list_that_gives_no_split_is_told(tmp_path: Path) -> None:
    write(tmp_path, *FOUR)
    write(tmp_path, "train.json", content=b'[{"id": "mug/0"}]')
    assert splits_of(tmp_path)[1] == [
        "train.json: is called as a list of a split is, but names no object that is here"
    ]
    write(tmp_path, "train.json", content=b'["mug/0",')
    write(tmp_path, "test.txt", content=b"mug/1\nmug/0\npan/0\npan/1\n")
    listed, told = splits_of(tmp_path)
    assert len(listed["test"]) == 4
    assert len(told) == 1
    assert told[0].startswith("train.json: is called as a list is, but cannot be read (Expecting")


def test_the_class_in_a_list_counts(tmp_path: Path) -> None:
    write(tmp_path, *FOUR, "cup/7.off")
    write(tmp_path, "train.txt", content=b"Mug/0\nCUP/7\nmug/7\nspoon/1\n")
    write(tmp_path, "test.txt", content=b"some/where/Pan/1\n")
    listed, told = splits_of(tmp_path)
    assert listed == {"train": ["cup/7", "mug/0"], "test": ["pan/1"]}
    assert "train.txt: names 'mug/7', which no file gives" in told
    assert "train.txt: names 'spoon/1', which no file gives" in told


def test_classes_that_look_like_modelnet40s_are_told(tmp_path: Path) -> None:
    source = open_source(write(tmp_path, "Night Stand/0.off", "Bottles/0.off", "mug/0.off"))
    assert source.class_names == ("Bottles", "Night Stand", "mug")
    assert "'Bottles' (bottle), 'Night Stand' (night_stand) would be ModelNet40's" in source.listing
    assert "would be" not in open_source(write(tmp_path / "b", "sofa/0.off", "mug/0.off")).listing
