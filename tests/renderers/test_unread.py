"""A class or an object in a format that is not read is not missing without a word."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from renderers.sources.clouds import CompleteClouds
from renderers.sources.folder import MeshFolder
from tests.renderers.test_layouts import write

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
