"""The Python interface: one import, each name loaded on its first use."""

from __future__ import annotations

import ast
import base64
import doctest
import html
import importlib
import json
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh

import partialbench as pb
from partialbench import extras
from partialbench.dataset.build import build
from partialbench.dataset.executors import InlineExecutor
from partialbench.errors import InputError
from partialbench.geometry.rotations import is_rotation
from tests.dataset.toy import ToyOccluder, plan


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("data") / "toy"
    build(plan(out, occluder=ToyOccluder(normals=True, depth=5)), InlineExecutor)
    return out


def test_a_type_checker_sees_the_names_that_are_loaded():
    tree = ast.parse(Path(pb.__file__).read_text())
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    seen = {
        alias.asname or alias.name: f"{node.module}:{alias.name}"
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert seen == pb._WHERE
    assert set(pb.__all__) == set(pb._WHERE) <= set(dir(pb))
    for name in pb.__all__:
        assert getattr(pb, name) is getattr(pb, name)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        pb.nothing  # noqa: B018


def test_every_public_name_is_on_the_page_of_the_reference():
    page = (Path(__file__).resolve().parents[1] / "docs/reference/python.md").read_text()
    listed = re.findall(r"^::: (\S+)$", page, re.M)
    assert {entry.replace(":", ".") for entry in pb._WHERE.values()} <= set(listed)
    for name in listed:
        module, _, attribute = name.rpartition(".")
        assert hasattr(importlib.import_module(module), attribute), name


@pytest.mark.parametrize(
    "module",
    ["partialbench", "partialbench.registry", "partialbench.geometry.camera",
     "partialbench.dataset.view", "partialbench.benchmark.pretrained"],
)  # fmt: skip
def test_the_examples_give_what_they_say(module):
    ran = doctest.testmod(importlib.import_module(module))
    assert ran.attempted > 0
    assert ran.failed == 0


def test_look_at_puts_the_target_on_the_axis_and_up_upwards(rng):
    for _ in range(20):
        eye, target = rng.standard_normal((2, 3)) * 3
        R, t = pb.look_at(eye, target)
        assert is_rotation(R)
        assert np.allclose(R @ target + t, (0, 0, np.linalg.norm(target - eye)))
        assert np.allclose(R @ eye + t, 0)
        up = R @ (0, 0, 1)
        assert abs(up[0]) < 1e-12
        assert up[1] < 0
    with pytest.raises(InputError, match="both at"):
        pb.look_at((1, 2, 3), (1, 2, 3))
    with pytest.raises(InputError, match="along the line of sight"):
        pb.look_at((0, 0, 2))
    with pytest.raises(InputError, match="eye must be three finite numbers"):
        pb.look_at((0, np.nan, 2))


def test_a_view_is_the_same_from_a_file_a_mesh_and_again(tmp_path):
    solid = trimesh.creation.box((1, 2, 3))
    solid.export(tmp_path / "box.ply")
    first = pb.render_view(solid, seed=3, num_points=50, resolution=32, depth=True, normals=True)
    again = pb.render_view(tmp_path / "box.ply", seed=3, num_points=50, resolution=32)
    assert np.array_equal(first.points, again.points)
    assert first.points.shape == first.normals.shape == (50, 3)
    assert first.depth.shape == (32, 32)
    assert again.depth is None
    assert (first.points[:, 2] > 0).all()
    # Each point is on one of the box's six sides, in the unit ball's scale.
    back = (first.points - first.t_camera_object) @ first.R_camera_object * np.sqrt(14) / 2
    assert np.abs(np.abs(back) - (0.5, 1, 1.5)).min(axis=1).max() < 1e-4
    other = pb.render_view(solid, seed=4, num_points=50, resolution=32)
    assert not np.allclose(other.R_camera_object, first.R_camera_object)


def test_the_upward_axis_is_turned_in_memory_as_in_a_file(tmp_path):
    solid = trimesh.creation.box((1, 2, 3))
    solid.export(tmp_path / "box.obj")
    views = [
        pb.render_view(shape, "aligned", num_points=40, resolution=32, up="y")
        for shape in (solid, tmp_path / "box.obj")
    ]
    assert np.allclose(views[0].points, views[1].points, atol=1e-6)
    # Seen along its third axis, which was the file's second: 1 by 3 is left.
    width, height, _ = np.ptp(views[0].points, axis=0)
    assert height > 2 * width


def test_a_cloud_loses_its_hidden_half_and_takes_no_options_of_an_image():
    sphere = trimesh.creation.icosphere(4).vertices
    view = pb.render_view(np.asarray(sphere, np.float16), pb.look_at((4, 0, 0)), num_points=None)
    assert 0.3 < view.visible_fraction < 0.55
    assert len(view.points) == view.n_visible
    assert not view.K.any()
    with pytest.raises(InputError, match="depth=True does not apply: the shape is a cloud"):
        pb.render_view(sphere, depth=True)
    with pytest.raises(InputError, match="sensor='tof' does not apply"):
        pb.render_view(sphere, sensor="tof")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"pose": "randon"}, "no pose 'randon'; did you mean random"),
        ({"pose": (np.eye(3) * 2, (0, 0, 3))}, "with R a rotation, .* det R = 8"),
        ({"pose": 5}, "pose must be 'random', 'aligned' or"),
        ({"num_points": 0}, "num_points must be at least 1, got 0"),
        ({"shape": np.zeros((4, 2))}, r"no mesh and no path\) is a ndarray of shape \(4, 2\)"),
        ({"shape": "absent.off"}, "no file at absent.off"),
        ({"shape": __file__}, r"\.py is not read; give a mesh \(\.off"),
        ({"up": "x"}, "up must be one of z, y, got 'x'"),
    ],
)
def test_what_cannot_be_rendered_is_said(arguments, message):
    given = {"shape": trimesh.creation.box(), "resolution": 16, **arguments}
    with pytest.raises(InputError, match=message):
        pb.render_view(**given)


