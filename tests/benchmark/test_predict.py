"""A user's own capture: every format, dense and sparse."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from partialbench.benchmark.predict import Answer, Classifier, draw, read_points
from partialbench.benchmark.training import checkpoint
from partialbench.errors import InputError
from partialbench.geometry.camera import Camera
from tests.benchmark.memory_clouds import MemoryClouds
from tests.benchmark.tiny_models import MODELS


def predict(weights: Path, *capture: Any, **how: Any) -> Answer:
    return Classifier(weights, model=f"{MODELS}:Posed")(*capture, **how)


@pytest.fixture(scope="module")
def weights(done) -> Path:
    return next((done[1] / "runs").glob("*seed0/branch-*/checkpoint.pt"))


def test_every_cloud_format_gives_the_same_answer(weights, tmp_path):
    cloud = MemoryClouds().points([3])[0]
    trimesh.PointCloud(cloud).export(tmp_path / "a.ply")
    np.save(tmp_path / "a.npy", cloud)
    np.savetxt(tmp_path / "a.xyz", cloud, fmt="%.9g")
    np.savetxt(tmp_path / "a.csv", cloud, fmt="%.9g", delimiter=",")
    np.savetxt(tmp_path / "a.pts", cloud, fmt="%.9g")
    header = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS {len(cloud)}\nDATA binary\n"
    (tmp_path / "a.pcd").write_bytes(header.encode() + cloud.tobytes())
    kinds = ("ply", "npy", "xyz", "csv", "pts", "pcd")
    answers = [predict(weights, tmp_path / f"a.{kind}") for kind in kinds]
    first = answers[0]
    assert first.points_given == first.points_used == 64
    assert [name for name, _ in first.top] == [name for name, _ in answers[1].top]
    assert sum(p for _, p in first.top) == pytest.approx(1, abs=1e-5)  # three classes, top 3
    assert first.class_name == first.top[0][0]
    assert first.confidence == max(p for _, p in first.top)
    assert len(first.poses) == 5
    assert np.allclose(first.poses[0][0] @ first.poses[0][0].T, np.eye(3))
    for answer in answers[1:]:
        assert [p for _, p in answer.top] == pytest.approx([p for _, p in first.top], abs=1e-6)


def test_a_depth_image_is_the_cloud_it_was_made_from(weights, tmp_path):
    camera = Camera(np.array([[60, 0, 20.5], [0, 60, 16.0], [0, 0, 1.0]]), 40, 32)
    rng = np.random.default_rng(0)
    depth = np.where(rng.random((32, 40)) < 0.3, rng.integers(1500, 2500, (32, 40)), 0)
    Image.fromarray(depth.astype(np.uint16)).save(tmp_path / "d.png")
    np.save(tmp_path / "d.npy", np.where(depth > 0, depth / 1000, np.nan))
    expected = camera.unproject_depth(depth / 1000)
    from_png = read_points(tmp_path / "d.png", camera.K, 0.001)
    assert np.allclose(from_png, expected)
    assert np.allclose(read_points(tmp_path / "d.npy", (60, 60, 20.5, 16.0)), expected)
    found = predict(weights, tmp_path / "d.png", camera.K, 0.001)
    assert found.points_used == len(expected) // 64 * 64 > 64


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.xyz", "1 2 3\n4 x 6\n", "is no number"),
        ("a.xyz", "1 2 3\n4 5 6\n", "2 finite points, at least 16"),
        ("a.xyz", "nan nan nan\n" * 20, "0 finite points"),
        ("a.xyz", "1 2\n" * 20, r"expected an \(n,3\) cloud with n ≥ 1, got \(20, 2\)"),
        ("a.obj", "v 0 0 0", r"\.obj is not read; give a cloud \(\.ply, .* or a depth image"),
        ("a.ply", "ply", "expected a line that says ply"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 30\nproperty float x\nproperty float y\n"
         "property float z\nend_header\n" + "0 0 1\n" * 20, "cut short: .* 30 vertex lines, 20"),
        ("a.png", "no image", "cannot be read"),
        ("a.npy", "no array", "cannot be read"),
        ("a.npy", "", "cannot be read"),
    ],
)  # fmt: skip
def test_a_file_that_is_no_cloud_says_so(weights, tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=message):
        predict(weights, tmp_path / name)


def test_a_text_of_more_columns_is_a_cloud_whatever_they_are(weights, tmp_path, rng):
    points = rng.standard_normal((40, 9))
    np.savetxt(tmp_path / "scan.txt", points)
    np.savetxt(tmp_path / "bare.txt", points[:, :3])
    wide, bare = (predict(weights, tmp_path / name) for name in ("scan.txt", "bare.txt"))
    assert wide.points_given == 40
    assert wide.top == bare.top


def test_a_depth_image_needs_intrinsics_that_make_sense(weights, tmp_path):
    np.save(tmp_path / "d.npy", np.linspace(1, 2, 600).reshape(20, 30))
    with pytest.raises(InputError, match="30×20 pixels: its intrinsics are needed"):
        predict(weights, tmp_path / "d.npy")
    with pytest.raises(InputError, match="focal lengths must be positive"):
        predict(weights, tmp_path / "d.npy", (-1, 1, 0, 0))
    with pytest.raises(InputError, match="no file at"):
        predict(weights, tmp_path / "absent.ply")
    np.save(tmp_path / "deep.npy", np.ones((20, 30, 1)))
    with pytest.raises(InputError, match=r"shape \(20, 30, 1\); a depth image is one channel"):
        predict(weights, tmp_path / "deep.npy", (60, 60, 15, 10))


def test_points_that_were_not_measured_are_dropped_from_any_cloud(tmp_path, rng):
    points = rng.standard_normal((40, 3))
    points[3], points[7, 1] = np.nan, np.inf
    measured = np.delete(points, [3, 7], axis=0)
    np.save(tmp_path / "a.npy", points)
    np.savetxt(tmp_path / "a.xyz", points)
    for name in ("a.npy", "a.xyz"):
        assert np.array_equal(read_points(tmp_path / name), measured)


def test_a_pose_that_is_nan_is_no_answer(weights, rng):
    classifier = Classifier(weights, model=f"{MODELS}:Posed")
    asked = classifier.model.forward
    classifier.model.forward = lambda clouds: asked(clouds)._replace(
        pose_logits=torch.full((len(clouds), 60), torch.nan)
    )
    with pytest.raises(InputError, match="not a finite number"):
        classifier.predict(rng.normal(size=(64, 3)))


def test_few_points_are_all_used_before_any_is_repeated(rng):
    points = rng.standard_normal((20, 3)).astype(np.float32)
    (drawn,) = draw(points, 50)
    assert drawn.shape == (50, 3)
    assert {tuple(p) for p in drawn} == {tuple(p) for p in points}
    apart = draw(rng.standard_normal((110, 3)), 50, 2)
    assert len({tuple(p) for p in apart.reshape(-1, 3)}) == 100


def test_a_dense_capture_is_cut_into_clouds_that_vote(weights, tmp_path, rng):
    points = rng.standard_normal((64 * 3 + 10, 3))
    np.save(tmp_path / "dense.npy", points)
    model = checkpoint.build_model(checkpoint.load(weights), f"{MODELS}:Posed")
    with torch.inference_mode():
        each = model(torch.from_numpy(draw(points, 64, 3)))
    for votes, used in ((8, 3), (2, 2), (1, 1)):
        found = predict(weights, tmp_path / "dense.npy", votes=votes)
        assert found.points_used == used * 64
        expected = each.class_logits[:used].softmax(1).mean(0)
        assert found.confidence == pytest.approx(float(expected.max()), abs=1e-6)
        pose = each.pose_logits[:used].softmax(1).mean(0)
        assert found.poses[0][1] == pytest.approx(float(pose.max()), abs=1e-6)
    with pytest.raises(InputError, match="votes must be at least 1, got 0"):
        predict(weights, tmp_path / "dense.npy", votes=0)
