"""Complete clouds: what is read is what was stored, and what cannot be read is told."""

from __future__ import annotations

import pickle
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from partialbench.dataset.build import BuildPlan, build
from partialbench.dataset.categories import MODELNET40
from partialbench.dataset.cloud_files import read_cloud
from partialbench.dataset.executors import InlineExecutor
from partialbench.dataset.rows import Job
from partialbench.dataset.shards import read_columns
from partialbench.dataset.verify import verify
from partialbench.errors import InputError
from renderers.hpr import HprOccluder
from renderers.sources.clouds import CompleteClouds, normalise_cloud
from renderers.whole import WholeOccluder


def codes(rng: np.random.Generator, rows: int, points: int = 64) -> np.ndarray:
    return rng.integers(0, 4096, (rows, 3, points)).astype(np.uint16)


@pytest.fixture
def stored(tmp_path: Path, rng: np.random.Generator) -> Path:
    path = tmp_path / "clouds.h5"
    with h5py.File(path, "w") as file:
        file["class_names"] = np.array([b"chair", b"sofa"])
        for split, rows in (("train", 5), ("test", 2)):
            file[f"{split}/points"] = codes(rng, rows)
            file[f"{split}/label"] = np.arange(rows, dtype=np.uint8) % 2
            file[f"{split}/object_id"] = np.array([f"{split}_{i}".encode() for i in range(rows)])
    return path


def edit(path: Path, name: str, value: object) -> None:
    with h5py.File(path, "a") as file:
        del file[name]
        if value is not None:
            file[name] = value


def test_an_hdf5_file_lists_and_decodes(stored: Path) -> None:
    source = CompleteClouds(stored)
    assert source.class_names == ("chair", "sofa")
    assert source.frame == "aligned"
    assert source.splits() == ("train", "test")
    refs = source.objects("train")
    assert [(r.object_id, r.label) for r in refs] == [(f"train_{i}", i % 2) for i in range(5)]
    with h5py.File(stored) as file:
        raw = file["train/points"][3].T / 4095 * 2 - 1
    centred = raw - (raw.min(axis=0) + raw.max(axis=0)) / 2
    expected = centred / np.linalg.norm(centred, axis=1).max()
    cloud = source.load(refs[3])
    assert cloud.dtype == np.float32
    np.testing.assert_allclose(cloud, expected, atol=1e-7)


def test_points_may_be_floats_in_either_order(stored: Path, rng: np.random.Generator) -> None:
    floats = rng.uniform(-1, 1, (5, 64, 3)).astype(np.float32)
    edit(stored, "train/points", floats)
    source = CompleteClouds(stored)
    upright = source.load(source.objects("train")[2])
    np.testing.assert_allclose(upright, normalise_cloud(floats[2]), atol=1e-7)
    del source  # it holds the file open
    edit(stored, "train/points", floats.transpose(0, 2, 1))
    source = CompleteClouds(stored)
    np.testing.assert_array_equal(source.load(source.objects("train")[2]), upright)


def test_a_digest_is_of_the_objects_own_numbers(stored: Path) -> None:
    source = CompleteClouds(stored)
    refs = source.objects("train")
    before = [source.digest(ref) for ref in refs]
    del source  # it holds the file open
    with h5py.File(stored, "a") as file:
        file["train/points"][3, 0, 0] ^= 1
    changed = CompleteClouds(stored)
    after = [changed.digest(ref) for ref in refs]
    assert [a == b for a, b in zip(after, before, strict=True)] == [True, True, True, False, True]


def test_a_pickled_copy_reads_the_same(stored: Path) -> None:
    source = CompleteClouds(stored)
    ref = source.objects("test")[1]
    expected = source.load(ref)  # also opens the file in this process
    copy = pickle.loads(pickle.dumps(source))
    np.testing.assert_array_equal(copy.load(ref), expected)
    assert copy.describe() == source.describe()


def test_the_description_has_no_path_and_follows_the_listing(stored: Path, tmp_path: Path) -> None:
    described = CompleteClouds(stored).describe()
    moved = tmp_path / "elsewhere.h5"
    moved.write_bytes(stored.read_bytes())
    assert CompleteClouds(moved).describe() == described
    edit(moved, "train/label", np.zeros(5, np.uint8))
    assert CompleteClouds(moved).describe() != described


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("class_names", None, "expected class_names and the groups train and test"),
        ("train/label", None, "group train lacks label"),
        ("train/points", np.zeros((5, 64, 2)), r"points have shape \(5, 64, 2\)"),
        ("train/points", np.zeros((5, 3, 64), int), "points are int64, expected floats or uint16"),
        ("train/label", np.zeros(4, int), "the counts differ: {'points': 5, 'label': 4"),
        ("train/label", np.full(5, 2), "row 0 has label 2, but there are 2 class names"),
    ],
)
def test_another_layout_is_told(stored: Path, name: str, value, message: str) -> None:
    edit(stored, name, value)
    with pytest.raises(InputError, match=message):
        CompleteClouds(stored)


