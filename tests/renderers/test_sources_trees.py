"""Folders and zips of meshes, which of them are ModelNet40, and what a path is taken for."""

from __future__ import annotations

import hashlib
import os
import pickle
import shutil
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

from partialbench.dataset.categories import MODELNET40
from partialbench.errors import InputError
from renderers.sources.folder import MeshFolder
from renderers.sources.listing import split_of
from renderers.sources.open import open_source

OFF = b"OFF\n4 2 0\n0 0 0\n2 0 0\n2 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n"
MODELNET = (
    "chair/train/chair_0002.off",
    "chair/train/chair_0001.off",
    "chair/test/chair_0890.off",
    "airplane/test/airplane_0627.OFF",
    "airplane/train/airplane_0003.off",
)


def write(root: Path, names: tuple[str, ...], content: bytes = OFF) -> Path:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(content)
    return root


def pack(path: Path, names: tuple[str, ...], content: bytes = OFF) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in names:
            archive.writestr(name, content)
    return path


def listing(source: MeshFolder) -> list[tuple[str, str, str]]:
    return [
        (split, source.class_names[ref.label], ref.object_id)
        for split in source.splits()
        for ref in source.objects(split)
    ]


EXPECTED = [
    ("train", "airplane", "airplane/airplane_0003"),
    ("train", "chair", "chair/chair_0001"),
    ("train", "chair", "chair/chair_0002"),
    ("test", "airplane", "airplane/airplane_0627"),
    ("test", "chair", "chair/chair_0890"),
]
LITTER = ("__MACOSX/chair/train/._chair_0001.off", "chair/train/.chair.off", "README.txt",
          "chair/readme.md", ".git/train/x.off")  # fmt: skip


@pytest.mark.parametrize("inside", ["", "ModelNet40/"])
@pytest.mark.parametrize("kind", ["tree", "zip"])
def test_modelnet40_lists_the_same_from_a_tree_and_from_its_zip(
    kind: str, inside: str, tmp_path: Path
) -> None:
    names = tuple(inside + name for name in MODELNET) + LITTER
    source: MeshFolder
    if kind == "tree":
        source = MeshFolder(write(tmp_path, names))
    else:
        source = MeshFolder(pack(tmp_path / "m.zip", names))
    assert listing(source) == EXPECTED
    assert source.class_names == MODELNET40
    assert source.rejected == []
    described = source.describe()
    assert described["objects"] == {"train": 3, "test": 2}
    assert str(tmp_path) not in str(described)
    other = tmp_path / "other"
    assert MeshFolder(write(other, MODELNET)).describe() == described
    ref = source.objects("train")[1]
    assert source.digest(ref) == hashlib.sha256(OFF).hexdigest()
    mesh = source.load(ref)
    np.testing.assert_allclose(mesh.bounds, [[-2, -1, 0], [2, 1, 0]] / np.sqrt(5))
    again = pickle.loads(pickle.dumps(source))
    np.testing.assert_array_equal(again.load(ref).vertices, mesh.vertices)
    assert again.describe() == described


def test_the_frame_is_what_the_user_says(tmp_path: Path) -> None:
    root = write(tmp_path, MODELNET)
    original, aligned = MeshFolder(root), MeshFolder(root, aligned=True)
    assert (original.frame, aligned.frame) == ("original", "aligned")
    assert (original.describe()["frame"], aligned.describe()["frame"]) == ("original", "aligned")


def test_another_listing_is_another_source(tmp_path: Path) -> None:
    root = write(tmp_path, MODELNET)
    before = MeshFolder(root).describe()
    (root / MODELNET[0]).rename(root / "chair/train/chair_0003.off")
    after = MeshFolder(root).describe()
    assert before["objects"] == after["objects"]
    assert before != after


def all_forty(*more: str) -> tuple[str, ...]:
    names = [f"{c}/{split}/{c}_0001.off" for c in MODELNET40 for split in ("train", "test")]
    return (*names, *more)


@pytest.mark.parametrize(
    ("names", "name"),
    [
        (all_forty(), "modelnet40"),
        (tuple("ModelNet40/" + name for name in all_forty()), "modelnet40"),
        (all_forty()[:-2], "folder"),  # thirty-nine of its classes
        (all_forty("spoon/train/spoon_0001.off"), "folder"),
        (all_forty("chair/train/chair_0003.obj"), "folder"),
        (all_forty("chair/val/chair_0003.off"), "folder"),
        (MODELNET, "folder"),
    ],
)
def test_pm40_is_the_forty_classes_and_nothing_else(names, name: str, tmp_path: Path) -> None:
    tree = open_source(write(tmp_path / "tree", names), aligned=True)
    assert tree.describe()["name"] == name
    assert tree.frame == "aligned"
    packed = open_source(pack(tmp_path / "m.zip", names), aligned=True)
    assert packed.describe() == tree.describe()


