"""``verify`` passes a sound folder and names each kind of damage."""

import json
import shutil

import h5py
import numpy as np
import pytest
import trimesh

from partialbench.dataset.build import build
from partialbench.dataset.executors import InlineExecutor
from partialbench.dataset.manifest import bytes_sha256
from partialbench.dataset.shards import row_digests
from partialbench.dataset.sources import OrientedCloud
from partialbench.dataset.surface_check import normal_angles_deg, surface_distance
from partialbench.dataset.verify import verify
from partialbench.errors import InputError
from renderers.mitsuba_depth import MitsubaOccluder
from tests.dataset.toy import ToyOccluder, ToySource, plan


@pytest.fixture
def folder(tmp_path):
    build(plan(tmp_path), InlineExecutor)
    return tmp_path


def test_a_sound_folder_passes_and_its_points_lie_on_the_source(folder):
    report = verify(folder, ToySource())
    assert report.problems == []
    assert report.rows == {"train": 18, "test": 6}
    assert 0 < report.surface["max"] < 1e-6


def test_points_off_the_surface_are_found(folder):
    other = ToySource()
    other.load = lambda ref: ToySource().load(ref).apply_scale(0.98)
    report = verify(folder, other)
    assert any("off the source's surface" in p for p in report.problems)


def test_an_object_that_the_source_cannot_read_is_named(folder):
    other = ToySource()

    def load(ref):
        raise InputError("part.obj: 7 faces were read, but the file has 8")

    other.load = load
    problems = verify(folder, other).problems
    assert any("cannot be checked: part.obj: 7 faces were read" in p for p in problems)


def test_a_flipped_byte_is_found_and_located(folder):
    path = folder / "train-00001.h5"
    with h5py.File(path) as shard:
        offset = shard["points"].id.get_offset() + shard["points"][0].nbytes * 2 + 5
    damaged = bytearray(path.read_bytes())
    damaged[offset] ^= 1
    path.write_bytes(damaged)
    problems = verify(folder).problems
    assert any("train-00001.h5: its bytes do not hash" in p for p in problems)
    assert any("1 row(s) do not match their digest, the first is row 2" in p for p in problems)
    path.unlink()
    build(plan(folder), InlineExecutor)
    assert verify(folder).sound


def test_missing_and_foreign_files_are_named(folder):
    (folder / "train-00000.h5").rename(folder / "train-00077.h5")
    problems = verify(folder).problems
    assert "train-00077.h5 is not in the manifest" in problems
    assert any(p.startswith("train-00000.h5: missing") for p in problems)


def test_truncated_file_is_reported_not_raised(folder):
    path = folder / "test-00000.h5"
    path.write_bytes(path.read_bytes()[:500])
    assert any("test-00000.h5: not readable" in p for p in verify(folder).problems)


def forge(folder, name, change):
    """Change a shard and make every digest agree again: only the values can give it away."""
    path = folder / name
    with h5py.File(path, "r+") as shard:
        change(shard)
        columns = {k: shard[k][()] for k in shard if k != "objects"}
        shard["row_sha256"][...] = row_digests(columns)
    manifest = json.loads((folder / "manifest.json").read_text())
    for entry in manifest["shards"]:
        if entry["file"] == name:
            entry["sha256"] = bytes_sha256(path.read_bytes())
    (folder / "manifest.json").write_text(json.dumps(manifest))


def set_value(field, row, value):
    def change(shard):
        data = shard[field][()]
        data[row] = value
        shard[field][...] = data

    return change


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("points", np.nan, "not finite"),
        ("R_camera_object", np.diag([1.0, 1.0, -1.0]), "not a rotation"),
        ("label", 2, "label is out of range"),
        ("visible_fraction", 1.5, "outside \\[0, 1\\]"),
        ("n_visible", 0, "n_visible is below the folder's 16"),
        ("symmetry", b"heptagon", "no known group"),
        ("points", 9.0, "outside the unit ball"),
    ],
)
def test_wrong_values_are_named_with_their_row(folder, field, value, message):
    forge(folder, "train-00000.h5", set_value(field, 3, value))
    problems = verify(folder).problems
    assert any(__import__("re").search(message + ".*the first is row 3", p) for p in problems), (
        problems
    )
    assert any("do not hash to the recorded digest" in p for p in problems)


def test_repeated_rows_are_found(folder):
    def repeat(shard):
        for name in shard:
            if name != "objects":
                data = shard[name][()]
                data[1] = data[0]
                shard[name][...] = data

    forge(folder, "train-00000.h5", repeat)
    assert any("occurs twice" in p for p in verify(folder).problems)


