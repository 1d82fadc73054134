from __future__ import annotations

import json
import pickle

import numpy as np
import pytest

from partialbench.dataset.categories import PS15
from partialbench.dataset.seeding import generator
from partialbench.dataset.sources import RejectedView, View
from partialbench.errors import InputError
from partialbench.geometry.rotations import geodesic_angle
from renderers.sources.open import open_source as opened
from renderers.sources.scannet import filters
from renderers.sources.scannet.filters import Rules
from renderers.sources.scannet.instances import SECOND
from renderers.sources.scannet.occluder import ScanHprOccluder
from renderers.sources.scannet.reader import NO_PLACE, SceneReader
from renderers.sources.scannet.source import ScanNetInstances, counts_table
from tests.scannet.scenes import (
    CHAIR,
    PRINTER,
    TABLE,
    Thing,
    annotate,
    relabel,
    write_annotations,
    write_scene,
)


def open_source(root, **options) -> ScanNetInstances:
    return ScanNetInstances(root, root / "full_annotations.json", **options)


def everything(source) -> dict:
    """Object id → shape, over both splits."""
    return {r.object_id: source.load(r) for s in source.splits() for r in source.objects(s)}


def reasons(source) -> dict[str, str]:
    return {r.object_id: r.reason for r in source.rejected}


def rngs(count: int = 10) -> list[np.random.Generator]:
    return [generator(0, "test", i) for i in range(count)]


@pytest.mark.parametrize("segmented", [False, True])
def test_instances_come_out_with_class_pose_and_points(tmp_path, things, segmented):
    write_annotations(tmp_path, [write_scene(tmp_path, "scene0001_00", things, segmented)])
    source = open_source(tmp_path)
    found = everything(source)
    assert list(found) == ["scene0001_00/0", "scene0001_00/1", "scene0001_00/2"]
    assert [s.class_name for s in found.values()] == ["chair", "chair", "table"]
    assert [s.symmetry for s in found.values()] == ["none", "none", "z-180"]
    assert reasons(source) == {
        "scene0001_00/3": "CAD category trash bin (02747177) is not a PS15 class"
    }
    for thing, shape in zip(things, found.values(), strict=False):
        assert geodesic_angle(shape.R_scan_object, thing.R()) < 1e-6
        truth = thing.mesh().vertices
        radius = np.linalg.norm(np.array(thing.size) / 2)
        assert shape.scale_m == pytest.approx(radius, rel=1e-5)
        # Every vertex of the thing and no other, back where it was in the scan.
        back = shape.points * shape.scale_m @ shape.R_scan_object.T + shape.origin
        assert len(back) == len(truth)
        order, wanted = np.lexsort(back.round(4).T), np.lexsort(truth.round(4).T)
        np.testing.assert_allclose(back[order], truth[wanted], atol=2e-5)
        assert np.abs(shape.points.max(axis=0) + shape.points.min(axis=0)).max() < 1e-6
        assert np.linalg.norm(shape.points, axis=1).max() == pytest.approx(1, abs=1e-6)
        assert shape.residual_m < 0.03
        # The thing's back is at canonical +y.
        assert shape.points[shape.points[:, 2] > 0.5 * shape.points[:, 2].max(), 1].min() > 0
        normal = shape.normals[np.isclose(shape.points[:, 2], shape.points[:, 2].max())]
        assert (normal[:, 2] > 0).all()


def test_labels_alone_tell_a_desk_from_a_table(tmp_path):
    things = [
        Thing("desk", TABLE, (0.7, 1.3, 0.8), (-1.5, 0)),
        Thing("table", TABLE, (0.7, 1.3, 0.8), (1.5, 0)),
        Thing("printer", PRINTER, (0.5, 0.5, 0.5), (0, 2)),
    ]
    write_annotations(tmp_path, [write_scene(tmp_path, "scene0001_00", things)])
    classes = [s.class_name for s in everything(open_source(tmp_path)).values()]
    assert classes == ["desk", "table", "printer"]


