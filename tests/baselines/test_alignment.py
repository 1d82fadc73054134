"""What turns a cloud before it is classified: PointNet's T-Nets, IT-Net."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from baselines.itnet import ITNetPointNet2
from baselines.pointnet import PointNet, orthogonality_penalty
from partialbench import registry


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


def test_batch_norms_that_decay_stop_where_the_releases_do() -> None:
    """Their decay is clipped at 0.99."""
    decays = {
        name: card.recipe.schedule_options["bn_momentum"]
        for name, card in registry.cards().items()
        if "bn_momentum" in card.recipe.schedule_options
    }
    assert {"pointnet", "pointnet2-ssg", "itnet-pointnet2"} <= set(decays)
    assert {decay["floor"] for decay in decays.values()} == {0.01}
