"""Nothing is missing from a tree, nor taken for something else, without a word."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from partialbench.errors import InputError
from renderers.sources.clouds import CompleteClouds
from renderers.sources.folder import MeshFolder
from renderers.sources.open import open_source
from tests.renderers.test_layouts import resampled, write

TREE = ("chair/train/a.off", "chair/test/b.off")
XYZ = "".join(f"{k} {k * k} {-k}\n" for k in range(9)).encode()


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("table/train/c.fbx", b"Kaydara", "is .fbx, which is not read; export it as .off"),
        ("chair/train/c.STEP", b"ISO", "is .step, which is not read; export it as .off"),
        ("table/train/c.off.gz", b"\x1f\x8b", "is packed, so that what it holds is not read"),
        ("table.zip", b"PK", "is packed, so that what it holds is not read; unpack it"),
        ("table/train/c.xyz", XYZ, "is a cloud in a tree that was taken for one of meshes"),
        ("table/c.npy", b"\x93NUMPY", "is a cloud in a tree that was taken for one of meshes"),
    ],
)
def test_a_shape_that_is_not_read_is_told(
    name: str, content: bytes, reason: str, tmp_path: Path
) -> None:
    source = MeshFolder(write(write(tmp_path, *TREE), name, content=content))
    (rejected,) = source.rejected
    assert (rejected.location, rejected.failed) == (name, True)
    assert rejected.reason.startswith(reason)
    assert f"1 file left out: {name}" in source.listing


@pytest.mark.parametrize(
    "names",
    [
        [*TREE, "chair/train/a.fbx"],  # the object in another format
        [*TREE, "chair/train/poses.npy", "chair/notes.csv", "chair/train/a.png"],
        ["mug/m_0/model.obj", "mug/m_1/model.obj", "mug/m_0/source/scene.blend", "mug/m_0/t.zip",
         "pan/p_0/model.obj", "pan/p_0/cloud.npz"],
        ["data/chair/train/a.off", "data/chair/test/b.off", "data.zip", "old/table.zip"],
        [*TREE, "features.npy", "chair.nii.gz"],
    ],
)  # fmt: skip
def test_what_is_no_object_is_not_told(names: list[str], tmp_path: Path) -> None:
    write(tmp_path, "plate/list.txt", "pan/list.txt", content=b"to do\n")
    assert MeshFolder(write(tmp_path, *names)).rejected == []


def test_meshes_beside_clouds_are_told(tmp_path: Path) -> None:
    np.save(write(tmp_path, "pan/train/b.off", "mug/train/x.png") / "mug/train/a.npy", np.eye(9, 3))
    (rejected,) = CompleteClouds(tmp_path).rejected
    assert rejected.reason.startswith("is a mesh in a tree that was taken for one of clouds")


@pytest.mark.parametrize(
    "names",
    [
        ["ModelNet10/bed/train/0.off", "ModelNet40/bed/train/0.off", "ModelNet40/car/test/1.off"],
        ["a/train/bed/bed_0.off", "a/train/bed/bed_1.off", "a/test/bed/bed_2.off",
         "b/train/mug/mug_0.off", "b/train/car/car_2.off"],
    ],
)  # fmt: skip
def test_data_sets_beside_each_other_are_no_classes(names: list[str], tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"(ModelNet10, ModelNet40|a, b) each hold classes and"):
        MeshFolder(write(tmp_path, *names))


def test_objects_in_folders_behind_splits_are_no_data_sets(tmp_path: Path) -> None:
    names = ("mug/train/0/model.obj", "mug/test/0/model.obj", "mug/test/0/model.stl",
             "mug/train/0/part.stl", "pan/train/0/model.obj")  # fmt: skip
    assert MeshFolder(write(tmp_path, *names)).class_names == ("mug", "pan")


@pytest.mark.parametrize("name", ["split.csv", "mug/train.CSV", "modelnet40_test.tsv"])
def test_a_table_of_splits_is_told(name: str, tmp_path: Path) -> None:
    write(tmp_path, name, content=b"id,split\na,train\nb,test\n")
    source = MeshFolder(write(tmp_path, "mug/a.off", "mug/b.off"))
    (rejected,) = source.rejected
    assert rejected.location == name
    assert rejected.reason.startswith("is called as a list of splits is, but no table is read")
    write(tmp_path, "train.txt", content=b"a\n")
    write(tmp_path, "test.txt", content=b"b\n")
    assert MeshFolder(tmp_path).rejected == []


def test_the_axis_of_the_resampled_release_is_told(tmp_path: Path, rng) -> None:
    root = resampled(tmp_path / "release", rng)
    assert "modelnet40_normal_resampled has y up" in open_source(root).listing
    assert "y up" not in open_source(root, up="y").listing
    assert "y up" not in open_source(root, up="z").listing
