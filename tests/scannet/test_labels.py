"""nyu40's numbers or ScanNet's own: decided for a labels file as a whole."""

from __future__ import annotations

import pytest

from partialbench.errors import InputError
from renderers.sources.scannet.source import ScanNetInstances
from tests.scannet.scenes import CHAIR, TABLE, Thing, relabel, write_annotations, write_scene

SCANNET_IDS = {1: 1, 2: 3, 5: 2, 7: 4, 14: 14}
"""nyu40 → ScanNet, of the label map in ``scenes``."""


@pytest.fixture
def scene(tmp_path):
    things = [
        Thing("chair", CHAIR, (0.5, 0.5, 0.9), (-1.5, 0)),
        Thing("table", TABLE, (0.7, 1.3, 0.8), (1.5, 0)),
    ]
    entry = write_scene(tmp_path, "scene0001_00", things, segmented=True)
    write_annotations(tmp_path, [entry])
    return tmp_path / "scans" / "scene0001_00"


def into_scannet_ids(scene) -> None:
    for step in (lambda new: 1000 + new, None):  # by way of numbers that nothing has
        for old, new in SCANNET_IDS.items():
            if step:
                relabel(scene, old, step(new))
            else:
                relabel(scene, 1000 + new, new)


def without_segmentation(scene) -> None:
    for path in [*scene.glob("*.segs.json"), *scene.glob("*.aggregation.json")]:
        path.unlink()


def opened(scene, **options) -> ScanNetInstances:
    root = scene.parent.parent
    return ScanNetInstances(root, root / "full_annotations.json", **options)


def classes(source) -> dict:
    refs = [ref for split in source.splits() for ref in source.objects(split)]
    return {ref.object_id: source.load(ref) for ref in refs}


@pytest.mark.parametrize("numbers", ["nyu40", "scannet"])
@pytest.mark.parametrize("segmented", [True, False])
def test_either_numbering_gives_the_same_instances(scene, numbers, segmented):
    if numbers == "scannet":
        into_scannet_ids(scene)
    if not segmented:
        without_segmentation(scene)
    source = opened(scene, viewpoints="standing")
    found = classes(source)
    assert [shape.class_name for shape in found.values()] == ["chair", "table"]
    assert all(abs(shape.floor_z) < 1e-6 for shape in found.values())
    by = "aggregation" if segmented else numbers
    assert source.notes()["scene0001_00"]["labels"] == by
    assert source.describe()["labels_read_by"] == {by: 1}
    assert f"1 by {by}" in source.listing


def test_one_aligned_object_tells_where_no_floor_does(scene):
    into_scannet_ids(scene)
    without_segmentation(scene)
    relabel(scene, SCANNET_IDS[2], 0)
    source = opened(scene)
    assert [shape.class_name for shape in classes(source).values()] == ["chair", "table"]
    assert source.notes()["scene0001_00"]["labels"] == "scannet"


def test_a_numbering_can_be_said(scene):
    without_segmentation(scene)
    with pytest.raises(InputError, match="no PS15 instance"):
        opened(scene, labels="scannet").objects("train")
    assert (
        opened(scene, labels="nyu40").counts()["train"]["chair"]
        + (opened(scene, labels="nyu40").counts()["test"]["chair"])
        == 1
    )
    with pytest.raises(InputError, match="'raw' is not one of auto, nyu40, scannet"):
        opened(scene, labels="raw")


def test_a_label_that_is_no_whole_number_is_refused(scene):
    without_segmentation(scene)
    path = scene / "scene0001_00_vh_clean_2.labels.ply"
    text = path.read_text().replace("property ushort label", "property float label")
    path.write_text(text.replace(" 5\n", " 5.5\n", 1))
    with pytest.raises(InputError, match=r"labels\.ply: a label is no whole number: 5\.5"):
        opened(scene).objects("train")


def test_names_that_the_map_lacks_are_noted(scene):
    path = scene / "scene0001_00.aggregation.json"
    path.write_text(path.read_text().replace('"table"', '"escritoire"'))
    source = opened(scene)
    assert list(source.notes()["scene0001_00"]["labels_unknown"]) == ["escritoire"]
