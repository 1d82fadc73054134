"""Arguments as callers really give them: odd and legal is taken, wrong is said."""

from __future__ import annotations

import pickle
import shutil
from pathlib import Path

import numpy as np
import pandas
import pytest
import torch
import trimesh

import partialbench as pb
from partialbench import given
from partialbench.dataset.build import build
from partialbench.dataset.executors import InlineExecutor
from partialbench.errors import InputError
from tests.dataset.toy import ToyOccluder, plan

SEEN = pb.look_at((0, -3, 0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("data") / "toy"
    build(plan(out, occluder=ToyOccluder(depth=5)), InlineExecutor)
    return out


@pytest.fixture(scope="module")
def sphere():
    return np.array(trimesh.creation.icosphere(3).vertices)


def test_a_path_is_not_empty_and_a_tilde_is_the_home(tmp_path, monkeypatch, sphere):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    np.save(tmp_path / "ball.npy", sphere)
    view = pb.render_view("~/ball.npy", SEEN, num_points=64)
    assert np.array_equal(view.points, pb.render_view(sphere, SEEN, num_points=64).points)
    assert pb.show(view).save("~/page.html") == tmp_path / "page.html"
    assert not (tmp_path / "~").exists()
    for call in (pb.render_view, pb.load_dataset, pb.show, pb.load_model, pb.leaderboard):
        with pytest.raises(InputError, match=r"is empty, got ''; write '\.' for"):
            call("")
    with pytest.raises(InputError, match="~no_such_user_here/x' begins with a home folder"):
        pb.load_dataset("~no_such_user_here/x")
    for value in (3, None, b"x"):
        with pytest.raises(InputError, match="out must be a path, a str or a pathlib"):
            given.path(value, "out")


@pytest.mark.parametrize(
    ("value", "number"), [(0, 0), (np.int64(7), 7), (np.uint8(3), 3), (torch.tensor(5), 5)]
)
def test_whole_numbers_of_any_kind(value, number):
    assert given.whole_number(value, "n") == number
    assert type(given.whole_number(value, "n")) is int


@pytest.mark.parametrize("value", [64.0, True, np.True_, "64", None, [1], np.array([1, 2])])
def test_what_is_no_whole_number_is_said(value):
    with pytest.raises(InputError, match=r"^num_points must be a whole number, got "):
        given.whole_number(value, "num_points")


def test_one_or_several_a_text_is_one():
    assert given.several("100k", "clouds") == ["100k"]
    assert given.several(Path("a"), "data") == [Path("a")]
    assert given.several(np.float32(15), "test_poses") == [15]
    assert given.several(np.array([64, 128]), "test_points") == [64, 128]
    assert given.several(None, "test_data") == []
    for wrong in ({"a": 1}, object()):
        with pytest.raises(InputError, match="clouds must be one or a list of them"):
            given.several(wrong, "clouds")


@pytest.mark.parametrize("value", [0, -1, np.nan, np.inf, "2", None, [1, 2], True, np.True_])
def test_a_scale_is_a_positive_number(value):
    with pytest.raises(InputError, match=r"^depth_scale must be a finite number above 0, got "):
        given.positive(value, "depth_scale")


def laid_out(points: np.ndarray) -> dict[str, object]:
    """The same points in whatever holds points."""
    read_only = points.copy()
    read_only.flags.writeable = False
    return {
        "Fortran": np.asfortranarray(points),
        "strided": np.repeat(points, 2, axis=1)[:, ::2],
        "reversed": points[::-1][::-1],
        "read-only": read_only,
        "big-endian": points.astype(">f8"),
        "lists": points.tolist(),
        "tuples": tuple(map(tuple, points)),
        "tensor": torch.from_numpy(points.copy()),
        "with gradient": torch.tensor(points, requires_grad=True),
        "unmasked": np.ma.masked_array(points),
    }


def test_points_are_the_same_in_any_layout(sphere):
    seen = pb.render_view(sphere, SEEN, 64).points
    for name, points in laid_out(sphere).items():
        assert np.array_equal(pb.render_view(points, SEEN, 64).points, seen), name
    for kind in (np.float16, torch.bfloat16, np.int32):
        tensor = isinstance(kind, torch.dtype)
        rounded = torch.tensor(100 * sphere).to(kind) if tensor else (100 * sphere).astype(kind)
        points = pb.render_view(rounded, SEEN, None).points
        # On the sphere but for a hundredth: whole numbers and bfloat16 are as coarse.
        assert np.abs(np.linalg.norm(points - (0, 0, 3), axis=1) - 1).max() < 0.03


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: p.T, r"shape \(3, 642\), expected \(N,3\); transpose it"),
        (lambda p: np.c_[p, p], r"shape \(642, 6\), expected \(N,3\)"),
        (lambda p: p.astype(complex), "type complex128, expected"),
        (lambda p: torch.tensor(p).cfloat(), "type complex64, expected"),
        (lambda p: p > 0, "type bool, expected"),
        (lambda p: p.astype(object), "type object, expected"),
        (lambda p: np.ma.masked_array(p, p > 0.9), "has masked points; leave them out"),
        (lambda p: [[1.0, 2.0, 3.0], [1.0]], "is no array"),
        (lambda p: None, r"is a NoneType of shape \(\)"),
        (lambda p: torch.tensor(p).to_sparse(), "is no array, expected .N,3.: .* Sparse"),
        (lambda p: torch.tensor(p).to("meta"), "is no array, expected .N,3.: .* meta tensor"),
        (lambda p: pandas.DataFrame(p, columns=["z", "Y", "x"]), "has the columns z, y, x; give"),
    ],
)  # fmt: skip
def test_what_are_no_points_is_said(sphere, change, message):
    with pytest.raises(InputError, match=message):
        given.cloud(change(sphere))
    with pytest.raises(InputError, match=message):
        pb.render_view(change(sphere), SEEN)


