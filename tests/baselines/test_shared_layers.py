"""Shared layers against the layers they stand for."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from baselines import chunks, edges, maximum, points, shared_mlp
from baselines.balls import without_padding
from baselines.dgcnn import SLOPE, EdgeConv
from baselines.pointnet2 import GroupLinear
from baselines.shared_mlp import NormLinear, SharedMLP


def plain(layer: shared_mlp.Normed, training: bool) -> tuple[nn.Linear, nn.BatchNorm1d]:
    """torch's own two layers with the same parameters, some scales negative; all in one mode."""
    with torch.no_grad():
        layer.norm.weight.uniform_(-1.5, 1.5)
        layer.norm.bias.uniform_(-1, 1)
    linear = nn.Linear(layer.linear.in_features, layer.linear.out_features)
    linear.bias = None if layer.linear.bias is None else linear.bias
    norm = nn.BatchNorm1d(layer.norm.num_features)
    linear.load_state_dict(layer.linear.state_dict())
    norm.load_state_dict(layer.norm.state_dict())
    for module in (layer, linear, norm):
        module.train(training)
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
    weights = weights.to(outputs[0].dtype)
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
        theirs = plain(ours, training)
        assert_same(ours, theirs, (ours(x), normed(*theirs, x)), (x,))

    @pytest.mark.parametrize("slope", [0.0, 0.2, 1.0])
    @pytest.mark.parametrize("bias", [True, False])
    def test_norm_of_few_outputs_and_activation(
        self, training: bool, bias: bool, slope: float, clouds: Tensor
    ) -> None:
        """Its statistics are summed from its values, not from covariances of its inputs."""
        ours = NormLinear(24, 8, bias=bias).double()
        assert ours.linear.in_features**2 > shared_mlp.COVARIANCE_BELOW * ours.linear.out_features
        x = torch.cat([(i + clouds.double()).sin() * 3 + i for i in range(8)], dim=-1)
        x = x.requires_grad_()
        theirs = tuple(module.double() for module in plain(ours, training))
        expected = F.leaky_relu(normed(*theirs, x), slope)
        assert_same(ours, theirs, (ours(x, slope=slope), expected), (x,))

    def test_maximum_over_points(self, training: bool, clouds: Tensor) -> None:
        ours = NormLinear(3, 600)
        x = clouds[:, :150].clone().requires_grad_()
        theirs = plain(ours, training)
        assert_same(ours, theirs, (ours.max(x), normed(*theirs, x).amax(dim=1)), (x,))

    def test_edge_convolution(self, training: bool, clouds: Tensor) -> None:
        ours = EdgeConv(3, 16)
        x = clouds[:, :150].clone().requires_grad_()
        theirs = plain(ours, training)
        neighbours = points.gather(x, points.knn(x, 9))
        centre = x[:, :, None].expand_as(neighbours)
        y = normed(*theirs, torch.cat([neighbours - centre, centre], dim=-1))
        assert_same(ours, theirs, (ours(x, 9), F.leaky_relu(y, SLOPE).amax(dim=2)), (x,))

    @pytest.mark.parametrize("use_xyz", [True, False])
    def test_grouped_layer(self, training: bool, use_xyz: bool, clouds: Tensor) -> None:
        ours = GroupLinear(4, 16, use_xyz)
        theirs = plain(ours, training)
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
    def test_gradients_in_double_precision(
        self, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def values(*shape: int) -> Tensor:
            return torch.from_numpy(rng.normal(size=shape)).requires_grad_()

        index = torch.from_numpy(rng.integers(0, 7, (5, 4)))
        check = torch.autograd.gradcheck
        weight = torch.from_numpy(rng.integers(0, 4, 9)).double()
        assert check(shared_mlp._Moments.apply, (values(9, 3), 9, None))
        assert check(shared_mlp._Moments.apply, (values(9, 3), int(weight.sum()), weight))
        assert check(shared_mlp._LinearMax.apply, (values(3, 6, 2), values(4, 2), values(4)))
        # By visits to the chosen rows:
        monkeypatch.setattr(shared_mlp, "FEW_ROWS", dict.fromkeys((False, True), 0))
        assert check(shared_mlp._LinearMax.apply, (values(3, 6, 2), values(4, 2), values(4)))
        assert check(edges._EdgeMoments.apply, (values(1, 7, 3), values(1, 5, 3), index))
        padded = torch.tensor([[[4, 5, 4, 4], [0, 0, 0, 0], [1, 2, 3, 6], [2, 1, 2, 2]]])
        balls = without_padding(padded, 7)
        assert len(balls.blocks) > 1
        inputs = values(7, 3), values(4, 3), balls, torch.float64
        assert check(edges._EdgeReLU.apply, inputs)
        assert check(edges._NeighbourMax.apply, (values(7, 3), index))
        assert check(maximum.kept_max, values(3, 6, 2))

    def test_work_in_parts_gives_the_same(
        self, monkeypatch: pytest.MonkeyPatch, clouds: Tensor
    ) -> None:
        torch.manual_seed(0)
        mlp = SharedMLP(3, 8, 32)
        whole = mlp.max(clouds)
        whole.square().sum().backward()
        gradients = [p.grad for p in mlp.parameters()]
        mlp.zero_grad()
        monkeypatch.setattr(chunks, "CHUNK", 64)
        parts = mlp.max(clouds)
        parts.square().sum().backward()
        torch.testing.assert_close(parts, whole, atol=1e-5, rtol=1e-5)
        for parameter, gradient in zip(mlp.parameters(), gradients, strict=True):
            torch.testing.assert_close(parameter.grad, gradient, atol=1e-3, rtol=1e-4)

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
    @pytest.mark.parametrize("size", [1, 300, 40_000])
    def test_of_equal_values_the_first_is_the_maximum(self, size: int, dtype: torch.dtype) -> None:
        y = torch.randint(0, 3, (2, size, 5)).to(dtype) - 1
        top, index = y.new_empty(2, 5), torch.empty(2, 5, dtype=torch.int32)
        maximum.maximum(y.clone(), top, index)
        assert torch.equal(top, y.amax(dim=1))
        first = [[row.tolist().index(row.max()) for row in cloud.T] for cloud in y]
        assert index.tolist() == first
        d_top = torch.randn(2, 5).to(dtype)
        expected = torch.zeros_like(y).scatter(1, index.long()[:, None], d_top[:, None])
        assert torch.equal(maximum.spread(d_top, index, size), expected)

    @pytest.mark.parametrize("maximum", [False, True])
    @pytest.mark.parametrize("layers", [(48, 16), (4, 16), (24, 96)])
    def test_half_precision_stays_near_full(self, layers: tuple[int, int], maximum: bool) -> None:
        """Operands keep 8 bits: a relative error of 2⁻⁹ each, 1 % of a product's and a norm's
        gradient. Where the two largest of a group lie nearer than that the gradient of a maximum
        goes to the other row: so do up to 1 in 25 here, and √(2/25) = 0.28 of the norm with it."""
        torch.manual_seed(0)
        layer, x = NormLinear(*layers), torch.randn(30, 25, layers[0], requires_grad=True)
        weights = torch.randn(30, *([] if maximum else [25]), layers[1])
        results = []
        for half in (False, True):
            layer.zero_grad()
            x.grad = None
            with torch.autocast("cpu", torch.bfloat16, enabled=half):
                y = (layer.max(x) if maximum else layer(x, slope=0.0)).float()
            (y * weights).mean().backward()
            found = [y.detach(), x.grad, *(p.grad for p in layer.parameters())]
            assert all(part is not None for part in found)
            results.append([part.clone() for part in found if part is not None])
        (full, *full_grads), (rounded, *rounded_grads) = results
        assert float((rounded - full).norm()) <= 0.01 * float(full.norm())
        for exact, near in zip(full_grads, rounded_grads, strict=True):
            least = 1e-3 * float(full_grads[0].norm())  # a bias before a norm has rounding alone
            bound = 0.28 if maximum else 0.05
            assert float((near - exact).norm()) <= bound * float(exact.norm()) + least

    def test_few_inputs_keep_their_digits_under_autocast(self) -> None:
        """Points 0.001 apart near 1: bfloat16 has steps of 0.004 there and would merge them."""
        x = 1 + 0.001 * torch.randn(64, 16, 3)
        layer = NormLinear(3, 8).train()
        full = layer(x).detach()
        with torch.autocast("cpu", torch.bfloat16):
            half = layer(x)
        assert half.dtype == torch.bfloat16
        assert float((half.float() - full).norm()) <= 0.01 * float(full.norm())

    def test_rows_of_balls_keep_the_digits_of_near_points(self, rng: np.random.Generator) -> None:
        xyz = 0.9 + 0.001 * torch.from_numpy(rng.normal(size=(2, 40, 3))).float()
        index = torch.from_numpy(rng.integers(0, 40, (2, 10, 8)))
        balls, layer = without_padding(index, 40), GroupLinear(0, 16).train()
        full = layer(xyz, None, xyz[:, :10], balls).detach()
        with torch.autocast("cpu", torch.bfloat16):
            half = layer(xyz, None, xyz[:, :10], balls)
        assert half.dtype == torch.bfloat16
        assert float((half.float() - full).norm()) <= 0.01 * float(full.norm())

    def test_variance_survives_a_large_mean(self) -> None:
        """Values near 100 with spread 0.01 keep three digits of their variance."""
        x = 100 + 0.01 * torch.randn(5000, 4, generator=torch.Generator().manual_seed(0))
        _, covariance = shared_mlp._Moments.apply(x, len(x), None)
        expected = np.cov(x.double().numpy().T, bias=True)
        np.testing.assert_allclose(covariance.diagonal(), expected.diagonal(), rtol=1e-3)

    def test_one_value_a_channel_is_refused_in_training(self) -> None:
        with pytest.raises(ValueError, match="more than one value"):
            NormLinear(3, 4)(torch.zeros(1, 1, 3))
