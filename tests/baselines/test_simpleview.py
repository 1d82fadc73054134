"""SimpleView: what a depth image is, by hand, and parity with the published implementation."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from baselines.simpleview import SimpleView, depth_images, view_rotations
from partialbench.errors import InputError
from partialbench.registry import load_published


def test_views_look_along_the_six_half_axes() -> None:
    R = view_rotations()
    assert torch.allclose(R @ R.transpose(1, 2), torch.eye(3).expand(6, 3, 3))
    assert torch.linalg.det(R).tolist() == pytest.approx([1] * 6)
    axes = {tuple(row.int().tolist()) for row in R[:, 2]}  # depth of p is row 2 · p
    assert axes == {(0, 0, 1), (0, 0, -1), (0, 1, 0), (0, -1, 0), (1, 0, 0), (-1, 0, 0)}


def test_a_point_on_the_axis_is_seen_at_its_distance_in_one_pixel() -> None:
    images = depth_images(torch.tensor([[[0.0, 0.0, 0.5]]]))
    assert (images > 0).sum((2, 3)).tolist() == [[1] * 6]
    # Pixel 63 covers u in (−1/128, 1/128] after ceil(64 − 0.5) = 64: the point's own pixel.
    depths = sorted(images.amax((2, 3))[0].tolist())
    assert depths == pytest.approx([0.9, 1.4, 1.4, 1.4, 1.4, 1.9])
    assert images[0, 0, 64, 64] in (pytest.approx(0.9), pytest.approx(1.9))


def test_points_that_share_a_pixel_give_the_harmonic_mean_of_their_depth() -> None:
    along = int(view_rotations()[0, 2].abs().argmax())
    points = torch.zeros(1, 2, 3)
    points[0, :, along] = torch.tensor([0.6, -0.4])
    image = depth_images(points)[0, 0]
    assert image[64, 64] == pytest.approx(2 / (1 / 2.0 + 1 / 1.0))
    assert (image > 0).sum() == 1


def test_points_outside_the_image_are_left_out_not_wrapped() -> None:
    # At the near side of the ball the field of view is 0.4 wide.
    R = view_rotations()[0]
    seen = torch.tensor([[0.9, 0.0, -1.0], [0.0, 0.0, -1.0]])  # in the view's frame
    image = depth_images((seen @ R)[None])[0, 0]
    assert image.nonzero().tolist() == [[64, 64]]


def test_published_depth_images_and_logits(shared) -> None:
    fixture = np.load(shared / "parity" / "simpleview.npz")
    points = torch.as_tensor(fixture["points"])
    images = depth_images(points).flatten(0, 1).unsqueeze(1)
    assert np.abs(images.numpy() - fixture["depth_images"]).max() < 1e-5
    state = {k.removeprefix("state/"): fixture[k] for k in fixture if k.startswith("state/")}
    model = load_published("simpleview", state, 40)
    with torch.no_grad():
        logits = model(points).class_logits
        other_views = model(points.flip(-1)).class_logits
    assert np.abs(logits.numpy() - fixture["logits"]).max() < 1e-4
    assert np.abs(other_views.numpy() - fixture["logits"]).max() > 1e-3


@pytest.mark.parametrize(("classes", "count"), [(40, 803_992), (15, 800_767)])
def test_parameter_count(classes: int, count: int) -> None:
    assert sum(p.numel() for p in SimpleView(classes).parameters()) == count


def test_smaller_images_take_the_same_weights_and_give_other_logits() -> None:
    torch.manual_seed(0)
    full, small = SimpleView(7), SimpleView(7, image=32)
    small.load_state_dict(full.state_dict())
    points = torch.randn(2, 100, 3)
    logits = [model.eval()(points).class_logits for model in (full, small)]
    assert logits[1].shape == (2, 7)
    assert not torch.allclose(*logits)
    with pytest.raises(InputError, match="image must be positive, got 0"):
        SimpleView(7, image=0)
