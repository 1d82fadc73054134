"""From options to a plan, and the eight real files through the whole pipeline."""

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from partialbench.cli import app
from partialbench.cli.data import _then
from partialbench.dataset.build import build
from partialbench.dataset.executors import InlineExecutor
from partialbench.dataset.loader import ShardDataset
from partialbench.dataset.render import plan_render, source_of
from partialbench.dataset.settings import SETTINGS
from partialbench.dataset.sources import RejectedObject
from partialbench.dataset.verify import verify
from partialbench.errors import InputError
from partialbench.geometry.camera import Camera
from tests.dataset import toy

CAMERA = Camera(np.array([[150.0, 0, 80], [0, 150, 60], [0, 0, 1]]), 160, 120)
SMALL = {"views": 1, "points": 128, "source_options": {"counts": (1, 1)}}


def test_the_papers_numbers_are_the_defaults(tmp_path):
    plan = plan_render("pm40", tmp_path)
    assert plan.job.views == {"train": 10, "test": 1}
    assert plan.job.points == 2048
    assert plan.job.dataset_id == "pm40-parametric"
    assert plan.job.occluder.describe()["resolution"] == 256


@pytest.mark.parametrize(
    ("data_set", "options", "message"),
    [
        ("pm40", {"source": "rooms", "source_options": {"rooms": 1}}, "makes ps15-rooms, not pm40"),
        ("pm41", {}, "no data set 'pm41'; did you mean pm40"),
        ("pm40", {"setting": "upside"}, "setting 'upside' is not one of partial, partial-z"),
        ("pm40", {"setting": "partial-z", "normals": True}, "frame, to which normals belong"),
        (
            "pm40",
            {"setting": "partial-aligned", "occluder_options": {"keep_depth": True}},
            "to which depth images belong",
        ),
        ("pm40", {"splits": ("val",)}, "no split 'val'"),
        ("pm40", {"occluder_options": {"radius": 3.0}}, "radius=3.0 does not apply"),
        ("pm40", {"sensor": "kinekt"}, "did you mean kinect-v1"),
        ("pm40", {"points": 0}, "points must be at least 1, got 0"),
        (
            "pm40",
            {"splits": "test", "views": 5},
            "views=5 would have no effect.*only the split test",
        ),
        (
            "pm40",
            {"occluder_options": {"camera": CAMERA, "resolution": 64}},
            "resolution=64 would have no effect.*160×120 pixels",
        ),
        (
            "ps15",
            {"min_visible": 5, "source_options": {"rules": {"min_visible": 10}}},
            "min_visible is 5 and the rule min_visible is 10",
        ),
    ],
)
def test_what_cannot_be_is_refused(tmp_path, data_set, options, message, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    if options.get("source") == "rooms":
        pytest.importorskip("open3d", exc_type=ImportError)
    with pytest.raises(InputError, match=message):
        plan_render(data_set, tmp_path / "out", **options)


@pytest.mark.parametrize("setting", SETTINGS)
def test_every_setting_renders_and_verifies(tmp_path, setting):
    plan = plan_render("pm40", tmp_path, setting=setting, splits=("test",), **SMALL)
    manifest = build(plan, InlineExecutor)
    assert manifest.configuration["setting"] == setting
    report = verify(tmp_path, source_of(tmp_path)[0])
    assert report.problems == []
    assert report.rows == {"test": 40}
    assert report.surface["max"] < 1e-4


@pytest.fixture
def lying(tmp_path):
    """A folder of meshes with y up, aligned, and the data made of it."""
    tree, out = tmp_path / "meshes", tmp_path / "data"
    for split in ("train", "test"):
        (tree / "crate" / split).mkdir(parents=True)
        trimesh.creation.box((1, 2, 3)).export(tree / "crate" / split / "one.off")
    plan = plan_render("pm40", out, source=str(tree), views=1, points=64,
                       source_options={"up": "y", "aligned": True},
                       occluder_options={"resolution": 32})  # fmt: skip
    build(plan, InlineExecutor)
    return tree, out


def test_a_source_is_opened_as_the_manifest_says(lying):
    tree, out = lying
    source, missing = source_of(out, str(tree))
    assert (source.up, source.frame, missing) == ("y", "aligned", "")
    report = verify(out, source)
    assert report.problems == []
    assert report.surface["max"] < 1e-4


def test_another_source_is_told_and_judges_nothing(lying):
    tree, out = lying
    (tree / "crate" / "train" / "one.off").rename(tree / "crate" / "train" / "two.off")
    run = CliRunner().invoke(app, ["verify", str(out), "--source", str(tree)])
    assert run.exit_code == 0
    assert "is sound: 1 train rows, 1 test rows" in run.stdout
    noted = " ".join(run.stderr.split())
    assert "surface not checked: the source is not what the folder was made from" in noted
    assert "listing_sha256: folder has" in noted


def test_the_closing_message_names_what_makes_a_mended_input(tmp_path):
    tree, out = tmp_path / "meshes", tmp_path / "data"
    for split in ("train", "test"):
        (tree / "crate" / split).mkdir(parents=True)
        trimesh.creation.box((1, 2, 3)).export(tree / "crate" / split / "one.off")
    (tree / "crate" / "train" / "two.off").write_text("OFF\n8 12 0\n0 0 0\n")
    command = ["render", "pm40", "--source", str(tree), "--out", str(out), "--views", "1",
               "--points", "64", "--resolution", "32", "--workers", "1"]  # fmt: skip
    run = CliRunner().invoke(app, command)
    assert run.exit_code == 1
    assert "with --retry-failed" in str(run.exception)
    trimesh.creation.box((1, 1, 3)).export(tree / "crate" / "train" / "two.off")
    assert CliRunner().invoke(app, command).exit_code == 1
    run = CliRunner().invoke(app, [*command, "--retry-failed"])
    assert run.exit_code == 0
    assert "2 train rows" in run.stdout


def test_what_could_not_be_listed_needs_a_new_folder(tmp_path):
    lost = RejectedObject("scene0001_00", "train", "damaged PLY", failed=True)
    manifest = build(toy.plan(tmp_path, source=toy.ToySource(rejected=[lost])), InlineExecutor)
    assert "a new folder, as 1 of them could not be listed" in _then(manifest)


def test_shapes_of_another_generation_leave_the_digests_to_check(tmp_path, monkeypatch):
    build(plan_render("pm40", tmp_path, setting="aligned", splits=("test",), **SMALL),
          InlineExecutor)  # fmt: skip
    monkeypatch.setattr("renderers.shapes.source.GENERATION", 99)
    for named in (None, "parametric"):
        source, missing = source_of(tmp_path, named)
        assert source is None
        assert "this release makes generation 99" in missing
    report = verify(tmp_path, source, no_source=missing)
    assert report.sound
    assert report.notes == [f"surface not checked: {missing}"]


def test_noise_moves_points_off_the_surface_and_is_said(tmp_path):
    plan = plan_render("pm40", tmp_path, sensor="kinect-v1", splits=("test",),
                       occluder_options={"resolution": 96}, **SMALL)  # fmt: skip
    build(plan, InlineExecutor)
    report = verify(tmp_path, source_of(tmp_path)[0])
    assert report.sound
    assert report.surface["mean"] > 1e-4
    assert "the sensor is noisy" in report.notes[0]


def test_a_fixed_camera_may_cut_objects(tmp_path):
    plan = plan_render("pm40", tmp_path, occluder_options={"camera": CAMERA}, splits=("test",),
                       **SMALL)  # fmt: skip
    manifest = build(plan, InlineExecutor)
    reasons = {f["reason"] for f in manifest.failures}
    assert reasons <= {"no surface at any pixel centre", "too few points"}
    assert verify(tmp_path, source_of(tmp_path)[0]).sound


@pytest.mark.data
def test_the_eight_real_files_render_and_verify(shared, tmp_path):
    tree = shared / "data" / "ModelNet40"
    plan = plan_render("pm40", tmp_path, source=str(tree), views=3, points=512)
    manifest = build(plan, InlineExecutor)
    assert manifest.failures == []
    assert (manifest.rows("train"), manifest.rows("test")) == (21, 1)
    report = verify(tmp_path, source_of(tmp_path, str(tree))[0])
    assert report.problems == []
    assert report.surface["max"] < 1e-4


def test_another_sensor_sees_the_same_views_and_the_folder_says_which(tmp_path):
    """So that a trained model's curve against noise has one cause only."""
    made = {}
    for sensor in ("ideal", "kinect-v1:2"):
        plan = plan_render(
            "pm40", tmp_path / sensor.replace(":", "-"), sensor=sensor, splits=("test",),
            source_options={"counts": (1, 1)}, points=32, occluder_options={"resolution": 48},
        )  # fmt: skip
        build(plan, InlineExecutor)
        made[sensor] = ShardDataset(plan.out, "test", 32)
    exact, noisy = made.values()
    assert (exact.sensor, noisy.sensor) == ("", "kinect-v1:2")
    np.testing.assert_array_equal(noisy.object_ids, exact.object_ids)
    np.testing.assert_array_equal(noisy.rotations, exact.rotations)
    assert noisy.digest != exact.digest
