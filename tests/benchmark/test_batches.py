"""The stream of batches: keyed, augmented with its labels, shared out among processes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from partialbench.benchmark.protocol.protocol import Protocol
from partialbench.benchmark.training.batches import BatchStream, Place
from partialbench.benchmark.training.stretch import stretched
from partialbench.geometry.rotations import axis_rotation, haar_rotations, is_rotation
from partialbench.geometry.symmetry import GROUPS, map_rotation, map_rotations
from tests.benchmark import memory_clouds

PROTOCOL = Protocol("test", num_points=64, jitter_sigma=0.0)


@pytest.fixture
def clouds():
    return memory_clouds.MemoryClouds()


def stream(clouds, protocol=PROTOCOL, batch_size=16, seed=0, **kwargs):
    return BatchStream(clouds, np.arange(len(clouds)), protocol, batch_size, seed, **kwargs)


def epoch(source, number, start=0):
    first = number * len(source)
    for _, place, batch in source.steps(first + start, first + len(source)):
        yield place, batch


def equal(a, b):
    pairs = zip(a, b, strict=True)
    return all(x is y is None or torch.equal(x, y) for x, y in pairs)


def test_an_epoch_started_in_the_middle_goes_on_with_the_same_batches(clouds):
    whole = list(epoch(stream(clouds), 3))
    assert len(whole) == len(clouds) // 16
    for (place, batch), (again, same) in zip(whole[4:], epoch(stream(clouds), 3, 4), strict=True):
        assert place == again
        assert equal(batch, same)


def test_epochs_and_seeds_differ_in_order_and_augmentation(clouds):
    first = [b for _, b in epoch(stream(clouds), 0)]
    assert not equal(first[0], next(epoch(stream(clouds), 1))[1])
    assert not equal(first[0], next(epoch(stream(clouds, seed=1), 0))[1])
    assert not torch.equal(first[0].rotation, first[1].rotation)
    assert sorted(stream(clouds).order(0)) == sorted(stream(clouds).order(1))


@pytest.mark.parametrize("subset", ["stored", "distinct"])
def test_the_protocol_says_of_which_points_a_cloud_is_a_subset(clouds, monkeypatch, subset):
    asked, points = [], clouds.points

    def spy(indices, rng=None, distinct=False):
        asked.append(distinct)
        return points(indices, rng)

    monkeypatch.setattr(clouds, "points", spy)
    next(epoch(stream(clouds, dataclasses.replace(PROTOCOL, subset=subset)), 0))
    assert asked
    assert set(asked) == {subset == "distinct"}


def test_points_and_labels_turn_together(clouds):
    """Undoing the batch's R must give the solid's canonical points: p = Qᵀ·p', R' = Q·R."""
    for place, batch in epoch(stream(clouds), 0):
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
    turned = torch.cat([b.rotation for e in range(40) for _, b in epoch(stream(clouds), e)])
    assert len(turned) > 4000
    # The mean of a Haar rotation is zero; one entry's standard error is 1/√(3n) = 0.009.
    assert turned.mean(dim=0).abs().max() < 0.04


@pytest.mark.parametrize("setting", ["z-rotated", "partial-z"])
def test_clouds_turned_about_z_are_turned_about_z_again(clouds, setting):
    turned = memory_clouds.MemoryClouds(setting=setting)
    source = stream(turned)
    found = []
    for place, batch in epoch(source, 0):
        rows = source.order(0)[16 * place.batch : 16 * (place.batch + 1)]
        found.append(batch.rotation.double().numpy() @ turned.rotations[rows].swapaxes(1, 2))
    turns = np.concatenate(found)
    np.testing.assert_allclose(
        turns[:, 2], np.broadcast_to([0, 0, 1], turns[:, 2].shape), atol=1e-6
    )
    assert is_rotation(turns, 1e-5).all()
    angles = np.arctan2(turns[:, 1, 0], turns[:, 0, 0])
    # Uniform on the circle: the mean of n unit vectors is of length 1/√n.
    assert abs(np.exp(1j * angles).mean()) < 3 / len(angles) ** 0.5


def test_aligned_clouds_are_not_turned_and_neither_is_anything_without_rotation(clouds):
    aligned = memory_clouds.MemoryClouds(setting="aligned")
    shown = memory_clouds.MemoryClouds(setting="partial-aligned")
    fixed = Protocol("test", num_points=64, jitter_sigma=0.0, rotation="none")
    for source in (stream(aligned), stream(shown), stream(clouds, fixed)):
        _, batch = next(epoch(source, 0))
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
                epoch(stream(clouds, fixed), 0), epoch(stream(clouds, plain), 0), strict=True
            )
        ]
    )
    assert noise.abs().max() <= 0.05 + 1e-6
    assert noise.std() == pytest.approx(0.02, rel=0.05)


def test_processes_share_one_batch_without_overlap(clouds):
    _, whole = next(epoch(stream(clouds), 2))
    _, even = next(epoch(stream(clouds, rank=0, world=2), 2))
    _, odd = next(epoch(stream(clouds, rank=1, world=2), 2))
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


STRETCH = dataclasses.replace(PROTOCOL, stretch=1.5, rotation="none")


def test_stretching_is_along_the_objects_axes_and_within_bounds(clouds):
    """A cloud back in its object's frame is the one it was, each axis by a factor of its own."""
    plain = dataclasses.replace(STRETCH, stretch=1.0)
    seen = []
    for (_, before), (_, after) in zip(
        epoch(stream(clouds, plain), 0), epoch(stream(clouds, STRETCH), 0), strict=True
    ):
        assert torch.equal(before.rotation, after.rotation)
        ratio = (after.points @ after.rotation) / (before.points @ before.rotation)
        factors = ratio.nanmedian(1, keepdim=True).values
        torch.testing.assert_close(
            after.points @ after.rotation, before.points @ before.rotation * factors,
            atol=1e-4, rtol=1e-4,
        )  # fmt: skip
        seen.append(factors[:, 0])
    factors = torch.cat(seen)
    assert factors.min() > 1 / 1.5
    assert factors.max() < 1.5
    assert factors.log().std() > 0.1
    assert abs(factors.log().mean()) < 0.1


def test_stretching_keeps_the_symmetry_of_the_object():
    """S·A = A·S for every element: the stretched object looks the same under it, so labels hold."""
    rng = np.random.default_rng(0)
    for name, group in GROUPS.items():
        rotations = haar_rotations(rng, 8)
        corners = np.broadcast_to(np.eye(3), (8, 3, 3)) @ rotations.swapaxes(1, 2)
        names = np.array([name] * 8)
        mapped = stretched(corners.astype(np.float32), rotations, names, 1.5, rng) @ rotations
        elements = [*group.elements, *([axis_rotation("z", 0.7)] if group.continuous else [])]
        for matrix in mapped:
            assert np.abs(matrix - np.diag(np.diag(matrix))).max() < 1e-5
            for element in elements:
                np.testing.assert_allclose(element @ matrix, matrix @ element, atol=1e-5)
        free = name not in ("z-90", "z-inf")
        assert (np.abs(mapped[:, 0, 0] - mapped[:, 1, 1]).max() > 0.05) == free, name