def test_a_table_with_names_in_order_is_its_points(sphere):
    for names in (["x", "y", "z"], ["X", "Y", "Z"], [0, 1, 2], ["a", "b", "c"]):
        assert np.array_equal(given.cloud(pandas.DataFrame(sphere, columns=names)), sphere)


def test_padding_is_no_part_of_a_complete_cloud(sphere):
    """As in a folder of clouds: the zeros would be points in the middle of the object."""
    with pytest.raises(InputError, match=r"50 of 692 points are \(0, 0, 0\)"):
        pb.render_view(np.r_[sphere, np.zeros((50, 3))], SEEN)


def test_an_empty_cloud_is_said():
    with pytest.raises(InputError, match="the cloud has no points"):
        pb.render_view(np.zeros((0, 3)))


def test_a_scene_is_all_its_meshes():
    left, right = (trimesh.creation.box((1, 1, 1)) for _ in range(2))
    right.apply_translation((3, 0, 0))
    whole = pb.render_view(trimesh.util.concatenate([left, right]), SEEN, 64, 32)
    assert np.array_equal(
        pb.render_view(trimesh.Scene([left, right]), SEEN, 64, 32).points, whole.points
    )


def test_a_cloud_in_a_scene_is_not_left_out_in_silence(sphere):
    scene = trimesh.Scene({"box": trimesh.creation.box(), "scan": trimesh.PointCloud(sphere)})
    with pytest.raises(InputError, match="the scene's part 'scan' is a cloud, expected meshes"):
        pb.render_view(scene, SEEN)
    scene.delete_geometry("scan")
    assert len(pb.render_view(scene, SEEN, 64, 32).points) == 64


@pytest.mark.parametrize(
    ("t", "message"),
    [
        ((0, 0, -3), "z = -3 in the camera frame"),
        ((0, 0, 0.5), "z = 0.5 in the camera frame"),
        ((0, 0, 1), "z must exceed 1"),
        ((0, 0, 1e6), "is 1e[+]06 units away, 300 at most"),
        ((400, 0, 3), "units away, 300 at most"),
    ],
)
def test_what_is_behind_the_camera_or_too_far_is_not_rendered(sphere, t, message):
    for shape in (sphere, trimesh.creation.box()):
        with pytest.raises(InputError, match=message):
            pb.render_view(shape, (np.eye(3), t))


