"""Point operations against brute force; shared layers against the layers they stand for."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from baselines import edges, points, rri, shared_mlp
from baselines.balls import without_padding
from baselines.dgcnn import SLOPE, EdgeConv
from baselines.itnet import ITNetPointNet2
from baselines.pointnet import PointNet, orthogonality_penalty
from baselines.pointnet2 import GroupLinear
from baselines.shared_mlp import NormLinear, SharedMLP
from partialbench.errors import InputError
from partialbench.geometry.rotations import haar_rotations


@pytest.fixture(autouse=True)
def seed() -> None:
    torch.manual_seed(0)


@pytest.fixture
def clouds(rng: np.random.Generator) -> Tensor:
    """(3,200,3) in the unit ball, with repeated points as clouds of few pixels have."""
    cloud = rng.normal(size=(3, 200, 3)) * (0.5, 0.3, 0.2)
    cloud[:, 150:] = cloud[:, :50]
    return points.normalise(torch.from_numpy(cloud).float())


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


def plain(layer: shared_mlp.Normed) -> tuple[nn.Linear, nn.BatchNorm1d]:
    """torch's own two layers with the same parameters, some scales negative."""
    with torch.no_grad():
        layer.norm.weight.uniform_(-1.5, 1.5)
        layer.norm.bias.uniform_(-1, 1)
    linear = nn.Linear(layer.linear.in_features, layer.linear.out_features)
    linear.bias = None if layer.linear.bias is None else linear.bias
    norm = nn.BatchNorm1d(layer.norm.num_features)
    linear.load_state_dict(layer.linear.state_dict())
    norm.load_state_dict(layer.norm.state_dict())
    return linear, norm


def normed(linear: nn.Linear, norm: nn.BatchNorm1d, x: Tensor) -> Tensor:
    y = linear(x)
    return norm(y.flatten(0, -2)).view_as(y)


