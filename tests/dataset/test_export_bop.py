"""The BOP export, read back by the format's definition: the true poses show the true surfaces."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh
from PIL import Image

from partialbench.dataset.build import build
from partialbench.dataset.executors import InlineExecutor
from partialbench.dataset.export import bop, check_export, export
from partialbench.dataset.loader import ShardDataset
from partialbench.dataset.render import plan_render, render_dataset
from partialbench.errors import InputError
from partialbench.geometry.rotations import is_rotation
from partialbench.geometry.symmetry import GROUPS
from tests.dataset.toy import plan


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("bop")
    made = plan_render(
        "pm40", root / "data", source_options={"counts": (1, 1)}, points=64,
        occluder_options={"resolution": 48, "keep_depth": True}, splits=("test",),
        rows_per_shard=25,
    )  # fmt: skip
    build(made, InlineExecutor)
    export(root / "data", "bop", root / "bop")
    return root / "data", root / "bop"


def load(path):
    """JSON with integer keys, as the benchmark's loader has it."""
    return {int(key): value for key, value in json.loads(path.read_text()).items()}


def images(out):
    for scene in sorted((out / "test").iterdir()):
        cameras, truths = load(scene / "scene_camera.json"), load(scene / "scene_gt.json")
        assert cameras.keys() == truths.keys()
        for im in cameras:
            (truth,) = truths[im]
            depth = np.asarray(Image.open(scene / "depth" / f"{im:06d}.png"), np.float64)
            yield depth * cameras[im]["depth_scale"], cameras[im], truth


def test_the_depth_of_each_image_lies_on_the_model_in_its_true_pose(folders):
    """Back-projected as the benchmark does: a pixel's centre is its integer index."""
    _, out = folders
    assert check_export(out) == []
    seen = 0
    for depth, camera, truth in list(images(out))[:12]:
        K = np.reshape(camera["cam_K"], (3, 3))
        R, t = np.reshape(truth["cam_R_m2c"], (3, 3)), np.array(truth["cam_t_m2c"])
        rows, columns = np.nonzero(depth)
        z = depth[rows, columns]
        points = np.stack(
            [(columns - K[0, 2]) / K[0, 0] * z, (rows - K[1, 2]) / K[1, 1] * z, z], axis=1
        )
        model = trimesh.load(out / "models" / f"obj_{truth['obj_id']:06d}.ply", process=False)
        on_model = (points - t) @ R
        distance = trimesh.proximity.closest_point_naive(model, on_model[:40])[1]
        # A step of depth is 0.1 mm of objects that are 2,000 mm across.
        assert distance.max() < 0.1
        seen += len(points)
    assert seen > 1000


def test_poses_and_names_are_those_of_the_rows(folders):
    folder, out = folders
    data = ShardDataset(folder, "test", 64)
    found = [(truth, camera) for _, camera, truth in images(out)]
    assert len(found) == len(data)
    R = np.array([truth["cam_R_m2c"] for truth, _ in found]).reshape(-1, 3, 3)
    t = np.array([truth["cam_t_m2c"] for truth, _ in found])
    K = np.array([camera["cam_K"] for _, camera in found]).reshape(-1, 3, 3)
    assert np.array_equal(R, data.rotations)
    assert np.allclose(t, data.translations * 1000, rtol=0, atol=1e-9)
    assert np.allclose(K[:, :2, 2] + 0.5, data.intrinsics[:, :2, 2])
    assert is_rotation(R).all()
    objects = load(out / "objects.json")
    assert [objects[truth["obj_id"]]["object_id"] for truth, _ in found] == data.object_ids.tolist()
    targets = json.loads((out / "test_targets_bop19.json").read_text())
    assert len(targets) == len(data)
    assert targets[0] == {"scene_id": 0, "im_id": 0, "obj_id": found[0][0]["obj_id"],
                          "inst_count": 1}  # fmt: skip


def test_models_have_their_size_and_their_symmetries(folders):
    folder, out = folders
    data = ShardDataset(folder, "test", 64)
    group_of = dict(zip(data.object_ids.tolist(), data.symmetries.tolist(), strict=True))
    info, objects = load(out / "models" / "models_info.json"), load(out / "objects.json")
    assert info.keys() == objects.keys()
    kinds = set()
    for number, about in info.items():
        model = trimesh.load(out / "models" / f"obj_{number:06d}.ply", process=False)
        low, high = model.bounds
        assert [about[f"min_{axis}"] for axis in "xyz"] == pytest.approx(low, abs=1e-3)
        assert [about[f"size_{axis}"] for axis in "xyz"] == pytest.approx(high - low, abs=1e-3)
        assert max(high - low) <= about["diameter"] <= 2000.001
        group = group_of[objects[number]["object_id"]]
        kinds.add(group)
        assert len(about.get("symmetries_discrete", [])) == len(GROUPS[group].elements) - 1
        assert ("symmetries_continuous" in about) == (group == "z-inf")
    assert {"none", "z-inf", "z-180", "xyz-180"} <= kinds


def test_a_symmetry_maps_a_symmetric_model_onto_itself():
    found = bop.as_symmetries(GROUPS["z-90"])["symmetries_discrete"]
    box = trimesh.creation.box((2, 2, 1)).vertices
    for numbers in found:
        turned = box @ np.reshape(numbers, (4, 4))[:3, :3].T
        assert {tuple(v) for v in np.round(turned, 9) + 0.0} == {tuple(v) for v in box + 0.0}
    assert bop.as_symmetries(GROUPS["z-inf"]) == {
        "symmetries_continuous": [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]
    }


def test_the_diameter_is_the_largest_distance_between_vertices():
    box = trimesh.creation.box((3, 4, 12))
    assert bop._extent(np.asarray(box.vertices))["diameter"] == pytest.approx(13)
    flat = np.array([[0, 0, 0], [3, 0, 0], [3, 4, 0], [0, 4, 0.0]])
    assert bop._extent(flat)["diameter"] == pytest.approx(5)


def test_a_folder_without_images_or_models_is_no_bop_data_set(tmp_path):
    build(plan(tmp_path / "toy"), InlineExecutor)
    with pytest.raises(InputError, match=r"without images: choose parquet or webdataset"):
        export(tmp_path / "toy", "bop", tmp_path / "out")
    box = tmp_path / "cad" / "box"
    box.mkdir(parents=True)
    trimesh.creation.box().export(box / "a.off")
    render_dataset(
        tmp_path / "cad", tmp_path / "own", views=1, points=32,
        occluder_options={"resolution": 16, "keep_depth": True},
    )  # fmt: skip
    with pytest.raises(InputError, match=r"models of .* are not at hand: no source given"):
        export(tmp_path / "own", "bop", tmp_path / "out")
    made = plan_render(
        "pm40", tmp_path / "flat", source_options={"counts": (1, 1)}, views=1, points=32,
        occluder_options={"resolution": 16}, splits=("test",),
    )  # fmt: skip
    build(made, InlineExecutor)
    with pytest.raises(InputError, match=r"no depth images, .* render it with --keep-depth"):
        export(tmp_path / "flat", "bop", tmp_path / "out")