def test_far_away_half_a_sphere_is_seen():
    ball = trimesh.creation.icosphere(3)
    for distance in (30, 299):
        view = pb.render_view(ball, (np.eye(3), (0, 0, distance)), 64, 64)
        assert abs(view.visible_fraction - 0.5) < 0.04


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_points": 64.0}, "num_points must be a whole number, got 64.0"),
        ({"seed": None}, "seed must be a whole number, got None"),
        ({"sensor": None}, "a sensor is named by a text such as 'tof:0.5', got None"),
        ({"resolution": 10**6}, "resolution must be at most 16384, got 1000000"),
        ({"pose": "aligne"}, "no pose 'aligne'; did you mean aligned"),
        ({"pose": (SEEN[0] + 0j, SEEN[1])}, "R of the pose is of type complex128"),
        ({"pose": (SEEN[0], ["0", "0", "3"])}, "t of the pose is of type <U1"),
        ({"depth": "no"}, "depth must be True or False, got 'no'"),
        ({"normals": 1}, "normals must be True or False, got 1"),
        ({"up": np.array((0, 0, 1))}, "up must be one of z, y, got array"),
    ],
)
def test_wrong_arguments_of_a_view(arguments, message):
    with pytest.raises(InputError, match=message):
        pb.render_view(trimesh.creation.box(), **{"resolution": 16, **arguments})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_points": 8.0}, "num_points must be a whole number"),
        ({"num_points": True}, "num_points must be a whole number"),
        ({"num_points": 0}, "num_points must be at least 1, got 0"),
        ({"fields": [3]}, "no field 3; known: K, R"),
        ({"transform": "mean"}, "transform must be something to call"),
        ({"folder": 3}, "the data folder must be a path"),
        ({"folder": __file__}, "test_given.py is a file, expected a data folder"),
        ({"fields": None}, "fields is empty: name one or more of points"),
        ({"split": np.array(["train", "test"])}, 'split must be "train" or "test", got array'),
    ],
)
def test_wrong_arguments_of_a_data_set(folder, arguments, message):
    with pytest.raises(InputError, match=message):
        pb.load_dataset(**{"folder": folder, **arguments})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"points": "64"}, "points must be a whole number, got '64'"),
        ({"points": 64.0}, "points must be a whole number, got 64.0"),
        ({"views": 1.5}, "views must be a whole number, got 1.5"),
        ({"seed": None}, "seed must be a whole number, got None"),
        ({"workers": "2"}, "workers must be a whole number, got '2'"),
        ({"objects_per_class": True}, "objects_per_class must be a whole number, got True"),
        ({"min_visible": 0}, "min_visible must be at least 1, got 0"),
        ({"normals": "yes"}, "normals must be True or False, got 'yes'"),
        ({"splits": "val"}, "the source has no split 'val'"),
        ({"out": None}, "the data folder must be a path"),
        ({"source": [1]}, "the source must be a path"),
        ({"source_options": "up=y"}, "source_options must be a dictionary"),
        ({"resolution": 32}, r"no option 'resolution'.* occluder_options=\{…\} \(resolution"),
        ({"pionts": 32}, "no option 'pionts'; did you mean points"),
    ],
)
def test_wrong_arguments_of_a_rendering_make_no_folder(tmp_path, arguments, message):
    given = {"source": "parametric", "out": tmp_path / "out", **arguments}
    with pytest.raises(InputError, match=message):
        pb.render_dataset(**given)
    assert not list(tmp_path.iterdir())


def test_what_a_notebook_shows_of_them_is_a_line(folder, sphere):
    view = pb.render_view(sphere, SEEN, 64, normals=True)
    seen = f"{view.visible_fraction:.0%} of the surface seen"
    assert repr(view) == f"<View of 64 points, normals; {seen}>"
    assert view != pb.render_view(sphere, SEEN, 64, normals=True)  # and no error of NumPy's
    assert repr(pb.load_dataset(folder, num_points=8, fields="label")) == (
        f"<TorchDataset of label of <toy train: 18 clouds of 8 points, 2 classes, in {folder}>>"
    )
    about = "<Classifier papnet-steered, trained on "
    assert repr(pb.load_model()).startswith(about)


def test_rows_are_told_by_numbers_or_by_a_mask(folder):
    data = pb.ShardDataset(folder, "train", 16)
    mask = data.labels == data.labels[-1]
    rows = np.flatnonzero(mask)
    assert 0 < len(rows) < len(data)
    assert np.array_equal(data.points(mask), data.points(rows))
    assert np.array_equal(data.depth(mask.tolist()), data.depth(rows))
    assert np.array_equal(data.points(torch.tensor(rows)), data.points(rows))
    assert data.points(~np.ones(len(data), bool)).shape == (0, 16, 3)
    for wrong in ([0.5], mask[1:], [[0, 1]], 0, ["0"], slice(0, 2)):
        with pytest.raises(InputError, match=r"row indices must be whole|mask of rows must have"):
            data.points(wrong)
    samples = pb.load_dataset(folder)
    for wrong in (0.5, "0", True, slice(0, 2)):
        with pytest.raises(InputError, match="an index of a sample must be a whole number"):
            samples[wrong]


