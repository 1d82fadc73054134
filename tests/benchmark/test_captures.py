"""Captures that are no shape are refused; far ones, wide ones and folders of them are read."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh
from PIL import Image
from typer.testing import CliRunner

from partialbench.benchmark.captures import read_points
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
    Image.fromarray(depth).save(tmp_path / "good.png")
    assert len(read_points(tmp_path / "good.png", K, 0.001)) == 1024


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
    for name in ("b.npy", "c.ply"):
        (folder / name).unlink()
    ran = CliRunner().invoke(app, command)
    assert ran.exit_code == 0
    assert ran.stdout.count("%") == 2


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