@pytest.mark.parametrize("segmented", [False, True])
def test_a_label_that_disagrees_is_turned_away(tmp_path, segmented):
    things = [
        Thing("chair", TABLE, (0.5, 0.5, 0.9), (-1.5, 0)),
        Thing("chair", CHAIR, (0.5, 0.5, 0.9), (1.5, 0)),
    ]
    write_annotations(tmp_path, [write_scene(tmp_path, "scene0001_00", things, segmented)])
    source = open_source(tmp_path)
    assert reasons(source) == {"scene0001_00/0": filters.DISAGREEMENT}


def test_touching_chairs_are_parted(tmp_path):
    """Neighbours whose boxes overlap by the margin share no vertex."""
    things = [
        Thing("chair", CHAIR, (0.5, 0.5, 0.9), (-0.26, 0)),
        Thing("chair", CHAIR, (0.5, 0.5, 0.9), (0.26, 0), yaw=np.pi),
    ]
    write_annotations(tmp_path, [write_scene(tmp_path, "scene0001_00", things)])
    for thing, shape in zip(things, everything(open_source(tmp_path)).values(), strict=True):
        assert len(shape.points) == len(thing.mesh().vertices)


@pytest.mark.parametrize("segmented", [False, True])
def test_two_models_on_one_object_give_one_instance(tmp_path, segmented):
    chair = Thing("chair", CHAIR, (0.5, 0.5, 0.9), (0, 0))
    off = Thing("chair", CHAIR, (0.5, 0.5, 0.9), (0.1, 0.05))
    write_scene(tmp_path, "scene0001_00", [chair], segmented)
    write_annotations(tmp_path, [annotate("scene0001_00", [off, chair, off])])
    source = open_source(tmp_path)
    [(object_id, shape)] = everything(source).items()
    assert object_id == "scene0001_00/1"
    assert len(shape.points) == len(chair.mesh().vertices)
    assert reasons(source) == {f"scene0001_00/{i}": SECOND for i in (0, 2)}


def test_an_object_that_spills_out_of_its_box_is_turned_away(tmp_path):
    chair = Thing("chair", CHAIR, (0.9, 0.9, 0.9), (0, 0))
    small = Thing("chair", CHAIR, (0.9, 0.9, 0.55), (0, 0))
    other = Thing("chair", CHAIR, (0.5, 0.5, 0.9), (2, 0))
    write_scene(tmp_path, "scene0001_00", [chair, other], segmented=True)
    write_annotations(tmp_path, [annotate("scene0001_00", [small, other])])
    source = open_source(tmp_path, rules=Rules(max_outside=0.1))
    assert reasons(source) == {"scene0001_00/0": filters.OUTSIDE}


def test_small_objects_are_turned_away(tmp_path, things):
    things[1].detail = 2  # 196 vertices
    write_annotations(tmp_path, [write_scene(tmp_path, "scene0001_00", things, segmented=True)])
    source = open_source(tmp_path)
    assert list(everything(source)) == ["scene0001_00/0", "scene0001_00/2"]
    [small] = [r for r in source.rejected if r.reason == filters.FEW_POINTS]
    assert small.details == {"points": 196, "minimum": 256}


def test_unknown_and_damaged_models_spare_the_rest(tmp_path, things):
    things[0].overrides = {"catid_cad": "99999999"}
    things[1].overrides = {"sym": "?"}
    write_annotations(tmp_path, [write_scene(tmp_path, "scene0001_00", things)])
    source = open_source(tmp_path)
    assert list(everything(source)) == ["scene0001_00/2"]
    assert reasons(source)["scene0001_00/0"] == "unknown CAD category '99999999'"
    assert reasons(source)["scene0001_00/1"].startswith("damaged annotation")
    # What is damaged is a failure, what the data set does not have is none.
    assert [r.object_id for r in source.rejected if r.failed] == ["scene0001_00/1"]


