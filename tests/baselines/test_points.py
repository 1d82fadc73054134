"""Point operations against brute force."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from baselines import points
from partialbench.errors import InputError
from partialbench.geometry.rotations import haar_rotations


def brute_distances(a: Tensor, b: Tensor) -> np.ndarray:
    pairs = a.double().numpy()[:, :, None] - b.double().numpy()[:, None]
    return np.linalg.norm(pairs, axis=-1)


class TestNormalise:
    def test_centres_and_scales_wherever_the_cloud_is(self, rng: np.random.Generator) -> None:
        cloud = rng.normal(size=(4, 100, 3)).astype(np.float32)
        moved = torch.from_numpy(cloud) * 3.7 + torch.tensor([1.5, -2, 4])
        out = points.normalise(moved)
        assert out.double().mean(dim=1).abs().max() < 1e-6
        torch.testing.assert_close(out.norm(dim=-1).amax(dim=1), torch.full((4,), points.RADIUS))
        torch.testing.assert_close(
            out, points.normalise(torch.from_numpy(cloud)), atol=2e-6, rtol=0
        )
        assert out.abs().max() < 1

    def test_is_exactly_independent_of_order(self, rng: np.random.Generator) -> None:
        cloud = torch.from_numpy(rng.normal(size=(2, 500, 3)).astype(np.float32)) + 3
        order = torch.from_numpy(rng.permutation(500))
        assert torch.equal(points.normalise(cloud[:, order]), points.normalise(cloud)[:, order])

    def test_coinciding_points_become_zeros(self) -> None:
        assert not points.normalise(torch.full((1, 10, 3), 2.5)).any()

    @pytest.mark.parametrize("shape", [(10, 3), (2, 3, 10), (2, 10, 4), (2, 0, 3)])
    def test_other_shapes_are_refused(self, shape: tuple[int, ...]) -> None:
        with pytest.raises(InputError, match=r"must (be|have)"):
            points.normalise(torch.zeros(shape))


class TestNeighbours:
    @pytest.mark.parametrize("channels", [3, 16])
    def test_distances(self, rng: np.random.Generator, channels: int) -> None:
        a = torch.from_numpy(rng.normal(size=(2, 30, channels)).astype(np.float32))
        b = torch.from_numpy(rng.normal(size=(2, 40, channels)).astype(np.float32))
        np.testing.assert_allclose(points.distances(a, b), brute_distances(a, b), atol=1e-5)

    @pytest.mark.parametrize("channels", [3, 16])
    def test_knn_are_the_nearest(self, rng: np.random.Generator, channels: int) -> None:
        x = torch.from_numpy(rng.normal(size=(2, 60, channels)).astype(np.float32))
        expected = np.argsort(brute_distances(x, x), axis=-1)[..., :7]
        got = points.knn(x, 7).numpy()
        np.testing.assert_array_equal(np.sort(got, axis=-1), np.sort(expected, axis=-1))

    def test_knn_needs_enough_points(self) -> None:
        with pytest.raises(InputError, match="at least 20 points, got 19"):
            points.knn(torch.zeros(1, 19, 3), 20)

    def test_ball_query_keeps_the_first_in_order(self, clouds: Tensor) -> None:
        centres, radius, count = clouds[:, 5:25], 0.3, 12
        inside = brute_distances(centres, clouds) <= radius
        got = points.ball_query(centres, clouds, radius, count).numpy()
        sizes = []
        for b, s in np.ndindex(got.shape[:2]):
            hits = np.flatnonzero(inside[b, s])
            sizes.append(len(hits))
            expected = np.resize(hits[:count], count)
            expected[len(hits) :] = hits[0]
            np.testing.assert_array_equal(got[b, s], expected)
        assert min(sizes) < count < max(sizes)

    def test_ball_query_can_keep_the_nearest(self, clouds: Tensor) -> None:
        cloud = clouds[:, :150]
        distance = brute_distances(cloud[:, 5:25], cloud)
        got = points.ball_query(cloud[:, 5:25], cloud, 0.3, 12, nearest=True).numpy()
        for b, s in np.ndindex(got.shape[:2]):
            order = np.argsort(distance[b, s])
            hits = order[distance[b, s][order] <= 0.3][:12]
            assert set(got[b, s]) == set(hits)
            assert (got[b, s][len(hits) :] == hits[0]).all()

    @pytest.mark.parametrize("nearest", [False, True])
    def test_an_empty_ball_is_an_error(self, clouds: Tensor, nearest: bool) -> None:
        with pytest.raises(InputError, match="no point within"):
            points.ball_query(clouds[:, :4] + 5, clouds, 0.1, 8, nearest)
        with pytest.raises(InputError, match="no point within"):
            points.ball_query(clouds[:, :4] * torch.nan, clouds, 0.1, 8, nearest)

    def test_more_neighbours_than_points_repeat_the_first(self, clouds: Tensor) -> None:
        for nearest in (False, True):
            index = points.ball_query(clouds[:, :1], clouds[:, :4], 3.0, 9, nearest)
            assert index.shape == (3, 1, 9)
            assert (index[..., 4:] == index[..., :1]).all()

    def test_gather(self, rng: np.random.Generator, clouds: Tensor) -> None:
        index = torch.from_numpy(rng.integers(0, 200, (3, 8, 5)))
        expected = torch.stack([clouds[b][index[b]] for b in range(3)])
        assert torch.equal(points.gather(clouds, index), expected)

    def test_no_tensor_holds_every_pair_with_its_channels(self, rng: np.random.Generator) -> None:
        """The largest tensor made is one number a pair."""

        class Largest(TorchDispatchMode):
            numel = 0

            def __torch_dispatch__(self, func, types, args=(), kwargs=None):
                out = func(*args, **(kwargs or {}))
                for tensor in out if isinstance(out, tuple | list) else (out,):
                    if isinstance(tensor, Tensor):
                        # Views made by expand cost no memory.
                        storage = tensor.untyped_storage().nbytes() // tensor.element_size()
                        self.numel = max(self.numel, min(tensor.numel(), storage))
                return out

        x = torch.from_numpy(rng.normal(size=(2, 256, 64)).astype(np.float32))
        with Largest() as seen:
            points.knn(x, 8)
            points.knn(x[..., :3], 8)
            points.ball_query(x[..., :3], x[..., :3], 0.2, 8)
            points.ball_query(x[..., :3], x[..., :3], 0.2, 8, nearest=True)
        assert 0 < seen.numel <= 2 * 256 * 256


class TestFarthestPoints:
    def test_each_is_farthest_from_those_before(self, clouds: Tensor) -> None:
        got = points.farthest_points(clouds, 40).numpy()
        for cloud, chosen in zip(clouds.double().numpy(), got, strict=True):
            assert chosen[0] == 0
            for m in range(1, 40):
                gap = np.linalg.norm(cloud[:, None] - cloud[chosen[:m]], axis=-1).min(axis=1)
                assert gap[chosen[m]] == pytest.approx(gap.max(), abs=1e-6)

    @pytest.mark.parametrize("start", [None, 7])
    def test_sampling_samples_gives_a_prefix(self, clouds: Tensor, start: int | None) -> None:
        first = None if start is None else torch.full((3,), start)
        chosen = points.farthest_points(clouds, 180, first)
        samples = points.gather(clouds, chosen)
        again = points.farthest_points(samples, 60)
        # Repeated points have several indices: positions say that the same were chosen.
        assert torch.equal(points.gather(samples, again), samples[:, :60])
        assert (chosen[:, 0] == (start or 0)).all()

    def test_start_turns_with_the_cloud(self, clouds: Tensor, rng: np.random.Generator) -> None:
        cloud = clouds[:, :150]
        R = torch.from_numpy(haar_rotations(rng, 3)).float()
        assert torch.equal(
            points.farthest_from_centre(cloud @ R.mT), points.farthest_from_centre(cloud)
        )


def test_the_smallest_are_topks_whatever_their_sign() -> None:
    values = torch.randn(40, 300)
    values[0, :9], values[0, 9:12], values[1, 5] = 0.0, -0.0, -torch.inf
    found, index = points.smallest(values, 30)
    expected = values.topk(30, dim=-1, largest=False).values
    assert torch.equal(found, expected)
    assert torch.equal(values.gather(1, index), expected)
    zeros = values[0].abs() == 0
    ties = [int(i) for i in points.smallest(values[:1], 300)[1][0] if zeros[i]]
    assert ties == sorted(ties)
