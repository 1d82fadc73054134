"""RIConv++'s ring, its quirks and its axes; the camera's ray."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from baselines.camera import camera_ray
from baselines.lra import local_axes
from baselines.points import farthest_points
from baselines.riconv2 import RIConv2, ring_keys
from partialbench.errors import InputError
from partialbench.geometry.rotations import haar_rotations


def on_a_circle(degrees: list[float], radius: list[float]) -> torch.Tensor:
    angle = torch.tensor(degrees, dtype=torch.float64).deg2rad()
    r = torch.tensor(radius, dtype=torch.float64)
    return torch.stack([r * angle.cos(), r * angle.sin(), torch.zeros_like(r)], dim=-1)


def test_keys_go_once_round_the_ring() -> None:
    """Seen against the axis z: u × r points along it for neighbours clockwise of the start."""
    relative = on_a_circle([0, -60, -120, 180, 120, 60], [1, 0.5, 0.5, 0.5, 0.5, 0.5])
    key = ring_keys(relative, torch.tensor([0, 0, 1.0], dtype=torch.float64), centre_first=False)
    cosine = [1, 0.5, -0.5, -1, -2 + 0.5, -2 - 0.5]
    torch.testing.assert_close(key, torch.tensor(cosine, dtype=torch.float64))
    assert (key.diff() < 0).all()


def test_the_ring_starts_at_the_longest_whatever_rounding_says(rng: np.random.Generator) -> None:
    relative = torch.from_numpy(rng.normal(size=(200, 9, 3)))
    axis = local_axes(relative)
    across = relative - (relative * axis[:, None]).sum(-1, keepdim=True) * axis[:, None]
    start = across.norm(dim=-1).argmax(dim=-1, keepdim=True)
    key = ring_keys(relative, axis, centre_first=False)
    torch.testing.assert_close(key.gather(1, start), torch.ones(200, 1, dtype=torch.float64))
    turn = torch.from_numpy(haar_rotations(rng, 1)[0])
    torch.testing.assert_close(ring_keys(relative @ turn.T, axis @ turn.T, False), key)
    loose = ring_keys(relative, axis, False, frozenset({"signs"})).gather(1, start)
    assert (loose < 0).any(), "left to rounding, it is on either side"


def test_an_axis_is_the_normal_of_a_plane() -> None:
    relative = on_a_circle([0, 50, 130, 200, 300], [0.1, 0.2, 0.3, 0.4, 0.5])
    torch.testing.assert_close(local_axes(relative).abs(), relative.new_tensor([0, 0, 1]))
    assert local_axes(torch.zeros(5, 3)).norm() == pytest.approx(1), "all in one place"


def answers(clouds: torch.Tensor, **options: object) -> torch.Tensor:
    torch.manual_seed(0)
    model = RIConv2(5, **options).eval()  # type: ignore[arg-type]
    with torch.no_grad():
        return model(clouds).class_logits


def test_a_batch_of_three_answers_as_any_other(clouds: torch.Tensor) -> None:
    assert len(clouds) == 3
    together = answers(clouds)
    alone = torch.cat([answers(cloud[None]) for cloud in clouds])
    torch.testing.assert_close(together, alone, atol=1e-5, rtol=1e-4)
    published = answers(clouds, quirks="cross")
    assert (published - together).abs().max() > 1e-3 * together.abs().max()
    torch.testing.assert_close(answers(clouds[:2], quirks="cross"), together[:2])


def test_options_are_checked(clouds: torch.Tensor) -> None:
    with pytest.raises(InputError, match="no quirk 'strat'; did you mean start"):
        RIConv2(5, quirks="ring+strat")
    with pytest.raises(InputError, match="orient must be centroid or camera"):
        RIConv2(5, orient="up")
    with pytest.raises(InputError, match="centred on the origin"):
        answers(clouds, orient="camera")
    away = clouds + torch.tensor([0.3, -0.2, 3.0])
    assert not torch.allclose(answers(away), answers(away, orient="camera"))
    assert not torch.allclose(answers(away), answers(away, signed_angles=True))


def test_the_ray_points_from_the_camera_to_the_cloud() -> None:
    points = torch.randn(2, 50, 3)
    points = points - points.mean(dim=1, keepdim=True)
    ray = camera_ray(points + torch.tensor([[[0, 0, 4.0]], [[30, 0, 40.0]]]))
    torch.testing.assert_close(ray, torch.tensor([[0, 0, 1.0], [0.6, 0, 0.8]]))
    with pytest.raises(InputError, match="nothing says where its camera was"):
        camera_ray(points)


def test_sampling_without_repeats_is_a_permutation() -> None:
    points = torch.randn(1, 20, 3).repeat(1, 2, 1)
    order = farthest_points(points, 40, repeat=False)
    assert order.sort().values.tolist() == [list(range(40))]
    assert torch.equal(order[:, :20], farthest_points(points, 20))
    assert math.isclose(
        float(points[0, order[0, :20]].sum()), float(points[0, :20].sum()), abs_tol=1e-4
    )


def on_a_lattice(rng: np.random.Generator, flat: bool) -> torch.Tensor:
    """Clouds (4,160,3) of three walls, or one, whose coordinates are small whole numbers."""
    places = np.stack(np.meshgrid(*3 * [np.arange(9)], indexing="ij"), axis=-1).reshape(-1, 3)
    walls = places[(places[:, 0] == 0) if flat else (places == 0).any(axis=1)]
    extra = rng.uniform(0, 8, size=(4, 100, 3)) * ([0, 1, 1] if flat else [1, 1, 1])
    return torch.stack(
        [
            torch.from_numpy(np.concatenate([rng.permutation(walls)[:60], loose])).float()
            for loose in extra
        ]
    )


@pytest.mark.parametrize("flat", [False, True], ids=["walls", "flat"])
def test_ties_are_not_left_to_the_turned_coordinates_rounding(
    rng: np.random.Generator, flat: bool
) -> None:
    points = on_a_lattice(rng, flat)
    points = (points - points.mean(dim=1, keepdim=True)) / 8
    turned = points @ torch.from_numpy(haar_rotations(rng, 4)).float().mT

    def moved(**options: object) -> float:
        before = answers(points, **options)
        return float((answers(turned, **options) - before).abs().max() / before.abs().max())

    assert moved() <= 1e-4
    assert moved(quirks="ties") > 1e-3