@pytest.mark.parametrize("damage", ["flip", "method", "encrypt"])
def test_one_broken_member_fails_alone(damage: str, tmp_path: Path) -> None:
    path = pack(tmp_path / "m.zip", MODELNET)
    with zipfile.ZipFile(path) as archive:
        info = archive.getinfo(MODELNET[1])
    data = bytearray(path.read_bytes())
    # The member's entry in the archive's directory repeats its local header.
    entry = [k for k in range(len(data)) if data[k : k + 4] == b"PK\x01\x02"][1]
    if damage == "flip":
        data[info.header_offset + 30 + len(MODELNET[1]) + 10] ^= 0xFF
    elif damage == "encrypt":
        data[info.header_offset + 6] |= 1
        data[entry + 8] |= 1
    else:
        data[info.header_offset + 8] = data[entry + 10] = 99
    path.write_bytes(data)
    source = MeshFolder(path)
    assert listing(source) == EXPECTED
    for split in source.splits():
        for ref in source.objects(split):
            if ref.location == MODELNET[1]:
                with pytest.raises(InputError, match=r"m\.zip: the member chair/train/chair_0001"):
                    source.load(ref)
                with pytest.raises(InputError, match="the member"):
                    source.digest(ref)
            else:
                assert len(source.load(ref).faces) == 2


def test_a_broken_file_is_named_by_its_place(tmp_path: Path) -> None:
    root = write(tmp_path, MODELNET)
    (root / MODELNET[0]).write_bytes(b"")
    source = MeshFolder(root)
    with pytest.raises(InputError, match=r"^chair/train/chair_0002\.off: the file is empty"):
        source.load(source.objects("train")[2])
    (root / MODELNET[1]).unlink()
    with pytest.raises(InputError, match=r"chair_0001\.off: cannot be read"):
        source.load(source.objects("train")[1])


def test_links_are_followed_but_not_in_circles(tmp_path: Path) -> None:
    write(tmp_path / "elsewhere", ("train/chair_0001.off",))
    root = write(tmp_path / "root", ("airplane/train/airplane_0003.off",))
    (root / "chair").symlink_to(tmp_path / "elsewhere")
    (root / "airplane" / "train" / "up").symlink_to(root)
    assert [ref.object_id for ref in MeshFolder(root).objects("train")] == [
        "airplane/airplane_0003",
        "chair/chair_0001",
    ]


@pytest.mark.parametrize("second", ["mug/train/a.off", "./mug/train/a.off"])
def test_a_zip_with_two_files_of_one_name_gives_neither(second: str, tmp_path: Path) -> None:
    path = tmp_path / "m.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("mug/train/a.off", OFF)
        archive.writestr("mug/train/b.off", OFF)
        with warnings.catch_warnings(action="ignore"):
            archive.writestr(second, OFF.replace(b"2", b"3"))
            archive.writestr("mug/train/b.off", OFF)  # the same again does no harm
    source = MeshFolder(path)
    a, b = source.objects("train")
    with pytest.raises(InputError, match="2 different members are called mug/train/a"):
        source.load(a)
    assert len(source.load(b).faces) == 2