def test_a_bad_scene_never_ends_the_run(tmp_path, things):
    entries = [write_scene(tmp_path, f"scene000{i}_00", things) for i in (1, 2, 3, 4)]
    entries = [e for e in entries if e["id_scan"] != "scene0003_00"]
    entries += [{"id_scan": "scene0005_00"}, {**entries[0], "id_scan": "scene0006_00"}]
    (tmp_path / "scans" / "scene0005_00").mkdir()
    (tmp_path / "scans" / "scene0002_00" / "scene0002_00_vh_clean_2.ply").unlink()
    (tmp_path / "scans" / "scene0004_00" / "scene0004_00_vh_clean_2.labels.ply").write_text("ply\n")
    write_annotations(tmp_path, entries)
    source = open_source(tmp_path)
    assert len(everything(source)) == 3
    by_scene = {r.object_id: r for r in source.rejected}
    assert by_scene["scene0003_00"].reason == "the scene has no annotation"
    assert by_scene["scene0006_00"].reason == "the annotated scene is not in the ScanNet folder"
    assert "is missing" in by_scene["scene0002_00"].reason
    assert "damaged PLY" in by_scene["scene0004_00"].reason
    assert "damaged annotation" in by_scene["scene0005_00"].reason
    failed = {scene for scene, r in by_scene.items() if r.failed}
    assert failed == {"scene0002_00", "scene0004_00", "scene0005_00"}


@pytest.mark.parametrize("kind", ["", ".labels"])
def test_a_face_without_its_vertex_is_one_scenes_failure(tmp_path, things, kind):
    entries = [write_scene(tmp_path, f"scene000{i}_00", things) for i in (1, 2)]
    write_annotations(tmp_path, entries)
    path = tmp_path / "scans" / "scene0002_00" / f"scene0002_00_vh_clean_2{kind}.ply"
    head, _, last = path.read_text().rstrip().rpartition("\n")
    path.write_text(f"{head}\n3 0 1 999999\n")
    assert last.startswith("3 ")
    source = open_source(tmp_path)
    assert {r.location for s in source.splits() for r in source.objects(s)} == {"scene0001_00"}
    [failed] = [r for r in source.rejected if r.failed]
    assert failed.object_id == "scene0002_00"
    assert "a face names vertex 999999" in failed.reason


def test_an_unforeseen_error_is_one_scenes_failure(tmp_path, things, monkeypatch):
    entries = [write_scene(tmp_path, f"scene000{i}_00", things) for i in (1, 2)]
    write_annotations(tmp_path, entries)
    read = SceneReader.read

    def stumble(self, annotation):
        if annotation.scene_id == "scene0002_00":
            raise IndexError("index 7 is out of bounds")
        return read(self, annotation)

    monkeypatch.setattr(SceneReader, "read", stumble)
    [failed] = [r for r in open_source(tmp_path).rejected if r.failed]
    assert failed.reason == "IndexError: index 7 is out of bounds"


def test_more_scenes_are_another_source(tmp_path, things):
    """A folder of the first ones must not be continued, nor pass for one of all."""
    entries = [write_scene(tmp_path, f"scene000{i}_00", things) for i in (1, 2)]
    write_annotations(tmp_path, entries)
    (tmp_path / "scans" / "scene0002_00").rename(tmp_path / "later")
    before = open_source(tmp_path).describe()
    (tmp_path / "later").rename(tmp_path / "scans" / "scene0002_00")
    after = open_source(tmp_path).describe()
    assert before["scenes"] == after["scenes"]
    assert before != after
    assert open_source(tmp_path).describe() == after


def test_nothing_at_all_is_an_error_that_says_why(scannet):
    (scannet / "scans" / "scene0001_00" / "scene0001_00_vh_clean_2.ply").unlink()
    with pytest.raises(InputError, match=r"no PS15 instance.*vh_clean_2\.ply is missing"):
        open_source(scannet).objects("train")


def test_wrong_arguments(scannet):
    with pytest.raises(InputError, match="'sitting' is not one of uniform, standing"):
        open_source(scannet, viewpoints="sitting")
    with pytest.raises(InputError, match="is no folder"):
        ScanNetInstances(scannet / "absent", scannet / "full_annotations.json")


