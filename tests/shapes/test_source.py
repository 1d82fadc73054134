"""The families as a source: counts, ids, splits, digests."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from partialbench.dataset.categories import MODELNET40
from partialbench.errors import InputError
from renderers.shapes.catalogue import FAMILIES
from renderers.shapes.source import MODELNET40_COUNTS, ParametricShapes


def test_official_counts() -> None:
    assert tuple(MODELNET40_COUNTS) == MODELNET40
    assert np.sum(list(MODELNET40_COUNTS.values()), axis=0).tolist() == [9843, 2468]


def test_official_counts_agree_with_the_real_training_set(shared: Path) -> None:
    path = shared / "data" / "modelnet40_aligned_1024.h5"
    if not path.exists():
        pytest.skip(f"no {path.name} in the real data")
    with h5py.File(path) as file:
        train = np.bincount(file["train/label"][()], minlength=40)
        test = np.bincount(file["test/label"][()], minlength=40)
    assert train.tolist() == [n for n, _ in MODELNET40_COUNTS.values()]
    # The file holds a stratified four fifths of the test objects.
    official = np.array([n for _, n in MODELNET40_COUNTS.values()])
    np.testing.assert_array_equal(test, np.round(0.8 * official))


def test_counts_ids_and_disjoint_splits() -> None:
    source = ParametricShapes(counts=(3, 2))
    train, test = source.objects("train"), source.objects("test")
    assert (len(train), len(test)) == (3 * len(FAMILIES), 2 * len(FAMILIES))
    ids = [ref.object_id for ref in train + test if ref.label == MODELNET40.index("cone")]
    assert ids == [f"cone_{n:04d}" for n in (1, 2, 3, 4, 5)]
    assert not {(r.label, r.location) for r in train} & {(r.label, r.location) for r in test}
    assert len({source.digest(ref) for ref in train + test}) == len(train) + len(test)
    official = ParametricShapes("modelnet40")
    assert [len(official.objects(s)) for s in official.splits()] == [9843, 2468]


def test_an_object_does_not_depend_on_the_counts_or_the_process() -> None:
    few, many = ParametricShapes((1, 1)), pickle.loads(pickle.dumps(ParametricShapes((9, 9))))
    for split in few.splits():
        ref = few.objects(split)[0]
        twin = next(r for r in many.objects(split) if r.label == ref.label)
        assert few.digest(ref) == many.digest(twin)
        assert few.load(ref).vertices.tobytes() == many.load(twin).vertices.tobytes()


def test_a_seed_is_another_data_set() -> None:
    a, b = ParametricShapes((1, 0), seed=0), ParametricShapes((1, 0), seed=1)
    ref = a.objects("train")[0]
    assert a.digest(ref) != b.digest(ref)
    assert a.load(ref).vertices.tobytes() != b.load(ref).vertices.tobytes()
    assert a.describe() != b.describe()


@pytest.mark.parametrize("counts", ["modelnet", (1,), (-1, 2), (1.5, 2), 3, (2_000_000, 1)])
def test_bad_counts_are_refused(counts: Any) -> None:
    with pytest.raises(InputError, match="counts is"):
        ParametricShapes(counts)


def test_an_unknown_split_is_refused() -> None:
    with pytest.raises(InputError, match="'val'"):
        ParametricShapes((1, 1)).objects("val")