def test_a_folder_is_made_of_meshes_in_this_process(tmp_path):
    for split in ("train", "test"):
        (tmp_path / "cad" / "box" / split).mkdir(parents=True)
        trimesh.creation.box((1, 2, 3)).export(tmp_path / "cad" / "box" / split / f"{split}.off")
    listings = []
    manifest = pb.render_dataset(
        tmp_path / "cad", tmp_path / "out", views=2, points=32, on_listing=listings.append,
        occluder_options={"resolution": 16},
    )  # fmt: skip
    assert (manifest.rows("train"), manifest.rows("test")) == (2, 1)
    assert "<class>/<split>/<file>" in listings[0]
    assert len(pb.load_dataset(tmp_path / "out", "test")) == 1


def test_the_torch_data_set_gives_what_the_shards_hold(folder):
    import torch
    from torch.utils.data import DataLoader

    fields = ("points", "normals", "depth", "label", "R", "t", "K", "object_id", "view")
    data = pb.load_dataset(folder, "train", fields=fields)
    shards = pb.ShardDataset(folder, "train", 64)
    one = data[-1]
    last = len(shards) - 1
    assert tuple(one) == fields
    assert np.array_equal(one["points"], shards.points([last])[0])
    assert np.array_equal(one["normals"], shards.points_and_normals([last])[1][0])
    assert np.array_equal(one["depth"], shards.depth([last])[0])
    assert np.array_equal(one["R"], shards.rotations[last].astype(np.float32))
    assert (one["label"], one["object_id"]) == (shards.labels[last], shards.object_ids[last])
    with pytest.raises(IndexError, match="out of range"):
        data[len(data)]
    (batch,) = DataLoader(data, batch_size=len(data), num_workers=1)
    assert batch["points"].dtype == torch.float32
    assert np.array_equal(batch["points"], shards.points(np.arange(len(shards))))
    assert np.array_equal(batch["label"], shards.labels)
    assert batch["object_id"] == shards.object_ids.tolist()


def test_fewer_points_a_transform_and_wrong_fields(folder):
    data = pb.load_dataset(folder, "test", 10, ("points",), lambda sample: sample["points"].mean())
    assert data[0].shape == ()
    assert len(data) == 6
    with pytest.raises(InputError, match="no field 'lable'; did you mean label"):
        pb.load_dataset(folder, fields=("points", "lable"))
    with pytest.raises(InputError, match="stores 64 points a cloud, 65 were asked for"):
        pb.load_dataset(folder, num_points=65)


def shown(gallery):
    data = re.search(r'id="samples">(.*?)</script>', gallery.html, re.S)[1]
    return json.loads(data)


def test_what_is_shown_has_a_cloud_and_axes_where_there_is_a_pose(folder, rng, tmp_path):
    cloud = rng.standard_normal((30, 3))
    (plain,) = shown(pb.show(cloud))
    assert plain["axes"] == []
    assert len(base64.b64decode(plain["points"])) == 3 * 30
    posed = shown(pb.show(np.stack([cloud, cloud]), np.stack([np.eye(3)] * 2)))
    assert [one["axes"] for one in posed] == [np.eye(3).tolist()] * 2
    assert len(shown(pb.show(folder, samples=3))) == 3
    assert len(shown(pb.show(pb.load_dataset(folder), samples=2))) == 2
    view = pb.render_view(cloud, pb.look_at((0, -3, 0)))
    (seen,) = shown(pb.show(view))
    assert np.allclose(seen["axes"], view.R_camera_object.T, atol=1e-3)
    gallery = pb.show(cloud)
    assert gallery.save(tmp_path / "page.html").read_text() == gallery.html
    assert html.escape(gallery.html) in gallery._repr_html_()
    with pytest.raises(InputError, match=r"R has shape \(3, 3\), expected \(3,3\) for each of 2"):
        pb.show(np.stack([cloud, cloud]), np.eye(3))
    with pytest.raises(InputError, match="expected a data folder, a data set, a View, or clouds"):
        pb.show(np.zeros(3))


def test_a_missing_extra_is_named_with_the_line_that_installs_it(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "mitsuba", None)
    with pytest.raises(extras.MissingExtraError, match=r"pip install 'partialbench\[render\]'"):
        extras.load("mitsuba")
    assert extras.extra_of("torch.utils.data") == "train"
    assert extras.explained(ModuleNotFoundError("x", name="somebodys_module")) is None
    with pytest.raises(ModuleNotFoundError, match="no_such_module"):
        extras.load("no_such_module")
