"""Pages of samples: what they hold, and that picture and page show the same view."""

from __future__ import annotations

import base64
import json
import re

import numpy as np
import pytest

from partialbench.dataset import show as shown
from partialbench.dataset.build import build
from partialbench.dataset.executors import InlineExecutor
from partialbench.dataset.loader import ShardDataset
from partialbench.dataset.render import plan_render
from partialbench.dataset.samples import packed, projected, scenes
from partialbench.dataset.whole import whole_objects


@pytest.fixture(scope="module", params=[False, True], ids=["clouds", "depth"])
def folder(request, tmp_path_factory):
    out = tmp_path_factory.mktemp("show") / "data"
    occluder = {"resolution": 32, "keep_depth": request.param}
    plan = plan_render(
        "pm40", out, source_options={"counts": (1, 0)}, occluder_options=occluder, views=1,
        points=64, objects_per_class=1,
    )  # fmt: skip
    build(plan, InlineExecutor)
    return out


def test_a_page_is_small_titled_and_asks_nobody(folder, tmp_path):
    page = shown.show(folder, tmp_path / "page.html", samples=24)
    text = page.read_text(encoding="utf-8")
    assert page.stat().st_size < 1_000_000
    assert '<html lang="en">' in text
    assert "<title>pm40-parametric · train · partial: samples</title>" in text
    assert 'name="viewport"' in text
    assert not re.search(r'(?:src|href)="(?!data:)', text)
    assert "@" not in re.sub(r"@media", "", text.split('id="samples">')[0])
    samples = json.loads(re.search(r'id="samples">(.*?)</script>', text, re.S)[1])
    assert len(samples) == 24
    for sample in samples:
        assert len(base64.b64decode(sample["points"])) == 3 * 64
        assert len(base64.b64decode(sample["whole"])) == 3 * shown.WHOLE_POINTS
        assert sample["depth"].startswith("data:image/png;base64,")
    assert text == shown.show(folder, tmp_path / "again.html", samples=24).read_text("utf-8")


def test_the_cloud_lies_on_the_whole_object_and_the_camera_before_it(folder):
    data = ShardDataset(folder, "train", 64)
    for scene in scenes(data, [0, 5], 4_000):
        gaps = np.linalg.norm(scene.points[:, None] - scene.whole, axis=2).min(axis=1)
        assert np.median(gaps) < 0.05
        apex = scene.camera[0, 0]
        # The camera frame's z runs from the camera to the object.
        assert apex[2] < -1
        np.testing.assert_allclose(np.linalg.norm(scene.axes, axis=1), 1)
        assert max(np.linalg.norm(scene.points, axis=1).max(), 0.5) <= 1


def test_an_object_without_a_source_at_hand_has_no_whole(folder):
    names = ShardDataset(folder, "train", 1).object_ids[:2].tolist()
    found = whole_objects(folder, "train", [*names, "no such object"], 10)
    assert {name: points.shape for name, points in found.items()} == dict.fromkeys(names, (10, 3))


def test_picture_and_page_see_a_scene_from_the_same_side():
    script = (shown.Path(shown.__file__).parent / "viewer.js").read_text()
    assert "const u = cy * x + sy * z, w = -sy * x + cy * z;" in script
    assert "cp * y - sp * w" in script
    # By hand: z turns to the right by the yaw, then the rest of it down by the pitch.
    np.testing.assert_allclose(
        projected(np.array([0, 0, 1.0]), np.pi / 2, 0.3), [1, 0, 0], atol=1e-9
    )
    np.testing.assert_allclose(
        projected(np.array([0, 0, 1.0]), 0, np.pi / 2), [0, -1, 0], atol=1e-9
    )
    page = shown.page_of("x", [])
    assert f'"{shown.YAW} {shown.PITCH}"' in page


def test_packed_points_are_kept_to_a_hundredth():
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    back = (np.frombuffer(base64.b64decode(packed(points)), np.uint8).reshape(-1, 3) - 128.0) / 100
    assert np.abs(back - points).max() <= 0.005 + 1e-9


def test_a_depth_image_of_points_has_the_nearest_of_each_pixel():
    centre = np.array([0.0, 0, 3])
    cloud = np.array([[0, 0, 2.5], [0, 0, 3.5], [0.5, 0, 3.0]])
    image = shown.splat(cloud, centre)
    middle = image.shape[0] // 2
    assert image[middle, middle] == 2.5
    assert sorted(image[image > 0]) == [2.5, 3.0]
    right = np.argwhere(image == 3.0)[0]
    assert right[1] > middle
