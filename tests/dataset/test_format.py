"""What a shard holds and what stands beside it: both formats, normals, depth images, objects."""

import json
import re
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from partialbench.dataset import manifest as manifests
from partialbench.dataset import objects
from partialbench.dataset.build import build
from partialbench.dataset.card import HPR_MEASURED, visibility_lines
from partialbench.dataset.executors import InlineExecutor
from partialbench.dataset.loader import ShardDataset
from partialbench.dataset.schema import FIELDS, OBJECT_ID_BYTES
from partialbench.dataset.seeding import generator
from partialbench.dataset.show import show
from partialbench.dataset.sources import View
from partialbench.dataset.verify import verify
from partialbench.errors import ConfigurationMismatchError, InputError
from tests.dataset.toy import ToyOccluder, ToySource, plan

FORMAT_1 = Path(__file__).parent / "format_1"
DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    """A folder with normals and depth images."""
    out = tmp_path_factory.mktemp("full")
    build(plan(out, occluder=ToyOccluder(normals=True, depth=8)), InlineExecutor)
    return out


def test_a_folder_of_format_1_is_read_verified_and_shown(tmp_path):
    data = ShardDataset(FORMAT_1, "train", 16)
    assert data.object_ids.tolist() == ["dresser_0000"] * 2 + ["bottle_0001"] * 2
    assert data.source_digests.tolist() == ["0" * 64] * 4
    assert not data.has_normals
    with h5py.File(FORMAT_1 / "train-00000.h5") as shard:
        assert np.array_equal(data.points([3, 0]), shard["points"][()][[3, 0]])
    assert verify(FORMAT_1).problems == []
    assert show(FORMAT_1, tmp_path / "page.png", samples=2).stat().st_size > 1000


def test_a_folder_of_format_1_is_not_continued(tmp_path):
    folder = tmp_path / "old"
    shutil.copytree(FORMAT_1, folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(ConfigurationMismatchError, match=r"in format 1 .* but not continued"):
        build(plan(folder, source=ToySource(2), points=16), InlineExecutor)
    after = {path.name: path.read_bytes() for path in folder.iterdir() if path.name != ".lock"}
    assert after == before


def test_a_shard_holds_rows_and_nothing_else(full):
    # Occluders alone are not of this folder.
    names = {field.name for field in FIELDS} - {"occluded_fraction"}
    for path in full.glob("*.h5"):
        with h5py.File(path) as shard:
            assert set(shard) == names
            assert {len(shard[name]) for name in shard} == {len(shard["label"])}


def test_hugging_face_datasets_opens_a_shard_as_it_is(full, tmp_path):
    datasets = pytest.importorskip("datasets")
    rows = datasets.load_dataset(
        "hdf5", data_files=str(full / "train-00000.h5"), cache_dir=str(tmp_path), split="train"
    ).with_format("numpy")
    mine = ShardDataset(full, "train", 64)
    first, again = mine.points_and_normals([4])
    np.testing.assert_array_equal(rows[4]["points"], first[0])
    np.testing.assert_array_equal(rows[4]["normals"], again[0])
    assert rows[4]["label"] == mine.labels[4]


def test_what_is_kept_beside_the_points_changes_neither_them_nor_the_digest(full, tmp_path):
    manifest = build(plan(tmp_path), InlineExecutor)
    plain, rich = ShardDataset(tmp_path, "train", 64), ShardDataset(full, "train", 64)
    every = np.arange(len(plain))
    np.testing.assert_array_equal(plain.points(every), rich.points(every))
    assert manifest.digests == rich.manifest.digests
    with pytest.raises(InputError, match="no normals; render it with --normals"):
        plain.points_and_normals([0])
    with pytest.raises(InputError, match="no depth images; render it with --keep-depth"):
        plain.depth([0])


@pytest.mark.parametrize("random", [False, True])
@pytest.mark.parametrize("distinct", [False, True])
def test_normals_are_those_of_the_points_whichever_are_drawn(full, random, distinct):
    """The solids are convex with the origin inside: a plane's side away from it is outside."""
    data = ShardDataset(full, "train", 40)
    rows = np.arange(len(data))
    rng = np.random.default_rng(0) if random else None
    points, normals = data.points_and_normals(rows, rng, distinct)
    again = data.points(rows, np.random.default_rng(0) if random else None, distinct)
    np.testing.assert_array_equal(points, again)
    source = ToySource()
    refs = {ref.object_id: ref for ref in source.objects("train")}
    for row in rows:
        R, t = data.rotations[row], data.translations[row]
        shape = source.load(refs[data.object_ids[row]])
        back, turned = (points[row] - t) @ R, normals[row] @ R
        faces = shape.nearest.on_surface(back)[2]
        np.testing.assert_allclose((turned * shape.face_normals[faces]).sum(1), 1, atol=1e-5)
        assert ((normals[row] * points[row]).sum(axis=1) < 0).all()


def test_depth_images_come_back_as_they_were(full):
    """Through the loader, and through h5py alone, which knows the filters they are packed with."""
    data = ShardDataset(full, "train", 64)
    images = data.depth([7, 2, 7])
    ref = ToySource().objects("train")[2]  # rows 6 to 8
    job = plan(full, occluder=ToyOccluder(normals=True, depth=8)).job
    pose = (data.rotations[7], data.translations[7])
    rng = generator(0, "toy", "train", ref.object_id, 1, "occluder")
    [view] = job.occluder.views(job.source.load(ref), [pose], [rng])
    np.testing.assert_array_equal(images[0], view.depth)
    np.testing.assert_array_equal(images[2], view.depth)
    with h5py.File(full / "train-00000.h5") as shard:
        np.testing.assert_array_equal(images[1], shard["depth"][2])
        assert shard["depth"].chunks == (1, 8, 9)


def test_the_table_lists_each_object_once_with_its_digest(full):
    lines = [json.loads(line) for line in (full / objects.NAME).read_text().splitlines()]
    assert [(line["split"], line["name"]) for line in lines] == [
        (split, ref.object_id) for split in ("train", "test") for ref in ToySource().objects(split)
    ]
    assert {line["source_sha256"] for line in lines} == {"0" * 64}
    assert lines[0]["shard"] == "train-00000.h5"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda path: path.unlink(), "objects.jsonl is missing"),
        (lambda path: path.write_text(path.read_text().replace("00", "01", 1)), "not those the"),
        (lambda path: path.write_text(path.read_text() + '{"shard": "x.h5"}\n'), "of 'x.h5'"),
        (lambda path: path.write_text(path.read_text() + "{}\n"), "is damaged"),
        (lambda path: path.write_bytes(b"\xff\xfe"), "is damaged"),
    ],
)
def test_a_changed_table_is_found(full, tmp_path, change, message):
    folder = tmp_path / "copy"
    shutil.copytree(full, folder)
    change(folder / objects.NAME)
    assert any(message in problem for problem in verify(folder).problems), verify(folder).problems