def assert_same(
    ours: shared_mlp.Normed,
    theirs: tuple[nn.Linear, nn.BatchNorm1d],
    outputs: tuple[Tensor, Tensor],
    inputs: tuple[Tensor, ...],
) -> None:
    """Values, gradients of inputs and parameters, and running statistics agree."""
    weights = torch.randn(outputs[0].shape, generator=torch.Generator().manual_seed(3))
    torch.testing.assert_close(outputs[0], outputs[1], atol=2e-5, rtol=1e-5)
    linear, norm = theirs
    pairs = [(ours.linear.weight, linear.weight), (ours.norm.weight, norm.weight)]
    pairs += [(ours.norm.bias, norm.bias), *((x, x) for x in inputs)]
    mine = torch.autograd.grad((outputs[0] * weights).sum(), [a for a, _ in pairs])
    yours = torch.autograd.grad((outputs[1] * weights).sum(), [b for _, b in pairs])
    for a, b in zip(mine, yours, strict=True):
        torch.testing.assert_close(a, b, atol=2e-5 * float(b.abs().max()), rtol=1e-4)
    for name, value in norm.state_dict().items():
        torch.testing.assert_close(ours.norm.state_dict()[name], value, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("training", [True, False])
class TestLayersEqualTheirPlainForm:
    """Each shared layer is nn.Linear and nn.BatchNorm1d on every edge, in value and gradient."""

    @pytest.mark.parametrize("bias", [True, False])
    def test_norm_linear(self, training: bool, bias: bool, clouds: Tensor) -> None:
        ours = NormLinear(5, 8, bias=bias)
        x = torch.cat([clouds * 3 + 1, clouds[..., :2]], dim=-1).requires_grad_()
        theirs = plain(ours)
        for module in (ours, *theirs):
            module.train(training)
        assert_same(ours, theirs, (ours(x), normed(*theirs, x)), (x,))

    def test_maximum_over_points(self, training: bool, clouds: Tensor) -> None:
        ours = NormLinear(3, 600)
        x = clouds[:, :150].clone().requires_grad_()
        theirs = plain(ours)
        for module in (ours, *theirs):
            module.train(training)
        assert_same(ours, theirs, (ours.max(x), normed(*theirs, x).amax(dim=1)), (x,))

    def test_edge_convolution(self, training: bool, clouds: Tensor) -> None:
        ours = EdgeConv(3, 16)
        x = clouds[:, :150].clone().requires_grad_()
        theirs = plain(ours)
        for module in (ours, *theirs):
            module.train(training)
        neighbours = points.gather(x, points.knn(x, 9))
        centre = x[:, :, None].expand_as(neighbours)
        y = normed(*theirs, torch.cat([neighbours - centre, centre], dim=-1))
        assert_same(ours, theirs, (ours(x, 9), F.leaky_relu(y, SLOPE).amax(dim=2)), (x,))

    @pytest.mark.parametrize("use_xyz", [True, False])
    def test_grouped_layer(self, training: bool, use_xyz: bool, clouds: Tensor) -> None:
        ours = GroupLinear(4, 16, use_xyz)
        theirs = plain(ours)
        for module in (ours, *theirs):
            module.train(training)
        features = torch.cat([clouds.square(), clouds[..., :1]], dim=-1).requires_grad_()
        centres = clouds[:, :30]
        index = points.ball_query(centres, clouds, 0.4, 10)
        relative = [points.gather(clouds, index) - centres[:, :, None]] if use_xyz else []
        grouped = torch.cat([*relative, points.gather(features, index)], dim=-1)
        balls = without_padding(index, clouds.shape[1])
        rows = ours(clouds, features, centres, balls) * balls.weight[:, None]
        sums = rows.new_zeros(90, 16).index_add(0, balls.centre, rows).view(3, 30, 16)
        expected = normed(*theirs, grouped).relu().sum(dim=2)
        assert_same(ours, theirs, (sums, expected), (features,))


class TestLayers:
    def test_gradients_in_double_precision(self, rng: np.random.Generator) -> None:
        def values(*shape: int) -> Tensor:
            return torch.from_numpy(rng.normal(size=shape)).requires_grad_()

        index = torch.from_numpy(rng.integers(0, 7, (5, 4)))
        check = torch.autograd.gradcheck
        weight = torch.from_numpy(rng.integers(0, 4, 9)).double()
        assert check(shared_mlp._Moments.apply, (values(9, 3), 9, None))
        assert check(shared_mlp._Moments.apply, (values(9, 3), int(weight.sum()), weight))
        assert check(shared_mlp._LinearMax.apply, (values(3, 6, 2), values(4, 2), values(4)))
        assert check(edges._EdgeMoments.apply, (values(7, 3), values(5, 3), index))
        centre = torch.arange(5).repeat_interleave(4)
        assert check(edges._EdgeReLU.apply, (values(7, 3), values(5, 3), index.flatten(), centre))
        assert check(edges._NeighbourMax.apply, (values(7, 3), index))

    def test_work_in_parts_gives_the_same(
        self, monkeypatch: pytest.MonkeyPatch, clouds: Tensor
    ) -> None:
        torch.manual_seed(0)
        mlp = SharedMLP(3, 8, 32)
        whole = mlp.max(clouds)
        whole.square().sum().backward()
        gradients = [p.grad for p in mlp.parameters()]
        mlp.zero_grad()
        monkeypatch.setattr(shared_mlp, "CHUNK", 64)
        parts = mlp.max(clouds)
        parts.square().sum().backward()
        torch.testing.assert_close(parts, whole, atol=1e-5, rtol=1e-5)
        for parameter, gradient in zip(mlp.parameters(), gradients, strict=True):
            torch.testing.assert_close(parameter.grad, gradient, atol=1e-3, rtol=1e-4)

    def test_variance_survives_a_large_mean(self) -> None:
        """Values near 100 with spread 0.01 keep three digits of their variance."""
        x = 100 + 0.01 * torch.randn(5000, 4, generator=torch.Generator().manual_seed(0))
        _, covariance = shared_mlp._Moments.apply(x, len(x), None)
        expected = np.cov(x.double().numpy().T, bias=True)
        np.testing.assert_allclose(covariance.diagonal(), expected.diagonal(), rtol=1e-3)

    def test_one_value_a_channel_is_refused_in_training(self) -> None:
        with pytest.raises(ValueError, match="more than one value"):
            NormLinear(3, 4)(torch.zeros(1, 1, 3))


class TestPointNet:
    def test_penalty_by_hand(self) -> None:
        """T = 2I in three dimensions: TTᵀ − I = 3I, ½·27 each, summed over two clouds."""
        assert orthogonality_penalty(2 * torch.eye(3).expand(2, 3, 3)) == pytest.approx(27)

    def test_transforms_start_at_the_identity(self, clouds: Tensor) -> None:
        torch.manual_seed(0)
        model = PointNet(5)
        out = model.input_transform(clouds)
        torch.testing.assert_close(out, torch.eye(3).flatten().expand(3, 9))
        assert model(clouds).penalty == 0


class TestITNet:
    def test_pose_is_the_product_of_the_steps(self, clouds: Tensor) -> None:
        """A T-Net that always turns 90° about z and moves by (1, 0, 0): two steps by hand."""
        model = ITNetPointNet2(5)
        half = 0.5**0.5
        last = list(model.transform.parameters())[-1]
        with torch.no_grad():
            last.copy_(torch.tensor([3 * half, 0, 0, 3 * half, 1, 0, 0]))
        R, t = model.pose(clouds)
        expected_R = torch.tensor([[-1.0, 0, 0], [0, -1, 0], [0, 0, 1]]).expand(3, 3, 3)
        torch.testing.assert_close(R, expected_R, atol=1e-6, rtol=0)
        torch.testing.assert_close(t, torch.tensor([[1.0, 1, 0]]).expand(3, 3), atol=1e-6, rtol=0)

    def test_points_entering_an_iteration_carry_no_gradient(self, clouds: Tensor) -> None:
        model = ITNetPointNet2(5)
        cloud = clouds.clone().requires_grad_()
        R, t = model.pose(cloud)
        (R.square().sum() + t.sum()).backward()
        assert cloud.grad is None
        reached = list(model.transform.parameters())[-1].grad
        assert reached is not None
        assert reached.abs().sum() > 0


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
        rows = []
        for a in range(k):
            psi = [
                np.arctan2(np.cross(t[a], t[b]) @ p_hat, t[a] @ t[b]) % (2 * np.pi)
                for b in range(k)
                if b != a
            ]
            theta = np.arccos(q_hat[a] @ p_hat)
            rows.append([np.linalg.norm(p), np.linalg.norm(q[a]), theta, min(psi)])
        features.append(np.array(sorted(rows, key=lambda row: row[1])))
    return features


class TestRRI:
    def test_equals_the_pairwise_formula(self, rng: np.random.Generator) -> None:
        """As defined wherever no follower is within the ramp, and never below it elsewhere."""
        cloud = rng.normal(size=(80, 3)) * 0.5
        cloud -= cloud.mean(axis=0)
        got = rri.rri(torch.from_numpy(cloud[None]).float(), k=6)[0].numpy()
        plain = 0
        for mine, expected in zip(got, pairwise_rri(cloud, 6), strict=True):
            if expected[0, 0] < rri.FADE:
                continue
            mine = mine[np.argsort(mine[:, 1])]
            np.testing.assert_allclose(mine[:, :3], expected[:, :3], atol=1e-5)
            as_defined = expected[:, 3] >= rri.RAMP
            across = np.sin(expected[:, 2]) * expected[:, 1]
            if across.min() < rri.FADE:
                continue
            plain += as_defined.sum()
            phi = np.minimum(expected[:, 3], rri.LARGEST)
            np.testing.assert_allclose(mine[as_defined, 3], phi[as_defined], atol=1e-4)
            assert (mine[~as_defined, 3] >= phi[~as_defined]).all()
        assert plain > 100

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
