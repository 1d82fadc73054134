"""The stream of batches: keyed, augmented with its labels, shared out among processes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from partialbench.benchmark.batches import BatchStream, Place, map_rotations
from partialbench.benchmark.protocol import Protocol
from partialbench.geometry.rotations import haar_rotations, is_rotation
from partialbench.geometry.symmetry import GROUPS, map_rotation
from tests.benchmark import memory_clouds

PROTOCOL = Protocol("test", num_points=64, jitter_sigma=0.0)


@pytest.fixture
def clouds():
    return memory_clouds.MemoryClouds()


def stream(clouds, protocol=PROTOCOL, batch_size=16, seed=0, **kwargs):
    return BatchStream(clouds, np.arange(len(clouds)), protocol, batch_size, seed, **kwargs)


def equal(a, b):
    pairs = zip(a, b, strict=True)
    return all(x is y is None or torch.equal(x, y) for x, y in pairs)


def test_an_epoch_started_in_the_middle_goes_on_with_the_same_batches(clouds):
    whole = list(stream(clouds).epoch(3))
    assert len(whole) == len(clouds) // 16
    for (place, batch), (again, same) in zip(whole[4:], stream(clouds).epoch(3, 4), strict=True):
        assert place == again
        assert equal(batch, same)


def test_epochs_and_seeds_differ_in_order_and_augmentation(clouds):
    first = [b for _, b in stream(clouds).epoch(0)]
    assert not equal(first[0], next(stream(clouds).epoch(1))[1])
    assert not equal(first[0], next(stream(clouds, seed=1).epoch(0))[1])
    assert not torch.equal(first[0].rotation, first[1].rotation)
    assert sorted(stream(clouds).order(0)) == sorted(stream(clouds).order(1))


@pytest.mark.parametrize("subset", ["stored", "distinct"])
def test_the_protocol_says_of_which_points_a_cloud_is_a_subset(clouds, monkeypatch, subset):
    asked, points = [], clouds.points

    def spy(indices, rng=None, distinct=False):
        asked.append(distinct)
        return points(indices, rng)

    monkeypatch.setattr(clouds, "points", spy)
    next(stream(clouds, dataclasses.replace(PROTOCOL, subset=subset)).epoch(0))
    assert asked
    assert set(asked) == {subset == "distinct"}


def test_points_and_labels_turn_together(clouds):
    """Undoing the batch's R must give the solid's canonical points: p = Qᵀ·p', R' = Q·R."""
    for place, batch in stream(clouds).epoch(0):
        order = stream(clouds).order(0)
        rows = order[place.batch * 16 : (place.batch + 1) * 16]
        canonical = batch.points @ batch.rotation  # row vectors: Rᵀ·p
        offset = torch.tensor([0.0, 0.0, 3.0]) @ torch.from_numpy(
            clouds.rotations[rows].astype(np.float32)
        )
        size = (canonical - offset[:, None]).abs().amax(dim=1)
        for row, extent in zip(rows, size, strict=True):
            true = np.abs((clouds.clouds[row] - (0, 0, 3)) @ clouds.rotations[row]).max(0)
            assert np.all(extent.numpy() <= true + 1e-5)
            assert np.all(extent.numpy() >= 0.8 * true)
        assert torch.equal(batch.label, torch.from_numpy(clouds.labels[rows]))
        assert is_rotation(batch.rotation.numpy(), 1e-5).all()


def test_the_turn_is_about_the_camera_and_uniform_in_its_mean(clouds):
    turned = torch.cat([b.rotation for e in range(40) for _, b in stream(clouds).epoch(e)])
    assert len(turned) > 4000
    # The mean of a Haar rotation is zero; one entry's standard error is 1/√(3n) = 0.009.
    assert turned.mean(dim=0).abs().max() < 0.04


def test_aligned_clouds_are_not_turned_and_neither_is_anything_without_rotation(clouds):
    aligned = memory_clouds.MemoryClouds(setting="aligned")
    fixed = Protocol("test", num_points=64, jitter_sigma=0.0, rotation="none")
    for source in (stream(aligned), stream(clouds, fixed)):
        _, batch = next(source.epoch(0))
        rows = source.order(0)[:16]
        assert np.array_equal(
            batch.rotation.numpy(), source.dataset.rotations[rows].astype(np.float32)
        )


def test_jitter_is_clipped_and_has_its_size(clouds):
    fixed = Protocol("t", num_points=64, rotation="none", jitter_sigma=0.02, jitter_clip=0.05)
    plain = Protocol("t", num_points=64, rotation="none", jitter_sigma=0.0)
    noise = torch.cat(
        [
            (a.points - b.points).flatten()
            for (_, a), (_, b) in zip(
                stream(clouds, fixed).epoch(0), stream(clouds, plain).epoch(0), strict=True
            )
        ]
    )
    assert noise.abs().max() <= 0.05 + 1e-6
    assert noise.std() == pytest.approx(0.02, rel=0.05)


def test_processes_share_one_batch_without_overlap(clouds):
    _, whole = next(stream(clouds).epoch(2))
    _, even = next(stream(clouds, rank=0, world=2).epoch(2))
    _, odd = next(stream(clouds, rank=1, world=2).epoch(2))
    for field in range(4):
        assert torch.equal(whole[field][0::2], even[field])
        assert torch.equal(whole[field][1::2], odd[field])
    with pytest.raises(ValueError, match="cannot be shared evenly by 3"):
        stream(clouds, rank=0, world=3)


def test_a_small_set_is_one_batch_and_a_lone_cloud_is_refused(clouds):
    few = BatchStream(clouds, np.arange(5), PROTOCOL, 32, 0)
    assert len(few) == 1
    assert len(few.make(Place(0, 0), few.order(0)).label) == 5
    with pytest.raises(ValueError, match="2 clouds or more"):
        BatchStream(clouds, np.arange(1), PROTOCOL, 32, 0)


def test_mapping_a_mixed_batch_is_mapping_each_row(rng):
    rotations = haar_rotations(rng, 70)
    names = np.array(sorted(GROUPS))[rng.integers(0, len(GROUPS), 70)]
    mapped = map_rotations(rotations, names)
    for R, name, got in zip(rotations, names, mapped, strict=True):
        assert np.allclose(got, map_rotation(R, GROUPS[name]), atol=1e-12)
