"""Captures that are no shape are refused; far ones, wide ones and folders of them are read."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from typer.testing import CliRunner

from partialbench.benchmark.captures import captures, given_points, read_points
from partialbench.benchmark.predict import Classifier, find_checkpoint
from partialbench.cli import app
from partialbench.errors import InputError
from tests.benchmark.tiny_models import MODELS

MODEL = f"{MODELS}:Posed"


@pytest.fixture(scope="module")
def weights(done):
    return next((done[1] / "runs").glob("*seed0/branch-64/checkpoint.pt"))


def test_a_chair_far_away_stays_a_chair(weights, tmp_path, rng):
    points = rng.standard_normal((200, 3)) * (0.3, 0.5, 1)
    np.save(tmp_path / "near.npy", points)
    np.save(tmp_path / "far.npy", points + (500_000, 4_649_776, 120))
    classify = Classifier(weights, model=MODEL)
    near, far = (classify(tmp_path / f"{name}.npy") for name in ("near", "far"))
    assert [name for name, _ in far.top] == [name for name, _ in near.top]
    assert far.confidence == pytest.approx(near.confidence, abs=1e-3)
    moved = read_points(tmp_path / "far.npy")
    assert np.allclose(moved - moved.mean(0), points - points.mean(0), atol=1e-8)
    assert np.array_equal(read_points(tmp_path / "near.npy"), points)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda p: p * 0 + 1, "1 distinct point among 200, at least 16"),
        (lambda p: p[np.arange(200) % 15], "15 distinct points among 200"),
        (lambda p: p * 1e30, r"extend over .*e\+30 units"),
        (lambda p: p * 1e300, "extend over"),
        (lambda p: p * 1e-30, "extend over .*e-30 units"),
        (lambda p: p[:, :1] * (1, 2, 3), "all points lie on one line"),
    ],
)
def test_what_is_no_shape_is_refused(tmp_path, rng, make, message):
    np.save(tmp_path / "a.npy", make(rng.standard_normal((200, 3))))
    with pytest.raises(InputError, match=message):
        read_points(tmp_path / "a.npy")


def test_depths_must_be_depths(tmp_path):
    K = (60, 60, 16, 16)
    depth = np.tile(np.arange(1000, 1032, dtype=np.uint16), (32, 1))
    for name, image, message in (
        ("full", np.where(depth > 1020, 65535, depth).astype(np.uint16), "352 of 1024 .* 65535"),
        ("byte", np.where(depth > 1020, 255, 9).astype(np.uint8), "352 of 1024 .*uint8, 255"),
        ("mask", np.where(depth > 1020, 1, 0).astype(np.uint16), "the one depth 1: a mask"),
    ):
        Image.fromarray(image).save(tmp_path / f"{name}.png")
        with pytest.raises(InputError, match=message):
            read_points(tmp_path / f"{name}.png", K)
    Image.fromarray(depth).convert("L").convert("P").save(tmp_path / "palette.png")
    with pytest.raises(InputError, match="a palette"):
        read_points(tmp_path / "palette.png", K)
    Image.fromarray(depth).convert("L").save(tmp_path / "photo.png", "JPEG")
    with pytest.raises(InputError, match=r"begins with b'\\xff\\xd8.*', as no PNG or TIFF does"):
        read_points(tmp_path / "photo.png", K)
    np.save(tmp_path / "behind.npy", -depth.astype(float))
    with pytest.raises(InputError, match=r"no depth is above 0 and 1024 are below; .* negate"):
        read_points(tmp_path / "behind.npy", K)
    np.save(tmp_path / "points.npy", np.ones((2, 40, 3)))
    with pytest.raises(InputError, match=r"one channel \(H,W\), a cloud is \(N,3\)"):
        read_points(tmp_path / "points.npy", K)
    Image.fromarray(depth).save(tmp_path / "good.png")
    assert len(read_points(tmp_path / "good.png", K, 0.001)) == 1024


def test_what_may_be_no_depth_image_or_anothers_intrinsics_is_said(tmp_path, caplog):
    depth = np.tile(np.arange(1000, 1032, dtype=np.uint16), (32, 1))
    Image.fromarray(depth).save(tmp_path / "d.png")
    Image.fromarray((depth // 8).astype(np.uint8)).save(tmp_path / "eight.png")
    assert len(read_points(tmp_path / "d.png", (60, 60, 16, 16))) == 1024
    assert not caplog.records
    assert len(read_points(tmp_path / "d.png", (525, 525, 319.5, 239.5))) == 1024
    assert "the principal point (319.5, 239.5) is not in the image of 32×32" in caplog.text
    caplog.clear()
    assert len(read_points(tmp_path / "eight.png", (60, 60, 16, 16))) == 1024
    assert "has 8 bits a pixel, at most 256 depths" in caplog.text


def test_an_array_of_more_columns_is_a_cloud_and_says_so(tmp_path, rng, caplog):
    for columns in (4, 6, 7, 9):
        points = rng.standard_normal((200, columns))
        np.save(tmp_path / "a.npy", points)
        caplog.clear()
        for K in (None, (525, 525, 319.5, 239.5)):
            assert np.array_equal(read_points(tmp_path / "a.npy", K), points[:, :3])
        assert f"of {columns} columns the first three are taken" in caplog.text
        # Intrinsics with a principal point inside mean a narrow image.
        assert read_points(tmp_path / "a.npy", (9, 9, 2, 100)).shape[0] == (points > 0).sum()
    np.save(tmp_path / "words.npy", np.array([["a", "b", "c"]] * 20))
    with pytest.raises(InputError, match="no array of real numbers"):
        read_points(tmp_path / "words.npy")


def test_an_array_is_read_as_a_cloud_file_is(tmp_path, rng, caplog):
    """A point a column, axes of length 1 and named fields; with intrinsics for other files too."""
    points = rng.standard_normal((200, 3))
    named = np.array([tuple(row) for row in points], [(axis, "f8") for axis in "xyz"])
    for array in (points.T, np.vstack([points.T, points.T]), points[None], points.T[None], named):
        np.save(tmp_path / "a.npy", array)
        for K in (None, (525, 525, 319.5, 239.5)):
            assert np.array_equal(read_points(tmp_path / "a.npy", K), points)
    assert {record.getMessage().partition(": ")[2] for record in caplog.records} == {
        "of 6 columns the first three are taken for x, y, z"
    }
    depth = np.abs(points.T) + 1
    np.save(tmp_path / "a.npy", depth)
    assert len(read_points(tmp_path / "a.npy", (9, 9, 100, 2))) == depth.size
    np.save(tmp_path / "a.npy", depth.reshape(1, 20, 30))
    assert len(read_points(tmp_path / "a.npy", (30, 30, 15, 10))) == depth.size


def test_an_array_too_narrow_for_an_image_is_none_by_intrinsics_of_another(tmp_path, rng):
    """A point a column with a row of ones: with intrinsics of a camera it was read as depths."""
    points = np.abs(rng.standard_normal((200, 3))) + 1
    for array in (np.c_[points, np.ones(200)].T, np.c_[points, points, points[:, 0]].T,
                  points[:, :2], points.reshape(1, -1)):  # fmt: skip
        np.save(tmp_path / "a.npy", array)
        with pytest.raises(InputError, match=r"too narrow for a depth image, .*\(319.5, 239.5\)"):
            read_points(tmp_path / "a.npy", (525, 525, 319.5, 239.5))
        with pytest.raises(InputError, match="its intrinsics are needed"):
            read_points(tmp_path / "a.npy")
        rows, columns = array.shape
        inside = (9, 9, columns / 2, rows / 2)
        assert len(read_points(tmp_path / "a.npy", inside)) == array.size


def test_columns_that_are_left_aside_are_said_whatever_the_format(tmp_path, rng, caplog):
    table = rng.standard_normal((50, 6)).round(4)
    np.savez(tmp_path / "a.npz", points=table)
    np.savetxt(tmp_path / "counted.pts", table, header="50", comments="")
    (tmp_path / "wide.txt").write_text("\n".join(" ".join(map(str, row)) for row in table),
                                       encoding="utf-16")  # fmt: skip
    for name in ("a.npz", "counted.pts", "wide.txt"):
        caplog.clear()
        assert np.allclose(read_points(tmp_path / name), table[:, :3])
        assert "of 6 columns the first three are taken" in caplog.text
    caplog.clear()
    np.savetxt(tmp_path / "named.txt", table, header="r g b x y z")
    assert np.allclose(read_points(tmp_path / "named.txt"), table[:, 3:])
    assert not caplog.records


def test_an_image_of_depths_in_an_archive_is_no_cloud(tmp_path, rng):
    np.savez(tmp_path / "a.npz", depth=rng.random((48, 64)))
    with pytest.raises(InputError, match=r"\(48, 64\): an image, or 64 numbers a point"):
        read_points(tmp_path / "a.npz")


def test_zeros_where_nothing_was_measured_are_left_out(tmp_path, rng, caplog):
    points = rng.standard_normal((200, 3))
    np.savetxt(tmp_path / "a.xyz", np.vstack([points[:50], np.zeros((40, 3)), points[50:]]))
    assert np.allclose(read_points(tmp_path / "a.xyz"), points)
    assert "40 of 240 points are (0, 0, 0), as where nothing was measured" in caplog.text
    caplog.clear()
    # One zero may be a point, and so may several where every point is there several times.
    for kept in (
        np.vstack([points, np.zeros((1, 3))]),
        np.tile(np.vstack([points, [0] * 3]), (3, 1)),
    ):
        np.save(tmp_path / "a.npy", kept)
        assert np.array_equal(read_points(tmp_path / "a.npy"), kept)
    assert not caplog.records


def test_points_that_overflowed_are_not_left_out_in_silence(tmp_path, rng, caplog):
    points = rng.standard_normal((200, 3))
    points[:30, 1] = 1e6
    points[30:40] = np.nan  # where nothing was measured, which needs no word
    with np.errstate(over="ignore"):
        half = points.astype(np.float16)
    np.save(tmp_path / "half.npy", half)
    for read in (lambda: read_points(tmp_path / "half.npy"), lambda: given_points(half)):
        caplog.clear()
        assert np.array_equal(read(), half[40:])
        assert "30 of 200 points are infinite and were left out" in caplog.text
    caplog.clear()
    given_points(half[30:])
    assert not caplog.records


def test_an_image_file_of_several_images_is_refused(tmp_path):
    pages = [Image.fromarray(np.full((20, 20), k, np.float32) + np.eye(20)) for k in (1, 2)]
    pages[0].save(tmp_path / "a.tif", save_all=True, append_images=pages[1:])
    with pytest.raises(InputError, match="has 2 images; expected one, of depths"):
        read_points(tmp_path / "a.tif", (20, 20, 10, 10))


def test_columns_that_a_header_names_are_not_said_to_be_the_first(tmp_path, rng, caplog):
    points = rng.standard_normal((50, 3)).round(6)
    table = np.column_stack([points[:, ::-1], np.ones(50)])
    np.savetxt(tmp_path / "a.txt", table, header="z y x intensity", comments="")
    assert np.allclose(read_points(tmp_path / "a.txt"), points)
    assert not caplog.records


def test_a_run_or_a_folder_of_results_stands_for_its_checkpoint(weights, tmp_path):
    run = weights.parents[1]
    assert find_checkpoint(run) == find_checkpoint(weights.parent) == find_checkpoint(weights)
    with pytest.raises(InputError, match="has 2 runs, give the folder of one: "):
        find_checkpoint(weights.parents[3])
    with pytest.raises(InputError, match="no checkpoint in"):
        find_checkpoint(tmp_path)
    assert Classifier(weights.parent, "auto", MODEL).device.type in ("cpu", "cuda")
    for device, message in (("gpu", "must be auto, cpu"), ("cuda:99", "cuda")):
        with pytest.raises(InputError, match=message):
            Classifier(weights, device, MODEL)


def test_one_bad_file_of_a_folder_does_not_end_it(weights, tmp_path, rng):
    folder = tmp_path / "captures"
    (folder / "sub").mkdir(parents=True)
    np.save(folder / "a.npy", rng.standard_normal((80, 3)))
    np.save(folder / "b.npy", np.ones((80, 3)))
    (folder / "c.ply").write_text("ply")
    np.savetxt(folder / "sub" / "d.xyz", rng.standard_normal((80, 3)))
    (folder / "notes.md").write_text("mine")
    command = ["predict", "--checkpoint", str(weights), "--model", MODEL, str(folder)]
    ran = CliRunner().invoke(app, [*command, "--json"])
    assert ran.exit_code == 1
    lines = [json.loads(line) for line in ran.stdout.splitlines()]
    assert [line["file"].rpartition("/")[2] for line in lines] == ["a.npy", "b.npy", "c.ply",
                                                                   "d.xyz"]  # fmt: skip
    assert ["error" in line for line in lines] == [False, True, True, False]
    in_words = CliRunner().invoke(app, command)
    assert in_words.exit_code == 1
    for name in ("b.npy", "c.ply"):  # an error is one line, however long its path
        assert any(
            line.startswith("error: ") and str(folder / name) in line
            for line in in_words.stderr.splitlines()
        ), in_words.stderr
        (folder / name).unlink()
    ran = CliRunner().invoke(app, command)
    assert ran.exit_code == 0
    assert ran.stdout.count("%") == 2


def test_no_file_of_a_folder_is_left_out_in_silence(tmp_path, rng, caplog):
    folder, other = tmp_path / "captures", tmp_path / "other"
    for place in (folder / "dir.npy", folder / ".hidden", other):
        place.mkdir(parents=True)
        np.save(place / "a.npy", rng.standard_normal((80, 3)))
    (folder / "link.npy").symlink_to(other / "a.npy")
    (folder / "nowhere.npy").symlink_to(tmp_path / "absent")
    (folder / "linked").symlink_to(other)
    (folder / "loop").symlink_to(folder)
    os.mkfifo(folder / "pipe.npy")
    found = list(captures(folder))
    assert [path.name for path in found] == ["a.npy", "link.npy", "nowhere.npy", "pipe.npy"]
    assert found[0].parent.name == "dir.npy"
    for name in ("linked", "loop"):
        assert f"{folder / name} (a link; give the folder it leads to)" in caplog.text
    for name, message in (("nowhere", "is a link to .*absent, where none is"),
                          ("pipe", "is a pipe or a device")):  # fmt: skip
        with pytest.raises(InputError, match=message):
            read_points(folder / f"{name}.npy")


def test_a_folder_that_cannot_be_opened_is_named(tmp_path, rng, caplog, monkeypatch):
    (tmp_path / "closed").mkdir()
    np.save(tmp_path / "a.npy", rng.standard_normal((80, 3)))
    opened = os.scandir

    def scandir(path):
        if os.fspath(path).endswith("closed"):
            raise PermissionError(13, "Permission denied", os.fspath(path))
        return opened(path)

    def is_file(path):
        raise PermissionError(13, "Permission denied", os.fspath(path))

    with monkeypatch.context() as patch:  # a folder that lists its files and opens none
        patch.setattr(Path, "is_file", is_file)
        with pytest.raises(InputError, match=r"a\.npy cannot be read: .*Permission denied"):
            read_points(tmp_path / "a.npy")
    monkeypatch.setattr(os, "scandir", scandir)
    assert [path.name for path in captures(tmp_path)] == ["a.npy"]
    assert f"{tmp_path / 'closed'} (Permission denied)" in caplog.text


def test_a_mesh_is_no_scan_and_says_so(tmp_path, caplog):
    ball = trimesh.creation.icosphere(2)
    ball.export(tmp_path / "ball.ply")
    assert len(read_points(tmp_path / "ball.ply")) == 162
    assert "is a mesh: its 162 vertices are taken for the points of a scan" in caplog.text
    caplog.clear()
    trimesh.PointCloud(ball.vertices).export(tmp_path / "scan.ply")
    assert len(read_points(tmp_path / "scan.ply")) == 162
    assert not caplog.records
    ball.export(tmp_path / "ball.off")
    with pytest.raises(InputError, match=r"\.off is not read; .* of a mesh render a view first"):
        read_points(tmp_path / "ball.off")
    with pytest.raises(InputError, match="it is a folder; give one of its files"):
        read_points(tmp_path)
