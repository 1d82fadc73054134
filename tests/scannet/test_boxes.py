"""A CAD's box against the points it is said to hold."""

from __future__ import annotations

import copy

import pytest

from partialbench.errors import InputError
from renderers.sources.scannet import filters
from renderers.sources.scannet.instances import SECOND
from renderers.sources.scannet.scan2cad import read_annotations
from renderers.sources.scannet.source import ScanNetInstances
from tests.scannet.scenes import CHAIR, TABLE, Thing, annotate, write_annotations, write_scene

THINGS = [
    Thing("table", TABLE, (0.8, 1.4, 0.7), (-1, 0), yaw=0.3),
    Thing("chair", CHAIR, (0.5, 0.55, 0.9), (1.2, 1.0), yaw=0.7),
    Thing("chair", CHAIR, (0.5, 0.55, 0.9), (1.2, -1.0), yaw=2.0),
]


def found(root, entries) -> tuple[list[str], dict[str, str]]:
    source = ScanNetInstances(root, write_annotations(root, entries))
    ids = [ref.object_id for split in ("train", "test") for ref in source.objects(split)]
    return ids, {r.object_id: r.reason for r in source.rejected}


@pytest.mark.parametrize("segmented", [True, False])
@pytest.mark.parametrize(
    ("wider", "moved_m", "reasons"),
    [
        (6, 0, {filters.MISFIT, filters.DISAGREEMENT}),
        (2, 0, {filters.MISFIT}),
        (0.5, 0, {filters.OUTSIDE, "no annotated object lies in the CAD's box"}),
        (1, 0.6, {filters.OUTSIDE, "no annotated object lies in the CAD's box"}),
    ],
)
def test_a_box_that_does_not_fit_is_turned_away(tmp_path, segmented, wider, moved_m, reasons):
    """The table's box is spoilt; the chairs stay."""
    entry = write_scene(tmp_path, "scene0001_00", THINGS, segmented)
    table = entry["aligned_models"][0]
    table["bbox"] = [wider * half for half in table["bbox"]]
    table["trs"]["translation"][0] += moved_m
    ids, why = found(tmp_path, [entry])
    assert ids == ["scene0001_00/1", "scene0001_00/2"]
    assert why["scene0001_00/0"] in reasons


@pytest.mark.parametrize("segmented", [True, False])
def test_an_honest_box_that_is_a_little_off_stays(tmp_path, segmented):
    entry = write_scene(tmp_path, "scene0001_00", THINGS, segmented)
    for model in entry["aligned_models"]:
        model["bbox"] = [1.1 * half for half in model["bbox"]]
        model["trs"]["translation"][0] += 0.04
    assert len(found(tmp_path, [entry])[0]) == 3


def test_touching_neighbours_do_not_count_as_cut_off(tmp_path):
    row = [Thing("chair", CHAIR, (0.5, 0.5, 0.9), (x, 0)) for x in (-0.52, 0, 0.52)]
    assert len(found(tmp_path, [write_scene(tmp_path, "scene0001_00", row)])[0]) == 3


def test_entries_of_one_scene_are_joined(tmp_path):
    """Each entry's models are placed by its own trs; the same model twice is one object."""
    entry = write_scene(tmp_path, "scene0001_00", THINGS)
    first, second = copy.deepcopy(entry), annotate("scene0001_00", THINGS[1:])
    first["aligned_models"] = first["aligned_models"][:2]
    for trs in [second["trs"], *(model["trs"] for model in second["aligned_models"])]:
        trs["translation"] = [v + 5 for v in trs["translation"]]  # the second entry's own world
    [scene] = read_annotations(write_annotations(tmp_path, [first, second]))
    assert [model.index for model in scene.models] == [0, 1, 2, 3]
    ids, why = found(tmp_path, [first, second])
    assert ids == ["scene0001_00/0", "scene0001_00/1", "scene0001_00/3"]
    assert why == {"scene0001_00/2": SECOND}


def test_a_damaged_entry_does_not_hide_the_scenes_other_one(tmp_path):
    entry = write_scene(tmp_path, "scene0001_00", THINGS)
    ids, why = found(tmp_path, [entry, {"id_scan": "scene0001_00"}])
    assert len(ids) == 3
    assert "damaged annotation of the scene" in why["scene0001_00"]


def test_rules_are_options_with_names_and_ranges(tmp_path):
    entry = write_scene(tmp_path, "scene0001_00", THINGS)
    path = write_annotations(tmp_path, [entry])
    source = ScanNetInstances(tmp_path, path, rules={"min_points": 1e5})
    with pytest.raises(InputError, match="too few points"):
        source.objects("train")
    for rules, message in (
        ({"min_point": 3}, "no rule named 'min_point'; did you mean min_points"),
        ({"max_outside": "much"}, "max_outside must be a finite number"),
        ({"attempts": 0}, "attempts must be a finite whole number of at least 1, got 0"),
        ({"min_points": 2.5}, "min_points must be a finite whole number"),
        ({"nearest_m": 3}, "must not be above farthest_m"),
    ):
        with pytest.raises(InputError, match=message):
            ScanNetInstances(tmp_path, path, rules=rules)