def test_codes_above_the_range_are_told(stored: Path) -> None:
    with h5py.File(stored, "a") as file:
        file["train/points"][0, 0, 0] = 4096
    source = CompleteClouds(stored)
    with pytest.raises(InputError, match="train/0 has the code 4096, above 4095"):
        source.load(source.objects("train")[0])


def test_codes_of_padding_are_told(stored: Path) -> None:
    """Decoded, they are a corner of the cube that no other check knows."""
    with h5py.File(stored, "a") as file:
        file["train/points"][0, :, 50:] = 0
    source = CompleteClouds(stored)
    with pytest.raises(InputError, match=r"train/0 has 14 points of the codes \(0, 0, 0\)"):
        source.load(source.objects("train")[0])


def test_what_is_no_source_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        CompleteClouds(tmp_path / "nothing.h5")
    (tmp_path / "text.h5").write_text("not HDF5")
    with pytest.raises(InputError, match="not a readable HDF5 file"):
        CompleteClouds(tmp_path / "text.h5")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds no clouds"):
        CompleteClouds(tmp_path / "empty")


# --- files ----------------------------------------------------------------------------------------


def pcd(points: np.ndarray, encoding: str) -> bytes:
    """x, y, z among other fields, one of them with two values."""
    header = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS rgb x y normal z\nSIZE 4 4 4 8 4\nTYPE U F F F F\n"
        f"COUNT 1 1 1 2 1\nWIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {len(points)}\nDATA {encoding}\n"
    ).encode()
    if encoding == "ascii":
        rows = [f"7 {x!r} {y!r} 0.5 0.25 {z!r}" for x, y, z in points.tolist()]
        return header + ("\n".join(rows) + "\n").encode()
    record = [("rgb", "<u4"), ("x", "<f4"), ("y", "<f4"), ("n", "<f8", 2), ("z", "<f4")]
    table = np.zeros(len(points), record)
    table["x"], table["y"], table["z"] = points.T
    return header + table.tobytes()


def ply(points: np.ndarray) -> bytes:
    return trimesh.PointCloud(points).export(file_type="ply")


def npy(points: np.ndarray, tmp_path: Path) -> bytes:
    np.save(tmp_path / "cloud.npy", np.hstack([points, np.ones((len(points), 3))]))
    return (tmp_path / "cloud.npy").read_bytes()


def test_every_format_gives_the_same_points(tmp_path: Path, rng: np.random.Generator) -> None:
    points = rng.uniform(-5, 5, (20, 3)).astype(np.float32).astype(float)
    text = "# x y z intensity\n" + "\n".join(f"{x!r} {y!r} {z!r} 1" for x, y, z in points.tolist())
    contents = {
        "a.ply": ply(points),
        "a.pcd": pcd(points, "ascii"),
        "b.PCD": pcd(points, "binary"),
        "a.xyz": text.encode(),
        "a.txt": text.replace(" ", ",").replace("#,x,y,z,intensity\n", "").encode(),
        "a.npy": npy(points, tmp_path),
    }
    for name, content in contents.items():
        np.testing.assert_allclose(read_cloud(content, name), points, rtol=1e-6, err_msg=name)


@pytest.mark.open3d
@pytest.mark.parametrize("write_ascii", [True, False])
def test_open3ds_pcd_files_are_read(tmp_path: Path, rng, write_ascii: bool) -> None:
    o3d = pytest.importorskip("open3d", exc_type=ImportError)
    points = rng.uniform(-5, 5, (20, 3))
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.paint_uniform_color([1, 0, 0])
    path = tmp_path / "cloud.pcd"
    o3d.io.write_point_cloud(str(path), cloud, write_ascii=write_ascii)
    np.testing.assert_allclose(read_cloud(path.read_bytes(), "cloud.pcd"), points, atol=1e-5)