@pytest.mark.parametrize(
    ("value", "message"),
    [((0, 0, -0.9), "no unit vectors"), ((0, 0, np.nan), "no unit vectors"),
     ((0, 0, 1), "look away from the camera")],
)  # fmt: skip
def test_wrong_normals_are_found(full, tmp_path, value, message):
    folder = tmp_path / "copy"
    shutil.copytree(full, folder)
    with h5py.File(folder / "train-00000.h5", "r+") as shard:
        shard["normals"][3, 5] = value
    problems = verify(folder).problems
    assert any(message in p and "the first is row 3" in p for p in problems), problems


@pytest.mark.parametrize("value", [-0.1, np.nan])
def test_wrong_depth_is_found(full, tmp_path, value):
    folder = tmp_path / "copy"
    shutil.copytree(full, folder)
    with h5py.File(folder / "train-00000.h5", "r+") as shard:
        image = shard["depth"][2]
        image[3, 4] = value
        shard["depth"][2] = image
    problems = verify(folder).problems
    assert any("depth is not finite and ≥ 0 in 1 row(s), the first is row 2" in p for p in problems)


@dataclass
class Named(ToySource):
    """Toy objects whose ids are these."""

    names: tuple[str, ...] = ()

    def objects(self, split):
        refs = super().objects(split)
        return [ref.__class__(name, ref.label, ref.split, ref.location)
                for name, ref in zip(self.names, refs, strict=True)]  # fmt: skip


def test_names_of_any_length_and_bytes_are_kept_whole_beside_the_shards(tmp_path):
    long = "ä" * 100
    names = ("plain", long + "1", long + "2", "latin\udce9", "nul\0", "ä" * 48)
    build(plan(tmp_path, source=Named(names=names)), InlineExecutor)
    data = ShardDataset(tmp_path, "test", 64)
    assert len(set(data.object_ids)) == 6
    assert data.object_ids[0] == "plain"
    assert data.object_ids[5] == "ä" * 48, "what fits is kept as it is"
    for stored in data.object_ids:
        assert len(stored.encode()) <= OBJECT_ID_BYTES
    assert data.object_ids[1].startswith("ä" * 39)
    lines = [json.loads(line) for line in (tmp_path / objects.NAME).read_text().splitlines()]
    assert [line["name"] for line in lines if line["split"] == "test"] == list(names)
    assert verify(tmp_path).problems == []


@dataclass
class Sparse(ToyOccluder):
    """Views of 15, 16, 17, … distinct points."""

    def views(self, shape, poses, rngs):
        seen = []
        for k, view in enumerate(super().views(shape, poses, rngs)):
            n = 15 + k
            seen.append(View(view.points[:n], view.R_camera_object, view.t_camera_object,
                             view.K, view.visible_fraction, n))  # fmt: skip
        return seen


def test_a_view_of_too_few_points_is_turned_away_with_its_reason(tmp_path):
    manifest = build(replace(plan(tmp_path, occluder=Sparse()), splits=("train",)), InlineExecutor)
    assert [f["view"] for f in manifest.failures] == [0] * 6
    assert {(f["kind"], f["reason"]) for f in manifest.failures} == {("rejected", "too few points")}
    assert manifest.failures[0]["details"] == {"visible": 15, "minimum": 16}
    assert set(ShardDataset(tmp_path, "train", 64).n_visible) == {16, 17}


def test_the_card_of_clouds_says_how_far_they_are_what_a_camera_sees():
    """The figures are those of the table in docs/hpr.md."""
    rows = {}
    for line in (DOCS / "hpr.md").read_text().splitlines():
        if cells := re.match(r"\| ([0-9.]+) \| ([0-9.]+) \| ([0-9.]+) \| [*0-9.]+ \|", line):
            rows[float(cells[1])] = float(cells[2]), float(cells[3])
    assert rows.items() >= HPR_MEASURED.items()
    manifest = manifests.load(FORMAT_1)
    assert visibility_lines(manifest) == []
    manifest.configuration["occluder"] = {"name": "hpr", "gamma": 1.5}
    assert "precision 0.81 (19% of the" in visibility_lines(manifest)[0]
    manifest.configuration["occluder"] = {"name": "hpr", "radius": 50.0}
    assert "was not measured" in visibility_lines(manifest)[0]