def test_rescans_of_one_space_are_in_one_split_and_four_of_five_train(scannet):
    source = open_source(scannet)
    splits = [source.split_of(f"scene{i:04d}_00") for i in range(1000)]
    assert splits == [source.split_of(f"scene{i:04d}_03") for i in range(1000)]
    assert 0.75 < splits.count("train") / 1000 < 0.85


def test_a_split_file_decides(tmp_path, things):
    entries = [write_scene(tmp_path, f"scene000{i}_0{i}", things) for i in (1, 2, 3)]
    write_annotations(tmp_path, entries)
    path = tmp_path / "split.json"
    path.write_text(json.dumps({"train": ["scene0001"], "test": ["scene0002_02"]}))
    source = open_source(tmp_path, split_file=path)
    assert {r.location for r in source.objects("train")} == {"scene0001_01"}
    assert {r.location for r in source.objects("test")} == {"scene0002_02"}
    assert source.counts()["train"]["chair"] == 2
    assert "| all | 3 | 3 |" in counts_table(source.counts())
    assert "22,670 | 5,650" in counts_table(source.counts())
    path.write_text(json.dumps({"train": ["scene0001"], "test": ["scene0001"]}))
    with pytest.raises(InputError, match="scene0001 and scene0001: the scans of one space"):
        open_source(tmp_path, split_file=path)
    path.write_text("[]")
    with pytest.raises(InputError, match="expected JSON"):
        open_source(tmp_path, split_file=path)


def test_a_copy_in_a_worker_gives_the_same_bits(scannet):
    source = open_source(scannet)
    copy = pickle.loads(pickle.dumps(source))
    assert len(pickle.dumps(source)) < 5_000  # paths, not annotations
    for ref in source.objects(source.splits()[0]):
        a, b = source.load(ref), copy.load(ref)
        assert a.points.tobytes() == b.points.tobytes()
        assert source.digest(ref) == copy.digest(ref)
        for (R, t), (R2, t2) in zip(source.poses(a, rngs()), copy.poses(b, rngs()), strict=True):
            assert (R.tobytes(), t.tobytes()) == (R2.tobytes(), t2.tobytes())


def test_the_digest_follows_the_files_and_the_annotation(scannet, things):
    ref = open_source(scannet).objects("train")[0]
    before = open_source(scannet).digest(ref)
    things[0].yaw += 0.01
    write_annotations(scannet, [annotate("scene0001_00", things)])
    assert open_source(scannet).digest(ref) != before


def test_poses_are_cameras_in_the_scan(scannet):
    """Standing: brought to the scan frame, the camera is at eye height and upright."""
    source = open_source(scannet, viewpoints="standing")
    for shape in everything(source).values():
        for R, t in source.poses(shape, rngs()):
            position = shape.R_scan_object @ (-R.T @ t) * shape.scale_m + shape.origin
            assert 1.2 <= position[2] - shape.floor_z <= 1.8
            R_camera_scan = R @ shape.R_scan_object.T
            assert R_camera_scan[1, 2] < -0.4
            assert t[2] > 1  # the unit ball lies in front of the camera
            assert np.linalg.norm(t) < 12


def test_uniform_poses_are_the_papers(scannet):
    source = open_source(scannet, viewpoints="uniform")
    shape = next(iter(everything(source).values()))
    R, t = (np.stack(x) for x in zip(*source.poses(shape, rngs(300)), strict=True))
    assert (np.abs(t[:, :2]) <= 2).all()
    assert ((t[:, 2] >= 2) & (t[:, 2] <= 5)).all()
    assert np.abs(R.mean(axis=0)).max() < 0.15  # Haar: every entry has mean 0


def test_a_description_opens_the_same_source_again(scannet):
    path = scannet / "split.json"
    path.write_text(json.dumps({"train": ["scene0001"], "test": []}))
    described = open_source(
        scannet, split_file=path, viewpoints="uniform", labels="nyu40", rules={"min_points": 200}
    ).describe()
    where = {"scannet": scannet, "scan2cad": scannet / "full_annotations.json"}
    path.unlink()
    again = opened("scannet", described=described, **where)
    assert again.describe() == described
    assert opened("scannet", described=described, viewpoints="standing", **where).viewpoints == (
        "standing"
    )


