"""The loader: what it returns, and that it survives forks and spawns."""

import json
import multiprocessing
import pickle
import shutil

import h5py
import numpy as np
import pytest

from partialbench.dataset import loader
from partialbench.dataset.build import build
from partialbench.dataset.executors import InlineExecutor
from partialbench.dataset.loader import ShardDataset
from partialbench.errors import InputError
from tests.dataset.toy import plan


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("data")
    build(plan(out), InlineExecutor)
    return out


def stored(folder, name):
    parts = []
    for path in sorted(folder.glob("train-*.h5")):
        with h5py.File(path) as shard:
            parts.append(shard[name][()])
    return np.concatenate(parts)


def test_columns_and_points_are_the_shards_in_order(folder):
    data = ShardDataset(folder, "train", num_points=64)
    assert len(data) == 18
    assert np.array_equal(data.labels, stored(folder, "label"))
    assert data.object_ids.tolist() == [s.decode() for s in stored(folder, "object_id")]
    assert np.array_equal(data.rotations, stored(folder, "R_camera_object"))
    order = np.random.default_rng(0).permutation(18)
    assert np.array_equal(data.points(order), stored(folder, "points")[order])
    assert data.symmetries[0] == "xyz-180"
    assert data.setting == "partial"
    assert data.dataset_id == "toy"


def test_random_subsets_come_from_the_row_without_repeats(folder):
    data = ShardDataset(folder, "train", num_points=40)
    whole = stored(folder, "points")
    assert np.array_equal(data.points([5]), whole[[5], :40])
    drawn = data.points(np.arange(18), np.random.default_rng(0))
    for cloud, row in zip(drawn, whole, strict=True):
        pool = {p.tobytes() for p in row}
        assert {p.tobytes() for p in cloud} <= pool
        assert len({p.tobytes() for p in cloud}) == 40
    again = data.points(np.arange(18), np.random.default_rng(1))
    assert not np.array_equal(drawn, again)


def test_subsets_of_the_distinct_points_repeat_none_before_all_are_taken(folder):
    """Rows of 64 with 50, 64 or 30 distinct points, which are the first, as ``render`` has them."""
    data = ShardDataset(folder, "train", num_points=40)
    data.n_visible = np.array([50, 500, 30] * 6, np.int32)
    whole = stored(folder, "points")
    places = set()
    for seed in range(20):
        drawn = data.points(np.arange(18), np.random.default_rng(seed), distinct=True)
        for cloud, row, visible in zip(drawn, whole, data.n_visible, strict=True):
            taken = [next(i for i, p in enumerate(row) if (p == q).all()) for q in cloud]
            assert len(set(taken)) == 40
            assert max(taken) < max(visible, 40)
            places.add((int(visible), taken[0]))
    starts = {v: {first for visible, first in places if visible == v} for v in (50, 500)}
    assert max(starts[50]) > 40
    assert max(starts[500]) > 50
    first = data.points([0, 1, 2], distinct=True)
    assert np.array_equal(first, whole[:3, :40])


def test_errors_say_what_to_do(folder, tmp_path):
    with pytest.raises(InputError, match=r"stores 64 points a cloud, 99 were asked for"):
        ShardDataset(folder, "train", num_points=99)
    with pytest.raises(InputError, match=r"no split 'val'; it has \['train', 'test'\]"):
        ShardDataset(folder, "val", num_points=64)
    with pytest.raises(InputError, match="not a data folder"):
        ShardDataset(tmp_path, "train")
    with pytest.raises(IndexError, match="row indices must lie in"):
        ShardDataset(folder, "train", 64).points([18])


def _checksum(data: ShardDataset, queue) -> None:
    queue.put(float(data.points(np.arange(len(data))).sum()))


@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
def test_workers_read_what_the_parent_reads(folder, method):
    data = ShardDataset(folder, "train", num_points=64)
    expected = float(data.points(np.arange(len(data))).sum())  # the maps are open in the parent
    context = multiprocessing.get_context(method)
    queue = context.Queue()
    workers = [context.Process(target=_checksum, args=(data, queue)) for _ in range(2)]
    for worker in workers:
        worker.start()
    assert [queue.get(timeout=60) for _ in workers] == [expected, expected]
    for worker in workers:
        worker.join()
    assert len(pickle.dumps(data)) < 20_000, "a pickle carries no points"


def edited(folder, tmp_path, change):
    """A copy of a data folder with a shard changed in place; its size stays."""
    copy = shutil.copytree(folder, tmp_path / "copy")
    assert len(ShardDataset(copy, "train", 8)) > 0  # it was sound, and this process has seen it
    path = sorted(copy.glob("train-*.h5"))[0]
    size = path.stat().st_size
    change(path)
    assert path.stat().st_size == size
    return copy


def mend_labels(path):
    with h5py.File(path, "r+") as shard:
        shard["label"][...] = 0


def rot(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("change", [mend_labels, rot])
def test_a_shard_changed_in_place_is_not_what_its_manifest_lists(folder, tmp_path, change):
    copy = edited(folder, tmp_path, change)
    with pytest.raises(
        InputError, match=r"is not the file its manifest lists .*partialbench verify"
    ):
        ShardDataset(copy, "train", 8)


def test_a_manifest_with_another_digest_is_not_believed(folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    whole = ShardDataset(copy, "train", 8).digest
    path = copy / "manifest.json"
    path.write_text(path.read_text().replace(whole, "0" * 64))
    with pytest.raises(InputError, match=r"do not have the digest its manifest claims|manifest"):
        ShardDataset(copy, "train", 8)


def test_a_manifest_with_other_numbers_of_rows_is_not_believed(folder, tmp_path):
    """By them the rows of a shard are found: labels would be paired with other objects' points."""
    path = shutil.copytree(folder, tmp_path / "copy") / "manifest.json"
    manifest = json.loads(path.read_text())
    first, second = [s for s in manifest["shards"] if s["split"] == "train"][:2]
    first["rows"], second["rows"] = first["rows"] - 1, second["rows"] + 1
    path.write_text(json.dumps(manifest))
    with pytest.raises(InputError, match=rf"holds {first['rows'] + 1} rows, its manifest says"):
        ShardDataset(path.parent, "train", 8)


def test_a_shard_is_hashed_once_a_process(folder, monkeypatch):
    ShardDataset(folder, "train", 8)
    monkeypatch.setattr(loader, "file_sha256", lambda path: pytest.fail("hashed again"))
    ShardDataset(folder, "train", 8)
