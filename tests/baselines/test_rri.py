"""Rotation-invariant features against their formulas, written out."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from baselines import points, rri
from partialbench.errors import InputError
from partialbench.geometry.rotations import haar_rotations

SHORTEST = rri.FADE * rri.RAMP
GENTLE = 0.2
"""A direction shorter than this fades out."""


def nearest_first(features: np.ndarray) -> np.ndarray:
    """Features (N,k,4) with the neighbours in the order of their second number, r_ik."""
    return np.take_along_axis(features, features[..., 1].argsort(axis=1)[..., None], axis=1)


def pairwise_rri(cloud: np.ndarray, k: int) -> list[np.ndarray]:
    """ClusterNet's formulas as written, neighbour by neighbour, each point's rows sorted."""
    features = []
    for i, p in enumerate(cloud):
        near = np.argsort(np.linalg.norm(cloud - p, axis=1))
        q = cloud[near[near != i][:k]]
        p_hat = p / np.linalg.norm(p)
        q_hat = q / np.linalg.norm(q, axis=1, keepdims=True)
        t = q_hat - (q_hat @ p_hat)[:, None] * p_hat
        t /= np.linalg.norm(t, axis=1, keepdims=True)
        psi = np.arctan2(np.cross(t[:, None], t[None]) @ p_hat, t @ t.T) % (2 * np.pi)
        np.fill_diagonal(psi, np.inf)
        theta = np.arccos(q_hat @ p_hat)
        r = np.full(k, np.linalg.norm(p))
        rows = np.stack([r, np.linalg.norm(q, axis=1), theta, psi.min(axis=1)], axis=1)
        features.append(rows[rows[:, 1].argsort()])
    return features


def visible_side(shape: str, number: int, rng: np.random.Generator) -> np.ndarray:
    """Points (N,3), even by area, of the sides of an ellipsoid or a box that a camera sees."""
    half, camera = np.array([1.0, 0.7, 0.45]), np.array([0.3, 0.5, 0.81])
    if shape == "box":
        area = 1 / half
        face = rng.choice(3, size=number, p=area / area.sum())
        cloud = rng.uniform(-half, half, size=(number, 3))
        cloud[np.arange(number), face] = half[face]
        return cloud
    x = rng.normal(size=(20 * number, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    stretch = np.linalg.norm(x / half, axis=1)
    kept = (x / half @ camera > 0) & (rng.random(len(x)) < stretch / stretch.max())
    return (x * half)[kept][:number]


class TestRRI:
    @pytest.mark.parametrize("k", [6, rri.NEIGHBOURS])
    def test_equals_the_pairwise_formula(self, rng: np.random.Generator, k: int) -> None:
        """As defined wherever no follower is within the ramp, and never below it elsewhere."""
        cloud = rng.normal(size=(80, 3)) * 0.5
        cloud -= cloud.mean(axis=0)
        got = rri.rri(torch.from_numpy(cloud[None]).float(), k)[0].numpy()
        plain = 0
        for mine, expected in zip(got, pairwise_rri(cloud, k), strict=True):
            if expected[0, 0] < SHORTEST:
                continue
            mine = mine[np.argsort(mine[:, 1])]
            np.testing.assert_allclose(mine[:, :3], expected[:, :3], atol=1e-5)
            as_defined = expected[:, 3] >= rri.RAMP
            across = np.sin(expected[:, 2]) * expected[:, 1]
            if across.min() < SHORTEST:
                continue
            plain += as_defined.sum()
            phi = np.minimum(expected[:, 3], rri.LARGEST)
            np.testing.assert_allclose(mine[as_defined, 3], phi[as_defined], atol=1e-4)
            assert (mine[~as_defined, 3] >= phi[~as_defined]).all()
        assert plain > 100

    @pytest.mark.parametrize(
        ("shape", "number", "altered", "faded", "mean", "correlation"),
        [
            ("ellipsoid", 256, 0.78, 0.13, 0.38, 0.55),
            ("box", 256, 0.83, 0.18, 0.40, 0.49),
            ("ellipsoid", 1024, 0.91, 0.51, 0.41, 0.35),
            ("box", 1024, 0.93, 0.57, 0.43, 0.25),
        ],
    )
    def test_under_a_gentle_ramp_most_phi_of_32_neighbours_are_not_as_defined(
        self,
        rng: np.random.Generator,
        shape: str,
        number: int,
        altered: float,
        faded: float,
        mean: float,
        correlation: float,
    ) -> None:
        """The figures of the card. Of a neighbour that does not fade, φ is never below its own."""
        cloud = points.normalise(torch.from_numpy(visible_side(shape, number, rng))[None])
        k = rri.NEIGHBOURS
        defined = np.array(pairwise_rri(cloud[0].numpy(), k))
        got = nearest_first(rri.rri(cloud, ramp=GENTLE)[0].numpy())
        np.testing.assert_allclose(got[..., :2], defined[..., :2], atol=1e-9)
        across = np.sin(defined[..., 2]) * defined[..., 1]
        off = np.abs(got[..., 3] - defined[..., 3])
        phi = np.minimum(defined[..., 3], rri.LARGEST)
        own = across >= rri.FADE * GENTLE
        assert (got[own, 3] >= phi[own] - 1e-6).all()
        assert (off > 0.01).mean() == pytest.approx(altered, abs=0.05)
        assert (across < rri.FADE * GENTLE).mean() == pytest.approx(faded, abs=0.05)
        assert defined[..., 3].mean() == pytest.approx(2 * np.pi / k, abs=1e-3)
        assert got[..., 3].mean() == pytest.approx(mean, abs=0.05)
        found = np.corrcoef(got[..., 3].ravel(), defined[..., 3].ravel())[0, 1]
        assert found == pytest.approx(correlation, abs=0.1)

    @pytest.mark.parametrize(("shape", "number"), [("ellipsoid", 256), ("box", 1024)])
    def test_the_ramp_comes_near_the_definition_and_still_holds_rounding(
        self, rng: np.random.Generator, shape: str, number: int
    ) -> None:
        cloud = points.normalise(torch.from_numpy(visible_side(shape, number, rng))[None])
        defined = np.array(pairwise_rri(cloud[0].numpy(), rri.NEIGHBOURS))[..., 3]
        got = nearest_first(rri.rri(cloud)[0].numpy())[..., 3]
        assert np.corrcoef(got.ravel(), defined.ravel())[0, 1] > 0.85
        assert (np.abs(got - defined) > 0.01).mean() < 0.2
        R = torch.from_numpy(haar_rotations(rng, 1)[0]).float()
        upright, turned = (
            rri.rri(points.normalise(c)).sort(dim=2).values
            for c in (cloud.float(), cloud.float() @ R.mT)
        )
        assert (upright - turned).abs().max() < 2e-3

    @pytest.mark.parametrize("number", [1, 31, 32])
    def test_too_few_points_are_refused(self, number: int) -> None:
        """A point is not its own neighbour: 32 of them need 33 points."""
        message = f"32 neighbours need clouds of at least 33 points, got {number}"
        with pytest.raises(InputError, match=message):
            rri.RRIPointNet2(4).eval()(torch.randn(2, number, 3))
        assert rri.rri(points.normalise(torch.randn(2, 33, 3))).isfinite().all()

    @pytest.mark.parametrize("turn", np.linspace(-0.2, 0.2, 9))
    def test_is_continuous_where_directions_pass_each_other(self, turn: float) -> None:
        """Neighbours at 0, turn and 2 rad about p: a change of 1e-6 never makes a jump."""

        def phi(angle: float) -> Tensor:
            angles = torch.tensor([0.0, angle, 2.0])
            q = torch.stack([0.3 * angles.cos(), 0.3 * angles.sin(), torch.ones(3)], dim=-1)
            cloud = torch.cat([torch.tensor([[0.0, 0, 1]]), q, torch.tensor([[0.0, 0, -4]])])
            return rri.rri(cloud[None], k=3)[0, 0, :, 3].sort().values

        steepest = rri.LARGEST / rri.RAMP
        assert (phi(turn + 1e-6) - phi(turn - 1e-6)).abs().max() < 3e-6 * steepest

    def test_tells_mirror_images_apart(self, rng: np.random.Generator) -> None:
        cloud = torch.from_numpy(rng.normal(size=(1, 60, 3))).float()
        cloud = points.normalise(cloud)
        mirrored = rri.rri(cloud * torch.tensor([-1.0, 1, 1]))
        difference = rri.rri(cloud).sort(dim=2).values - mirrored.sort(dim=2).values
        assert difference[..., :3].abs().max() < 1e-5
        assert difference[..., 3].abs().max() > 0.1

    def test_degenerate_neighbourhoods_stay_finite_and_invariant(
        self, rng: np.random.Generator
    ) -> None:
        """A point at the centroid, repeated points, a straight line, a symmetric grid."""
        line = np.linspace(-1, 1, 41)[:, None] * [0.3, 0.5, 0.8]
        grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 4)] * 3), axis=-1).reshape(-1, 3)
        repeated = np.repeat(rng.normal(size=(10, 3)), 6, axis=0)
        for shape in (line, grid, repeated):
            cloud = points.normalise(torch.from_numpy(shape)[None].float())
            R = torch.from_numpy(haar_rotations(rng, 5)).float()
            features = rri.rri(cloud.expand(5, -1, -1) @ R.mT, k=5)
            assert features.isfinite().all()
            assert (features[..., 3] <= rri.LARGEST).all()
        centred = points.normalise(torch.from_numpy(line)[None].float())
        middle = rri.rri(centred, k=4)[0, 20]
        assert middle[:, 0].max() < 1e-6
        assert not middle[:, 2:].any()
        along = rri.rri(centred, k=4)[0, 40]
        torch.testing.assert_close(along[:, 2:], torch.zeros(4, 2), atol=1e-4, rtol=0)

    def test_near_equal_directions_count_as_one(self) -> None:
        """Two neighbours 1e-6 apart in direction both see the gap to the third, in any order."""
        for nudge in (1e-6, -1e-6):
            angles = torch.tensor([0.0, nudge, 1.0])
            q = torch.stack([0.3 * angles.cos(), 0.3 * angles.sin(), torch.ones(3)], dim=-1)
            cloud = torch.cat([torch.tensor([[0.0, 0, 1]]), q, torch.tensor([[0.0, 0, -4]])])
            phi = rri.rri(cloud[None], k=3)[0, 0, :, 3].sort().values
            expected = torch.tensor([1.0, 1.0, rri.LARGEST])
            torch.testing.assert_close(phi, expected, atol=1e-4, rtol=0)