def test_where_nobody_can_stand_the_object_is_recorded(scannet):
    relabel(scannet / "scans" / "scene0001_00", 2, 1)  # the floor becomes wall
    with pytest.raises(InputError, match=NO_PLACE):
        open_source(scannet, viewpoints="standing").objects("train")
    assert len(everything(open_source(scannet))) == 3


def test_views_show_what_a_camera_in_the_room_would_see(scannet, things):
    """Kept points are the instance's own in the camera frame, and agree with ray casting.

    The oracle works in the scan frame: a vertex is seen when the segment from the camera to just
    before it meets neither of the thing's two boxes (slab method). Hidden point removal is not ray
    casting: nine in ten of its points are truly seen, and it keeps three in four of those that
    are; a camera at the wrong place gives about half.
    """
    source = open_source(scannet, viewpoints="standing")
    shape = source.load(source.objects("train")[0])
    thing, poses = things[0], source.poses(shape, rngs())
    # A radius for few points: the things' are far apart for how thin their backs are.
    views = ScanHprOccluder(1.75, rules=Rules(max_back_facing=1)).views(shape, poses, rngs())
    assert len(views) == 10
    for (R, t), view in zip(poses, views, strict=True):
        assert isinstance(view, View)
        assert view.n_visible == len(view.points)
        distinct = len(np.unique(shape.points, axis=0))
        assert view.visible_fraction == pytest.approx(view.n_visible / distinct)
        assert view.symmetry == "none"
        back = (view.points - t) @ R
        distance = np.linalg.norm(shape.points[None] - back[:, None], axis=2)
        assert distance.min(axis=1).max() < 1e-5
        kept = np.zeros(len(shape.points), bool)
        kept[distance.argmin(axis=1)] = True

        def local(points, shape=shape):
            in_scan = points * shape.scale_m @ shape.R_scan_object.T + shape.origin
            return (in_scan - thing.centre()) @ thing.R()

        visible = ~hidden_by_boxes(local(shape.points), local(-R.T @ t), thing.size)
        assert visible[kept].mean() > 0.9
        assert kept[visible].mean() > 0.75


def hidden_by_boxes(points: np.ndarray, camera: np.ndarray, size) -> np.ndarray:
    """Whether the way from the camera to each point (n,3) leads through the seat or the back."""
    x, y, z = size
    boxes = [((0, 0, -z / 4), (x, y, z / 2)), ((0, 0.45 * y, 0), (x, y / 10, z))]
    way = points - camera
    hidden = np.zeros(len(points), bool)
    for centre, extent in boxes:
        ends = np.stack([np.array(centre) - np.array(extent) / 2 - camera,
                         np.array(centre) + np.array(extent) / 2 - camera])  # fmt: skip
        times = ends[:, None] / way
        enter, leave = times.min(axis=0).max(axis=1), times.max(axis=0).min(axis=1)
        hidden |= (enter < np.minimum(leave, 1) - 1e-3) & (leave > 0)
    return hidden


def test_a_view_from_below_is_rejected_by_rule(scannet):
    source = open_source(scannet, viewpoints="standing")
    shape = source.load(source.objects("train")[0])
    flipped = shape.__class__(**{**shape.__dict__, "normals": -shape.normals})
    poses = source.poses(shape, rngs(3))
    views = ScanHprOccluder().views(flipped, poses, rngs(3))
    assert {v.reason for v in views if isinstance(v, RejectedView)} == {filters.BACK_FACING}
    assert len([v for v in views if isinstance(v, RejectedView)]) == 3


def test_the_class_list_is_ps15(scannet):
    source = open_source(scannet)
    assert source.class_names == PS15
    assert source.describe()["name"] == "scannet"
    assert json.dumps(source.describe())
    assert str(scannet) not in json.dumps(source.describe())
