"""Test objects made from a training object's bytes: found, recorded and left out of one score."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from partialbench.benchmark.records import results
from partialbench.benchmark.run import run_eval
from partialbench.benchmark.testing import duplicates, metrics
from partialbench.dataset import build as builder
from partialbench.dataset.executors import InlineExecutor
from partialbench.dataset.loader import ShardDataset
from partialbench.dataset.render import plan_render
from partialbench.dataset.rows import Job
from tests.benchmark.memory_clouds import CLASSES, SolidSource, WholeView, hash_of

COPIED = {"chair_0003", "table_0000"}


class CopyingSource(SolidSource):
    """Two test objects are the training objects of the same name; a third has no known source."""

    def load(self, ref):
        return super().load(self._original(ref))

    def digest(self, ref):
        if ref.split == "test" and ref.object_id == "bottle_0001":
            return ""
        return super().digest(self._original(ref))

    def _original(self, ref):
        if ref.object_id not in COPIED:
            return ref
        return next(r for r in self.objects("train") if r.object_id == ref.object_id)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("data")
    job = Job(CopyingSource(6, CLASSES), WholeView(), "toy", "partial", {"train": 3, "test": 2},
              64, 0)  # fmt: skip
    builder.build(builder.BuildPlan(job, out, ("train", "test")), InlineExecutor)
    return out


def test_keys_are_short_sorted_and_leave_out_the_unknown():
    a, b = hash_of("a"), hash_of("b")
    keys = duplicates.source_keys(np.array([b, a, b, ""]))
    assert keys == sorted([a[:16], b[:16]])
    asked = np.array([hash_of("c"), b, "", a])
    assert duplicates.among(asked, keys).tolist() == [False, True, False, True]
    assert duplicates.among(asked, []).tolist() == [False] * 4
    assert not duplicates.among(np.array(["", ""]), duplicates.source_keys(np.array([""]))).any()


def test_every_row_knows_what_its_object_was_made_from(folder):
    train = ShardDataset(folder, "train", 64)
    expected = [hash_of(f"train/{name.rsplit('_', 1)[0]}/{int(name[-4:])}")
                for name in train.object_ids]  # fmt: skip
    assert train.source_digests.tolist() == expected
    test = ShardDataset(folder, "test", 64)
    assert set(test.object_ids[test.source_digests == ""]) == {"bottle_0001"}


def test_the_record_has_the_scores_with_and_without_them(folder, tmp_path):
    small = {"preset": "smoke", "device": "cpu", "num_points": 64, "clouds": [64],
             "max_train_clouds": None, "max_test_clouds": None}  # fmt: skip
    (record,) = run_eval(
        "tests.benchmark.tiny_models:Bare", folder, results_folder=tmp_path / "a", **small
    )
    stored = results.read_predictions(tmp_path / "a", record)
    assert set(stored.object_ids[stored.duplicate]) == COPIED
    assert record.scores["duplicates"] == 4  # two views each
    right = stored.predicted == stored.labels
    known = np.isin(stored.object_ids, sorted(COPIED))
    assert record.scores["accuracy"] == right.mean()
    assert record.scores["accuracy_without_duplicates"] == right[~known].mean()
    assert record.scores["class_accuracy_without_duplicates"] == metrics.class_accuracy(
        stored.labels[~known], stored.predicted[~known], 3
    )
    # A checkpoint remembers what it was trained on: no training data are needed to test it.
    (weights,) = (tmp_path / "a" / "runs").glob("*/branch-*/checkpoint.pt")
    (again,) = run_eval(
        record.model, folder, checkpoint_file=weights, device="cpu", results_folder=tmp_path / "b"
    )
    assert again.predictions_sha256 == record.predictions_sha256


@pytest.mark.slow
def test_the_real_duplicates_across_the_split_are_found(shared, tmp_path):
    """Every object of the aligned clouds; compared with the clouds themselves, number by number."""
    path = shared / "data" / "modelnet40_aligned_1024.h5"
    plan = plan_render("pm40", tmp_path, source=str(path), setting="aligned", views=1, points=16)
    builder.build(plan, InlineExecutor)
    train, test = (ShardDataset(tmp_path, split, 16) for split in ("train", "test"))
    mask = duplicates.among(test.source_digests, duplicates.source_keys(train.source_digests))
    with h5py.File(path) as file:
        clouds = {s: file[s]["points"][()].reshape(len(file[s]["label"]), -1) for s in file
                  if s in ("train", "test")}  # fmt: skip
        names = file["test"]["object_id"].asstr()[()]
    whole = np.concatenate([clouds["train"], clouds["test"]])
    _, group = np.unique(whole, axis=0, return_inverse=True)
    in_train, in_test = np.split(group.ravel(), [len(clouds["train"])])
    expected = np.isin(in_test, in_train)
    assert sorted(test.object_ids[mask]) == sorted(names[expected])
    # 79 groups cross the whole split; four fifths of the test objects are at hand.
    assert len(np.intersect1d(in_test, in_train)) == 66
    assert mask.sum() == 72
