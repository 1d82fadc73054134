"""The real scene at hand: five chairs, a round table and a bin. Nothing of it is stored here."""

from __future__ import annotations

import json

import numpy as np
import pytest

from partialbench.dataset.build import BuildPlan, build
from partialbench.dataset.executors import InlineExecutor
from partialbench.dataset.rows import Job
from partialbench.dataset.shards import file_sha256, read_columns
from partialbench.errors import InputError
from partialbench.geometry.rotations import is_rotation
from renderers.sources.scannet.occluder import ScanHprOccluder
from renderers.sources.scannet.show import draw_instances
from renderers.sources.scannet.source import ScanNetInstances


@pytest.fixture
def source(shared):
    data = shared / "data"
    return ScanNetInstances(data / "scannet", data / "scan2cad" / "full_annotations.json")


def shapes(source):
    return {ref.object_id: source.load(ref) for s in source.splits() for ref in source.objects(s)}


def test_chairs_and_table_are_found_and_the_bin_is_not(source):
    found = {i: s.class_name for i, s in shapes(source).items()}
    assert found == {f"scene0470_00/{i}": "table" if i == 5 else "chair" for i in range(1, 7)}
    [bin_] = source.rejected
    assert (bin_.object_id, bin_.failed) == ("scene0470_00/0", False)
    assert bin_.reason == "CAD category trash bin (02747177) is not a PS15 class"


def test_points_agree_with_the_canonical_frame(source):
    """Upright; a chair's upper part behind its middle (+y) and its seat below it; the box fits."""
    for shape in shapes(source).values():
        assert is_rotation(shape.R_scan_object, 1e-9)
        assert shape.R_scan_object[2, 2] > np.cos(np.deg2rad(6))
        assert shape.residual_m < 0.06
        inside = np.abs(shape.points - shape.box_centre) <= (
            shape.box_half_extent + 0.08 / shape.scale_m + 1e-6
        )
        assert inside.all()
        x, y, z = shape.points.T
        if shape.class_name == "chair":
            back = z > 0.6 * z.max()
            assert y[back].mean() > 0.25
            assert abs(x[back].mean()) < 0.15
            # A wrong turn would put the back at another side: it is a plate across y.
            assert np.ptp(x[back]) > 1.5 * y[back].std() * 2
            assert shape.symmetry == "none"
        else:
            assert shape.symmetry == "z-inf"
            assert (z > 0).mean() > 0.5


@pytest.mark.parametrize("viewpoints", ["uniform", "standing"])
def test_every_instance_has_ten_views_and_any_run_the_same_bytes(source, viewpoints, tmp_path):
    digests = []
    for run, workers in enumerate((1, 2)):
        seen_from = ScanNetInstances(source.scannet, source.scan2cad, viewpoints)
        job = Job(seen_from, ScanHprOccluder(), "ps15", "partial", {"train": 10}, 512, 0)
        make_executor = InlineExecutor if workers == 1 else None
        out = tmp_path / str(run)
        manifest = build(BuildPlan(job, out, ("train",)), make_executor, workers)
        ids, counts = np.unique(
            read_columns(out / "train-00000.h5", ["object_id"])["object_id"], return_counts=True
        )
        assert ids.tolist() == [f"scene0470_00/{i}".encode() for i in range(1, 7)]
        assert counts.tolist() == [10] * 6
        assert [f["object_id"] for f in manifest.failures] == ["scene0470_00/0"]
        digests.append(file_sha256(out / "train-00000.h5"))
    assert len(set(digests)) == 1


@pytest.mark.parametrize(
    ("models", "wider", "moved_m"), [("all", 6, 0), ("all", 0.5, 0), ("table", 1, 0.6)]
)
def test_a_box_that_does_not_fit_gives_nothing(source, models, wider, moved_m, tmp_path):
    """The honest boxes give six instances; the scene has no segmentation that would help."""
    entries = json.loads(source.scan2cad.read_bytes())
    if models == "table":
        entries[0]["aligned_models"] = entries[0]["aligned_models"][5:6]
    for model in entries[0]["aligned_models"]:
        model["bbox"] = [wider * half for half in model["bbox"]]
        model["trs"]["translation"][0] += moved_m
    path = tmp_path / "annotations.json"
    path.write_text(json.dumps(entries))
    with pytest.raises(InputError, match="no PS15 instance"):
        ScanNetInstances(source.scannet, path).objects("train")


def test_the_picture_is_drawn(source, tmp_path):
    draw_instances(list(shapes(source).items())[:2], tmp_path / "instances.png")
    assert (tmp_path / "instances.png").read_bytes()[:4] == b"\x89PNG"