def test_unmeasured_points_of_a_pcd_are_dropped(rng: np.random.Generator) -> None:
    points = rng.uniform(-1, 1, (5, 3))
    points[2] = np.nan
    for encoding in ("ascii", "binary"):
        got = read_cloud(pcd(points, encoding), "a.pcd")
        np.testing.assert_allclose(got, np.delete(points, 2, axis=0), rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.las", b"", "'.las' is no cloud suffix of .ply, .pcd"),
        ("a.xyz", b"1 2\n3 4\n", r"expected an \(n,3\) cloud with n ≥ 1, got \(2, 2\)"),
        ("a.xyz", b"1 2 nan\n3 4 5\n", "1 of 2 points are not finite"),
        ("a.xyz", b"one two three\n", "has no point, only 'one two three'"),
        ("a.txt", b"1,2,3,4\n1,,3,4\n", "a.txt: line 2: a cell is empty"),
        ("a.csv", b"1,2,3\n ,2,3\n", "a.csv: line 2: a cell is empty"),
        ("a.npy", b"junk", "does not begin as NPY does"),
        ("a.ply", b"ply\nformat", "no line end_header"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
         b"property float z\nend_header\n0 0 0\n1 1 1\n", "says 3 vertex lines, 2 follow it"),
        ("a.pcd", b"VERSION 0.7\n", "no DATA line"),
        ("a.pcd", b"FIELDS a b\nDATA ascii\n", "broken or has no x, y, z"),
        ("a.pcd", pcd(np.ones((4, 3)), "binary")[:-3], "cut short: 4 points need 128 bytes, 125"),
        ("a.pcd", pcd(np.ones((4, 3)), "ascii").rsplit(b"7", 1)[0], "says 4 points, 3 follow"),
        ("a.pcd", pcd(np.ones((1, 3)), "binary").replace(b"binary\n", b"binary_compressed\n"),
         "the PCD unpacks to 1065353216 bytes, 1 points need 32"),
    ],
)  # fmt: skip
def test_broken_files_are_told(name: str, content: bytes, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_cloud(content, name)


def test_a_folder_gives_classes_and_splits(tmp_path: Path, rng: np.random.Generator) -> None:
    for place in ("chair/train/a.xyz", "chair/test/b.xyz", "sofa/train/a.xyz", "sofa/c.npy"):
        path = tmp_path / place
        path.parent.mkdir(parents=True, exist_ok=True)
        points = rng.uniform(2, 3, (30, 3))
        if path.suffix == ".npy":
            np.save(path, points)
        else:
            np.savetxt(path, points)
    (tmp_path / "stray.xyz").write_text("1 2 3\n")
    np.save(tmp_path / "chair/train/a.npy", np.ones((3, 3)))
    source = CompleteClouds(tmp_path)
    assert source.class_names == MODELNET40  # both are ModelNet40 classes
    assert source.frame == "original"
    listed = {
        (r.split, r.object_id): r.location for s in source.splits() for r in source.objects(s)
    }
    assert listed["train", "chair/a"] == "chair/train/a.xyz"
    assert listed["train", "sofa/a"] == "sofa/train/a.xyz"
    assert ("test", "chair/b") in listed
    assert len(listed) == 4
    assert {r.location for r in source.rejected} == {"stray.xyz", "chair/train/a.npy"}
    ref = source.objects("train")[0]
    raw = np.loadtxt(tmp_path / "chair/train/a.xyz")
    np.testing.assert_allclose(source.load(ref), normalise_cloud(raw), atol=1e-7)
    turned = CompleteClouds(tmp_path, up="y", aligned=True)
    x, y, z = raw.T
    expected = normalise_cloud(np.stack([x, -z, y], axis=1))
    np.testing.assert_allclose(turned.load(ref), expected, atol=1e-7)
    assert turned.frame == "aligned"


def test_a_cloud_at_one_place_has_no_size() -> None:
    with pytest.raises(InputError, match="all 5 points are at"):
        normalise_cloud(np.ones((5, 3)))


# --- through the builder --------------------------------------------------------------------------


def test_partial_rotated_and_aligned_come_from_the_same_objects(stored: Path, tmp_path) -> None:
    rows = {}
    for setting, occluder in (
        ("partial", HprOccluder()),
        ("rotated", WholeOccluder()),
        ("aligned", WholeOccluder()),
    ):
        source = CompleteClouds(stored)
        views = {"train": 1, "test": 1}
        job = Job(source, occluder, "pm40-clouds", setting, views, 64, 0)
        out = tmp_path / setting
        build(BuildPlan(job, out, ("train", "test")), InlineExecutor)
        assert verify(out, source).problems == []
        rows[setting] = read_columns(out / "train-00000.h5")
    back = {
        setting: np.einsum(
            "mpi,mij->mpj", r["points"] - r["t_camera_object"][:, None], r["R_camera_object"]
        )
        for setting, r in rows.items()
    }
    np.testing.assert_array_equal(rows["rotated"]["R_camera_object"],
                                  rows["partial"]["R_camera_object"])  # fmt: skip
    for row in range(5):
        whole = cKDTree(back["aligned"][row])
        for setting, seen in (("rotated", 64), ("partial", rows["partial"]["n_visible"][row])):
            distance, index = whole.query(back[setting][row])
            assert distance.max() < 1e-5
            assert len(set(index)) == seen
        assert rows["partial"]["n_visible"][row] < 64


def test_the_real_clouds_are_read(shared: Path) -> None:
    source = CompleteClouds(shared / "data" / "modelnet40_aligned_1024.h5")
    assert source.class_names == MODELNET40
    assert (len(source.objects("train")), len(source.objects("test"))) == (9843, 1975)
    ref = next(r for r in source.objects("train") if r.object_id == "chair_0001")
    cloud = source.load(ref)
    assert cloud.shape == (1024, 3)
    assert np.linalg.norm(cloud, axis=1).max() == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(cloud.min(axis=0), -cloud.max(axis=0), atol=1e-6)
    # The back of a chair is at +y: up there the mean y is positive.
    assert cloud[cloud[:, 2] > 0.5, 1].mean() > 0.2