def test_a_zip_is_read_after_a_fork(tmp_path: Path) -> None:
    source = MeshFolder(pack(tmp_path / "m.zip", MODELNET))
    refs = source.objects("train")
    source.load(refs[0])
    child = os.fork()
    if child == 0:
        # The child must not move the parent's place in the file: it opens its own.
        os._exit(0 if len(source.load(refs[1]).faces) == 2 else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert len(source.load(refs[2]).faces) == 2


def test_a_folder_with_splits(tmp_path: Path) -> None:
    box = trimesh.creation.box((1, 2, 3))
    for name in ("mug/train/0001.obj", "mug/test/0002.ply", "fork/train/0001.stl"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        box.export(tmp_path / name)
    source = MeshFolder(tmp_path)
    assert source.class_names == ("fork", "mug")
    assert source.frame == "original"
    assert listing(source) == [
        ("train", "fork", "fork/0001"),
        ("train", "mug", "mug/0001"),
        ("test", "mug", "mug/0002"),
    ]
    upright = source.load(source.objects("train")[1])
    lying = MeshFolder(tmp_path, up="y").load(source.objects("train")[1])
    np.testing.assert_allclose(upright.extents / upright.extents[0], [1, 2, 3])
    np.testing.assert_allclose(lying.extents / lying.extents[0], [1, 3, 2])


def test_a_folder_without_splits_is_split_by_name(tmp_path: Path) -> None:
    names = tuple(f"{category}/{k:04}.off" for category in ("mug", "fork") for k in range(500))
    source = MeshFolder(write(tmp_path, names))
    train, test = (source.objects(split) for split in ("train", "test"))
    assert len(train) + len(test) == 1000
    # A binomial of 1,000 with 0.8: within four standard deviations.
    assert abs(len(train) - 800) < 51
    # The rule itself, written another way: 8 bytes of SHA-256 against four fifths of their range.
    for ref in [*train[:20], *test[:20]]:
        share = int(hashlib.sha256(ref.object_id.encode()).hexdigest()[:16], 16) / 2**64
        assert ref.split == ("train" if share < 0.8 else "test") == split_of(ref.object_id)
    # Removing files moves no other.
    shutil.rmtree(tmp_path / "mug")
    assert MeshFolder(tmp_path).objects("test") == [
        ref.__class__(ref.object_id, 0, ref.split, ref.location)
        for ref in test
        if ref.object_id.startswith("fork/")
    ]


def test_classes_all_of_modelnet40_get_its_labels(tmp_path: Path) -> None:
    source = MeshFolder(write(tmp_path, ("xbox/a.off", "airplane/b.off")))
    assert source.class_names == MODELNET40
    labels = {
        ref.object_id: ref.label for split in source.splits() for ref in source.objects(split)
    }
    assert labels == {"airplane/b": 0, "xbox/a": 39}


def test_of_one_object_in_two_formats_the_first_is_taken_and_it_is_said(tmp_path: Path) -> None:
    names = ("mug/train/a.stl", "mug/train/a.off", "mug/train/b.off", "c.off")
    source = MeshFolder(write(tmp_path, names))
    assert [ref.location for ref in source.objects("train")] == list(names[1:3])
    reasons = {(r.object_id, r.location): (r.reason, r.failed) for r in source.rejected}
    assert reasons == {
        ("c", "c.off"): ("lies in no class's folder", True),
        ("mug/a", names[0]): ("another file gives an object of this name", False),
    }


def test_open_takes_a_registered_name(tmp_path: Path) -> None:
    root = write(tmp_path, MODELNET)
    assert isinstance(open_source("folder", root=root), MeshFolder)
    with pytest.raises(InputError, match="the source 'folder' takes root, up, aligned: missing"):
        open_source("folder")


def test_open_says_what_is_wrong_with_a_path(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"neither a path that exists nor .* mean parametric"):
        open_source("parametrics")
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(
        InputError, match=r"empty holds no meshes: looked for \.off, \.obj, .* among 0 files"
    ):
        open_source(empty)
    with pytest.raises(InputError, match="does not exist; expected a folder of meshes or"):
        MeshFolder(tmp_path / "absent")
    mesh, text, bad = tmp_path / "mug.off", tmp_path / "notes.md", tmp_path / "bad.zip"
    mesh.write_bytes(OFF)
    text.write_text("notes")
    bad.write_bytes(pack(tmp_path / "m.zip", MODELNET).read_bytes()[:-40])
    with pytest.raises(InputError, match=r"is a single mesh; put it as <class>/mug\.off"):
        open_source(mesh)
    with pytest.raises(InputError, match=r"is no source: expected a folder or a \.zip of meshes"):
        open_source(text)
    with pytest.raises(InputError, match="not a readable zip file: it is damaged or was cut short"):
        open_source(bad)
    with pytest.raises(InputError, match="not a readable zip file"):
        MeshFolder(bad)
    with pytest.raises(InputError, match=r"takes root, up, aligned: got an unexpected .* 'down'"):
        open_source(write(tmp_path / "tree", MODELNET), down="y")
    with pytest.raises(InputError, match="up must be one of z, y, got 'x'"):
        open_source(write(tmp_path / "folder", ("mug/a.off",)), up="x")
    with pytest.raises(InputError, match="no split 'val'"):
        MeshFolder(tmp_path / "tree").objects("val")


@pytest.mark.data
def test_the_real_files_list_and_load(shared: Path, tmp_path: Path) -> None:
    root = shared / "data" / "ModelNet40"
    tree = open_source(root)
    packed = tmp_path / "ModelNet40.zip"
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in root.rglob("*.off"):
            archive.write(path, Path("ModelNet40") / path.relative_to(root))
    archived = open_source(packed)
    assert isinstance(tree, MeshFolder)
    assert isinstance(archived, MeshFolder)
    assert archived.describe() == tree.describe()
    count = 0
    for split in ("train", "test"):
        for ours, theirs in zip(tree.objects(split), archived.objects(split), strict=True):
            mesh = tree.load(ours)
            np.testing.assert_array_equal(mesh.vertices, archived.load(theirs).vertices)
            assert tree.digest(ours) == archived.digest(theirs)
            assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(1)
            np.testing.assert_allclose(mesh.bounds.sum(axis=0), 0, atol=1e-12)
            count += 1
    assert count == 8


def test_a_folder_of_clouds_is_told_from_a_folder_of_meshes(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for folder, shape in (
        ("clouds", trimesh.PointCloud(rng.normal(size=(50, 3)))),
        ("meshes", trimesh.creation.box()),
    ):
        (tmp_path / folder / "crate").mkdir(parents=True)
        shape.export(tmp_path / folder / "crate" / "one.ply")
    assert open_source(tmp_path / "clouds").describe()["name"] == "custom-clouds"
    assert open_source(tmp_path / "meshes").describe()["name"] == "folder"
    np.save(tmp_path / "clouds" / "crate" / "two.npy", rng.normal(size=(50, 3)))
    assert open_source(tmp_path / "clouds").describe()["name"] == "custom-clouds"
