"""The realism measurement's arithmetic, on clouds made by hand."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import torch

from benchmarks.realism import clouds as clouds_module
from benchmarks.realism.__main__ import confusion_matrix, report
from benchmarks.realism.clouds import Clouds, normalise, parametric, real, sample_cloud
from benchmarks.realism.occupancy import overlap, overlaps_by_yaw, projection
from benchmarks.realism.pointnet import MAX_SCALE, augment
from partialbench.dataset.categories import MODELNET40
from renderers.shapes.catalogue import FAMILIES


def labelled(labels: list[int]) -> Clouds:
    """One cloud a label, told apart by its first coordinate."""
    points = np.zeros((len(labels), 4, 3), np.float32)
    points[:, 0, 0] = np.arange(len(labels))
    return Clouds(points, np.array(labels))


def test_normalised_clouds_are_centred_in_the_unit_ball() -> None:
    cloud = np.array([[[2, 0, 0], [4, 0, 0], [2, 1, 3]]])
    expected = np.array([[-1, -0.5, -1.5], [1, -0.5, -1.5], [-1, 0.5, 1.5]]) / np.sqrt(3.5)
    np.testing.assert_allclose(normalise(cloud)[0], expected, atol=1e-6)


def test_real_codes_become_coordinates(tmp_path) -> None:
    codes = np.zeros((1, 3, 2), np.uint16)
    codes[0, :, 0], codes[0, :, 1] = (0, 4095, 4095), (4095, 4095, 4095)
    with h5py.File(tmp_path / "clouds.h5", "w") as h5:
        h5["train/points"], h5["train/label"] = codes, np.array([7], np.uint8)
    found = real(tmp_path / "clouds.h5", "train")
    np.testing.assert_allclose(found.points, [[[-1, 0, 0], [1, 0, 0]]], atol=1e-6)
    assert found.labels.tolist() == [7]


def test_parts_of_every_class_are_disjoint_and_whole() -> None:
    whole = labelled([0] * 10 + [3] * 5)
    first, rest = whole.divided(0.8, np.random.default_rng(0))
    assert np.bincount(first.labels).tolist() == [8, 0, 0, 4]
    identities = np.concatenate([part.points[:, 0, 0] for part in (first, rest)])
    assert sorted(identities) == list(range(15))


def test_at_most_keeps_the_first_of_each_class() -> None:
    kept = labelled([0, 1, 0, 1, 0]).at_most(2)
    assert kept.points[:, 0, 0].tolist() == [0, 1, 2, 3]


def test_sampled_clouds_are_reused_until_their_family_changes(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(clouds_module, "FAMILIES", {"cone": FAMILIES["cone"]})
    made = parametric(tmp_path, range(2))
    assert made.points.shape == (2, 1024, 3)
    (file,) = tmp_path.iterdir()
    np.save(file, made.points + 1)
    np.testing.assert_array_equal(parametric(tmp_path, range(2)).points, made.points + 1)
    monkeypatch.setattr(clouds_module, "GENERATION", "edited")
    np.testing.assert_array_equal(parametric(tmp_path, range(2)).points, made.points)


def test_projections_put_mass_where_the_points_are() -> None:
    here = np.full((1, 5, 3), (0.99, 0.0, -0.99))
    seen = projection(here, (0, 2))
    assert seen[0, -1] == seen.sum() == 1.0
    assert overlap(seen, seen) == 1.0
    assert overlap(seen, projection(-here, (0, 2))) == 0.0


def test_augmented_clouds_keep_their_class_giving_proportions() -> None:
    corners = torch.tensor([[x, y, z] for x in (-1, 1) for y in (-0.1, 0.1) for z in (-0.5, 0.5)])
    made = augment(corners.repeat(64, 8, 1), torch.Generator().manual_seed(0))
    torch.testing.assert_close(made.norm(dim=-1).amax(dim=1), torch.ones(64))
    extent = made.amax(dim=1) - made.amin(dim=1)
    ratio = extent[:, 2] / extent[:, 0]
    assert ratio.min() > 0.5 / MAX_SCALE**2 * 0.9
    assert ratio.max() < 0.5 * MAX_SCALE**2 * 1.2
    assert ratio.std() > 0.05


def test_the_report_counts_by_true_class() -> None:
    test = labelled([0, 0, 0, 0, 5])
    counts = confusion_matrix(test, np.array([0, 0, 0, 5, 5]))
    assert (counts[0, 0], counts[0, 5], counts[5, 5], counts.sum()) == (3, 1, 1, 5)
    text = report(counts)
    assert text.startswith("accuracy 0.800, mean recall 0.875 over 2 classes")
    assert "airplane     recall  75%  precision 100%  taken for bottle 25%" in text
    assert "bottle       recall 100%  precision  50%  taken for nothing else" in text


def test_a_turned_class_is_found_out() -> None:
    rng = np.random.default_rng(0)
    corner = rng.uniform(0.1, 0.9, (20, 50, 3))  # all of it in one octant
    quarter = corner[..., [1, 0, 2]] * (-1, 1, 1)  # turned by 90° about z
    np.testing.assert_allclose(overlaps_by_yaw(quarter, corner), [0, 1, 0, 0], atol=1e-12)


@pytest.fixture(scope="module")
def kept(shared) -> Clouds:
    return real(shared / "data" / "modelnet40_aligned_1024.h5", "train")


def test_real_files_are_read_whole(kept) -> None:
    assert kept.points.shape == (9843, 1024, 3)
    assert np.linalg.norm(kept.points, axis=-1).max() == pytest.approx(1, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("label", range(40))
def test_each_family_stands_in_the_frame_of_its_class(label: int, kept) -> None:
    family = FAMILIES[MODELNET40[label]]
    made = np.stack([sample_cloud(family, i) for i in range(60)])
    unturned, *turned = overlaps_by_yaw(kept.points[kept.labels == label], made)
    assert unturned > 0.65
    assert unturned > max(turned) - 0.03