def test_a_relative_folder_is_read_from_anywhere_once_it_is_open(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(folder.parent)
    data = pb.load_dataset(folder.name, "test", fields=("points", "depth"))
    opened = pickle.dumps(data)
    monkeypatch.chdir(tmp_path)
    first = pb.load_dataset(folder, "test", fields=("points", "depth"))[0]
    for read in (data, pickle.loads(opened)):
        assert all(torch.equal(read[0][name], first[name]) for name in first)


def test_a_folder_that_was_moved_says_so(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "a räumliche one")
    data = pb.load_dataset(tmp_path / "a räumliche one")
    (tmp_path / "a räumliche one").rename(tmp_path / "b")
    with pytest.raises(InputError, match="moved, deleted or rewritten since the folder was opened"):
        data[0]
    assert len(pb.load_dataset(tmp_path / "b")) == len(data)


def test_what_is_shown_is_taken_as_points_are(sphere):
    for name, points in laid_out(sphere).items():
        assert pb.show(points).html == pb.show(sphere).html, name
    assert pb.show([sphere, sphere[:9]], [np.eye(3), torch.eye(3)]).samples == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"data": np.zeros((0, 3))}, "the cloud has no points"),
        ({"data": [np.ones((4, 3)), np.full((4, 3), np.nan)]}, "cloud 1 has points that are NaN"),
        ({"data": np.array([["a"] * 3])}, "the cloud is of type <U1"),
        ({"data": {"points": np.ones((4, 3))}}, "got a dict of 0 dimensions; give its points"),
        ({"data": np.ones((3, 40))}, "transpose it"),
        ({"R": np.eye(3) * 2}, "R is no rotation"),
        ({"R": np.full((3, 3), np.nan)}, "R is no rotation"),
        ({"R": "a"}, r"R has shape \(\), expected \(3,3\)"),
        ({"R": np.eye(3) + 0j}, "R is of type complex128, expected"),
        ({"R": [np.eye(3), None]}, "R is no array, expected"),
        ({"split": "test"}, "split='test' is for a data folder; got a ndarray"),
    ],
)
def test_what_cannot_be_shown_is_said(sphere, arguments, message):
    with pytest.raises(InputError, match=message):
        pb.show(**{"data": sphere, **arguments})


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda f: pb.show(f, samples=1.5), "samples must be a whole number, got 1.5"),
        (lambda f: pb.show(f, seed=None), "seed must be a whole number, got None"),
        (lambda f: pb.look_at("abc"), "look_at: eye must be three finite numbers, got 'abc'"),
        (lambda f: pb.look_at((1, 2, 3j)), "look_at: eye must be three finite numbers"),
        (lambda f: pb.look_at(np.array((1, 2, 3j))), "look_at: eye must be three finite numbers"),
        (lambda f: pb.look_at(("1", "2", "3")), "look_at: eye must be three finite numbers"),
        (lambda f: pb.show(pb.ShardDataset(f, "train", 16), split="test"), "is of 'train'"),
        (
            lambda f: pb.show(
                pb.render_view(trimesh.creation.icosphere(2).vertices, SEEN), SEEN[0]
            ),
            "a View has its own pose",
        ),
        (lambda f: pb.ShardDataset(f, "train", 16).points([0], 3), "rng must be a numpy.random"),
        (lambda f: pb.list_models(pretrained="no"), "pretrained must be True or False, got 'no'"),
        (lambda f: pb.leaderboard(f, check="no"), "check must be True or False, got 'no'"),
        (lambda f: pb.leaderboard(f, figures=1), "figures must be True or False, got 1"),
        (lambda f: pb.leaderboard(f, on_progress=1), "on_progress must be something to call"),
        (lambda f: pb.list_models(None), "a pattern of names is a text"),
        (lambda f: pb.create_model("pointnet", 2.5), "num_classes must be a whole number, got 2.5"),
        (lambda f: pb.create_model("pointnet", True), "num_classes must be a whole number"),
        (lambda f: pb.create_model(None, 5), "a model is named by a text such as .*, got None"),
        (lambda f: pb.load_model(3), "weights must be a path"),
        (lambda f: pb.load_model(device=0), "device must be auto, cpu, cuda or cuda:0 …, got '0'"),
        (lambda f: pb.load_model(model=list), "a model is named by a text"),
        (lambda f: pb.leaderboard(f, data=3), "data must be one or a list of them|must be a path"),
    ],
)
def test_wrong_arguments_end_in_a_sentence(folder, call, message):
    with pytest.raises(InputError, match=message):
        call(folder)