def test_an_edited_manifest_and_a_missing_one_are_errors(folder, tmp_path):
    data = json.loads((folder / "manifest.json").read_text())
    data["configuration"]["seed"] = 5
    (folder / "manifest.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match="was edited"):
        verify(folder)
    with pytest.raises(InputError, match="not a data folder"):
        verify(tmp_path / "nowhere")


def test_a_manifest_that_is_no_text_is_an_error(folder):
    path = folder / "manifest.json"
    path.write_bytes(b"\xff\xfe" + path.read_bytes())
    with pytest.raises(InputError, match=r"manifest\.json is damaged \(UnicodeDecodeError"):
        verify(folder)


def test_surface_distance_of_a_cloud_is_to_its_nearest_point():
    cloud = np.array([[0, 0, 0], [1, 0, 0]], np.float32)
    assert surface_distance(cloud, np.array([[0.25, 0, 0], [1, 0, 0.5]])) == pytest.approx(
        [0.25, 0.5]
    )


def test_normals_are_held_against_the_faces_at_their_points():
    box = trimesh.creation.box((2, 2, 2))
    points = np.array([[1, 0.3, 0.2], [1, 1, 0.5], [1, 1, 0.5], [0.2, 0.1, -1], [0, 0, 0]])
    slant = np.array([np.cos(0.1), np.sin(0.1), 0])
    normals = np.array([slant, [1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, 1]])
    angles = normal_angles_deg(box, points, normals)
    # At an edge either face's will do; inside the box no face is near enough.
    assert angles == pytest.approx([np.rad2deg(0.1), 0, 0, 0, 90], abs=1e-6)
    cloud = OrientedCloud(points[:2], np.array([[1, 0, 0], [0, 0, 0]]))
    assert normal_angles_deg(cloud, points[:2], normals[:2])[0] == pytest.approx(np.rad2deg(0.1))
    assert np.isnan(normal_angles_deg(cloud, points[:2], normals[:2])[1])
    assert np.isnan(normal_angles_deg(points, points, normals)).all()


class Slanted(ToyOccluder):
    """As a mistake in a renderer would have it: normals of another face of the object."""

    def views(self, shape, poses, rngs):
        seen = super().views(shape, poses, rngs)
        for view in seen:
            towards = -view.points / np.linalg.norm(view.points, axis=1, keepdims=True)
            view.normals = towards.astype(np.float32)
        return seen


@pytest.mark.parametrize(("occluder", "problems"), [(ToyOccluder, 0), (Slanted, 1)])
def test_normals_of_another_surface_are_found(occluder, problems, tmp_path):
    build(plan(tmp_path, occluder=occluder(normals=True)), InlineExecutor)
    report = verify(tmp_path, ToySource())
    assert len(report.problems) == problems
    assert all("normals are turned from the source's" in p for p in report.problems)


@pytest.fixture(scope="module")
def with_depth(tmp_path_factory):
    folder = tmp_path_factory.mktemp("depth")
    occluder = MitsubaOccluder(48, keep_depth=True)
    build(plan(folder, occluder=occluder, source=ToySource(2)), InlineExecutor)
    assert verify(folder, ToySource(2)).problems == []
    return folder


def swap_rows(images):
    images[[0, 1]] = images[[1, 0]]


def erase(images):
    images[:] = 0


def shift(images):
    images[:] = np.roll(images, 1, axis=2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (swap_rows, "it has another depth where they project to in 2 row"),
        (erase, "another number of pixels than n_visible in 6 row"),
        (shift, "it has another depth where they project to in 6 row"),
        (lambda images: images.fill(np.nan), "depth is not finite and ≥ 0 in 6 row"),
    ],
)
def test_depth_images_that_are_not_those_of_the_points_are_found(
    with_depth, tmp_path, change, message
):
    folder = shutil.copytree(with_depth, tmp_path / "copy")

    def edit(shard):
        images = shard["depth"][()]
        change(images)
        shard["depth"][...] = images

    forge(folder, "train-00000.h5", edit)
    problems = verify(folder).problems
    assert any(message in p for p in problems), problems


def test_depth_of_points_that_no_image_was_formed_of_is_found(tmp_path):
    build(plan(tmp_path, occluder=ToyOccluder(depth=8)), InlineExecutor)
    assert any("that no image can be of" in p for p in verify(tmp_path).problems)


def test_of_a_folder_of_data_folders_those_are_named(tmp_path):
    for name in "abcd":
        build(plan(tmp_path / name), InlineExecutor)
    with pytest.raises(InputError, match=r"Folders in it are: give a, b, c and 1 more$"):
        verify(tmp_path)
