"""Exports: what other libraries read is what the shards hold, and interruptions are seen."""

from __future__ import annotations

import io
import json
import os
import sys
import tarfile

import numpy as np
import pytest

from partialbench.dataset.build import build
from partialbench.dataset.descriptions import licence_line
from partialbench.dataset.executors import InlineExecutor
from partialbench.dataset.export import check_export, export
from partialbench.dataset.loader import ShardDataset
from partialbench.errors import ConfigurationMismatchError, InputError, PartialbenchError
from tests.dataset.toy import ToyOccluder, ToySource, plan

parquet = pytest.importorskip("pyarrow.parquet")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("data") / "toy"
    build(plan(out, occluder=ToyOccluder(normals=True, depth=5)), InlineExecutor)
    return out


@pytest.fixture(scope="module")
def exported(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("parquet") / "out"
    seen = []
    done = export(folder, "parquet", out, on_progress=lambda *now: seen.append(now))
    assert seen[0] == (0, 24)
    assert seen[-1] == (24, 24)
    assert sum(one.rows for one in done) == 24
    return out


def stored(folder, split="train"):
    data = ShardDataset(folder, split, 64)
    return data, np.arange(len(data))


def test_every_column_of_parquet_is_the_shards_to_the_bit(folder, exported):
    assert check_export(exported) == []
    data, rows = stored(folder)
    table = parquet.read_table(sorted((exported / "data").glob("train-*.parquet")))
    assert len(table) == len(data) == 18
    points, normals = data.points_and_normals(rows)

    def numbers(name):
        return np.array(table[name].to_pylist())

    assert numbers("points").astype(np.float32).tobytes() == points.tobytes()
    assert numbers("normals").astype(np.float32).tobytes() == normals.tobytes()
    assert numbers("depth").astype(np.float32).tobytes() == data.depth(rows).tobytes()
    assert numbers("R_camera_object").tobytes() == data.rotations.tobytes()
    assert numbers("t_camera_object").tobytes() == data.translations.tobytes()
    assert table["label"].to_pylist() == data.labels.tolist()
    assert table["object_id"].to_pylist() == data.object_ids.tolist()
    assert table["class_name"].to_pylist() == [data.class_names[i] for i in data.labels]
    assert str(table.schema.field("points").type).count("fixed_size_list") == 2
    assert not table.schema.field("points").nullable
    assert len(table["row_sha256"][0].as_py()) == 32


def test_datasets_opens_the_parquet_export_by_its_card(folder, exported, tmp_path):
    datasets = pytest.importorskip("datasets")
    loaded = datasets.load_dataset(str(exported), cache_dir=str(tmp_path / "cache"))
    data, rows = stored(folder, "test")
    assert {split: len(part) for split, part in loaded.items()} == {"train": 18, "test": 6}
    found = loaded["test"].with_format("numpy")
    assert np.stack(list(found["points"])).tobytes() == data.points(rows).tobytes()
    assert list(found["label"]) == data.labels.tolist()


def test_datasets_opens_the_shards_themselves(folder, tmp_path):
    datasets = pytest.importorskip("datasets")
    files = {"train": str(folder / "train-*.h5")}
    loaded = datasets.load_dataset("hdf5", data_files=files, cache_dir=str(tmp_path / "cache"))
    data, rows = stored(folder)
    found = loaded["train"].with_format("numpy")
    assert np.stack(list(found["points"])).tobytes() == data.points(rows).tobytes()
    assert list(found["label"]) == data.labels.tolist()


def test_webdataset_iterates_the_tar_files(folder, tmp_path):
    webdataset = pytest.importorskip("webdataset")
    export(folder, "webdataset", tmp_path / "tar")
    assert check_export(tmp_path / "tar") == []
    urls = sorted(str(path) for path in (tmp_path / "tar").glob("train-*.tar"))
    samples = list(webdataset.WebDataset(urls, shardshuffle=False).decode())
    data, rows = stored(folder)
    assert len(samples) == len(data)
    assert np.stack([s["points.npy"] for s in samples]).tobytes() == data.points(rows).tobytes()
    assert np.stack([s["depth.npy"] for s in samples]).tobytes() == data.depth(rows).tobytes()
    assert [s["cls"] for s in samples] == data.labels.tolist()
    about = [s["json"] for s in samples]
    assert np.array([a["R_camera_object"] for a in about]).tobytes() == data.rotations.tobytes()
    assert [a["class_name"] for a in about] == [data.class_names[i] for i in data.labels]


def test_the_same_data_give_the_same_tar_files(folder, tmp_path):
    for name in ("a", "b"):
        export(folder, "webdataset", tmp_path / name)
    for path in (tmp_path / "a").iterdir():
        if not path.name.startswith(".lock"):
            assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes(), path.name
    with tarfile.open(tmp_path / "a" / "test-00000.tar") as tar:
        names = tar.getnames()
    assert names[0] == "test-00000-000000.cls"
    assert len(names) == len(set(names))


@pytest.mark.skipif(sys.platform != "linux", reason="file names are bytes there")
def test_a_folder_whose_name_is_no_text_is_exported(folder, tmp_path):
    """As it is under the locale C: Arrow takes paths in UTF-8 alone."""
    out = tmp_path / os.fsdecode(b"caf\xe9")
    export(folder, "parquet", out)
    assert check_export(out) == []


def test_an_interrupted_export_is_seen_and_goes_on_where_it_stopped(folder, tmp_path):
    out = tmp_path / "out"

    def stop(done, total):
        if done >= 6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(folder, "parquet", out, on_progress=stop, threads=1)
    assert not (out / "README.md").exists()
    assert check_export(out) == [
        "the export is unfinished; run the same command again to complete it"
    ]
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.parquet")}
    finished = [one["name"] for one in json.loads((out / "export.json").read_text())["parts"]]
    assert finished
    damaged = out / finished[0]
    export(folder, "parquet", out)
    assert check_export(out) == []
    kept = [out / name for name in finished]
    assert all(path.stat().st_mtime_ns == before[path] for path in kept)

    damaged.write_bytes(damaged.read_bytes()[:-1])
    assert check_export(out) == [f"{finished[0]} is not as it was written: damaged or edited"]
    (out / "README.md").unlink()
    export(folder, "parquet", out)
    assert check_export(out) == []


def test_what_cannot_be_exported_is_said(folder, exported, tmp_path):
    with pytest.raises(InputError, match="no export to 'parket'; did you mean parquet"):
        export(folder, "parket", tmp_path / "out")
    with pytest.raises(
        ConfigurationMismatchError, match=r"is an export of toy \(train .* to parquet"
    ):
        export(folder, "webdataset", exported)
    build(plan(tmp_path / "cut", rows_per_shard=9), InlineExecutor)
    build(plan(tmp_path / "whole", rows_per_shard=99), InlineExecutor)
    export(tmp_path / "cut", "parquet", tmp_path / "rows")
    with pytest.raises(ConfigurationMismatchError, match="configuration"):
        export(tmp_path / "whole", "parquet", tmp_path / "rows")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("")
    with pytest.raises(PartialbenchError, match="not empty and no export"):
        export(folder, "parquet", tmp_path / "full")
    with pytest.raises(InputError, match=r"it has no export\.json"):
        check_export(tmp_path)
    other = tmp_path / "other"
    other.mkdir()
    (other / "export.json").write_text(
        json.dumps({"format": "partialbench-export", "format_version": 9})
    )
    with pytest.raises(InputError, match="version 9, expected 'partialbench-export' version 1"):
        export(folder, "parquet", other)
    with pytest.raises(InputError, match="the folder to write into must be a path"):
        export(folder, "parquet", None)
    with pytest.raises(InputError, match="threads must be at least 1, got -1"):
        export(folder, "parquet", tmp_path / "out", threads=-1)
    with pytest.raises(InputError, match="--source 'x' has no effect"):
        export(folder, "parquet", tmp_path / "out", source="x")


def test_a_damaged_shard_is_not_exported(tmp_path):
    build(plan(tmp_path / "data", source=ToySource(2)), InlineExecutor)
    shard = tmp_path / "data" / "train-00000.h5"
    content = bytearray(shard.read_bytes())
    content[len(content) // 2] ^= 1
    shard.write_bytes(content)
    with pytest.raises(InputError, match=r"train-00000\.h5 is not the file its manifest lists"):
        export(tmp_path / "data", "parquet", tmp_path / "out")
    assert not list((tmp_path / "out").rglob("train*.parquet"))


def test_the_card_has_the_front_matter_of_a_hub(folder, exported):
    yaml = pytest.importorskip("yaml")
    for path, pattern in ((folder / "CARD.md", "train-*.h5"),
                          (exported / "README.md", "data/train-*.parquet")):  # fmt: skip
        _, head, body = path.read_text().split("---\n", 2)
        about = yaml.safe_load(head)
        assert about["configs"][0]["data_files"][0] == {"split": "train", "path": pattern}
        assert about["size_categories"] == ["n<1K"]
        assert about["class_names"] == ["dresser", "bottle"]
        assert body.lstrip().startswith("# toy")
        assert "Licence: the terms of the shapes that it was made from." in body
    for generated in ("pm40-parametric", "ps15-rooms", "ps15-rooms-standing"):
        assert licence_line(generated).startswith(
            "Licence: MIT (https://opensource.org/license/mit)"
        )
    assert "ModelNet40's terms" in licence_line("pm40")
    assert "ScanNet" in licence_line("ps15")


@pytest.mark.filterwarnings("ignore")
def test_croissant_is_valid_and_reads_the_rows_of_parquet(folder, exported, caplog):
    croissant = pytest.importorskip("mlcroissant")
    shards = croissant.Dataset(jsonld=folder / "croissant.json")
    assert not shards.metadata.ctx.issues.errors
    assert {file.id for file in shards.metadata.distribution} == {
        path.name for path in folder.glob("*.h5")
    }
    about = croissant.Dataset(jsonld=exported / "croissant.json")
    assert not about.metadata.ctx.issues.errors
    data, rows = stored(folder, "test")
    records = list(about.records("test"))
    assert [record["test/label"] for record in records] == data.labels.tolist()
    points = np.array([np.array(list(record["test/points"])).tolist() for record in records])
    assert points.astype(np.float32).tobytes() == data.points(rows).tobytes()


def test_a_tar_member_is_what_numpy_wrote(folder, tmp_path):
    export(folder, "webdataset", tmp_path / "tar")
    with tarfile.open(tmp_path / "tar" / "test-00000.tar") as tar:
        member = tar.extractfile("test-00000-000002.points.npy").read()
    assert np.array_equal(np.load(io.BytesIO(member)), stored(folder, "test")[0].points([2])[0])
