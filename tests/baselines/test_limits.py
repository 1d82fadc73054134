"""What models refuse: options beyond their limits or without effect, and clouds that are none."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from baselines import points
from baselines.lra import LEAST_OF_AXES
from partialbench import registry
from partialbench.benchmark import models
from partialbench.errors import InputError


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        *[(name, {"k": k}, f"k must be at least 1, got {k}")
          for name in ("dgcnn", "vn-dgcnn", "vn-pointnet", "rri-pointnet2", "pari-conv",
                       "local-to-global", "canonical-vn") for k in (0, -1)],
        ("itnet-pointnet2", {"iterations": 0}, "iterations must be at least 1"),
        ("rri-pointnet2", {"ramp": 0.0}, "ramp must be an angle in radians above 0"),
        ("rri-pointnet2", {"ramp": 1.6}, "below π/2"),
        ("riconv2", {"lra_neighbours": LEAST_OF_AXES - 1}, "lra_neighbours must be at least 4"),
        ("riconv2", {"lra_neighbours": -1}, "lra_neighbours must be at least 4"),
        ("riconv2", {"centres": 0}, "centres must be at least 1"),
        ("riconv2", {"normals": True}, "has no option 'normals'"),
        ("riconv2", {"orient": "camera", "quirks": "signs"}, "orient=camera turns local axes"),
        ("local-to-global", {"orient": "camera", "quirks": "signs"}, "orient=camera turns local"),
        # Options of local axes, which normals replace; and of no type at all.
        ("riconv2-normals", {"orient": "camera"}, "has no option 'orient'"),
        ("riconv2-normals", {"lra_neighbours": 64}, "has no option 'lra_neighbours'"),
        ("riconv2-normals", {"normals": False}, "has no option 'normals'"),
        ("riconv2-normals", {"centers": 512}, "did you mean centres"),
        ("riconv2-normals", {"centres": 512.5}, "centres must be a whole number"),
        ("riconv2-normals", {"signed_angles": "yes"}, "signed_angles must be true or false"),
        ("canonical-vn", {"backbone": "riconv2-normals"}, "takes normals, which a frame does not"),
        ("canonical-pca24", {"backbone": "riconv2-normals"}, "takes normals, which a frame does"),
    ],
)  # fmt: skip
def test_options_beyond_their_limits_are_refused(
    name: str, options: dict[str, object], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        registry.create(name, 5, **options)


def make(classes: int, name: str = "a", num_classes: int = 2) -> nn.Module:
    model = nn.Linear(3, classes)
    model.called = (name, num_classes)  # type: ignore[assignment]
    return model


def test_options_may_have_the_names_of_our_own_arguments() -> None:
    options = {"name": "b", "num_classes": 7}
    model = models.create(f"{__name__}:make", 4, options)
    assert (model.out_features, model.called) == (4, ("b", 7))


@pytest.mark.parametrize("what", [torch.nan, torch.inf])
@pytest.mark.parametrize(
    ("name", "options"),
    [("pointnet", {}), ("steerable-cnn", {"grid": 8}), ("papnet", {"grid": 16}), ("riconv2", {}),
     ("canonical-pca24", {}), ("papnet-steered-nopose", {})],
)  # fmt: skip
def test_clouds_of_no_finite_extent_are_refused(
    clouds: Tensor, name: str, options: dict[str, int], what: float
) -> None:
    """A voxel grid leaves out what is nowhere: its models answered as if nothing were wrong."""
    model = registry.create(name, 5, **options).eval()
    broken = clouds.clone()
    broken[1, 3, 2] = what
    with pytest.raises(InputError, match="cloud 1 of the batch has coordinates that are NaN"):
        model(broken)


def test_an_extent_that_overflows_or_is_rounding_is_none(clouds: Tensor) -> None:
    """In single precision the first became zeros, the second a cloud smaller than it should be."""
    assert points.normalise(clouds.double() * 1e25).norm(dim=-1).amax() < 1
    with pytest.raises(InputError, match="too large for float32"):
        points.normalise(clouds * 1e25)
    assert points.normalise(clouds * 1e-9).norm(dim=-1).amax() == pytest.approx(points.RADIUS)
    for tiny in (clouds * 1e-14, torch.full((1, 1000, 3), 3.3, dtype=torch.float64)):
        with pytest.raises(InputError, match="cloud 0 of the batch reaches"):
            points.normalise(tiny)


@pytest.mark.parametrize("name", ["rri-pointnet2", "riconv2", "vn-dgcnn", "local-to-global"])
@pytest.mark.parametrize(
    "made", [torch.zeros(2, 64, 3, dtype=torch.complex64), torch.zeros(2, 64, 3).long()]
)
def test_models_in_double_precision_take_floating_clouds_too(name: str, made: Tensor) -> None:
    with pytest.raises(InputError, match="must be a floating"):
        registry.create(name, 5).eval()(made)


def test_an_array_is_told_how_to_become_a_tensor(clouds: Tensor) -> None:
    with pytest.raises(InputError, match=r"got a ndarray; torch\.as_tensor"):
        registry.create("pointnet", 5)(clouds.numpy())


@pytest.mark.parametrize("name", ["riconv2-normals", "local-to-global"])
def test_normals_are_one_for_each_point(clouds: Tensor, name: str) -> None:
    model = registry.create(name, 5).eval()
    normals = nn.functional.normalize(clouds, dim=-1)
    with torch.no_grad():
        answer = model(clouds, normals=normals).class_logits
        assert torch.allclose(model(clouds, normals=3 * normals).class_logits, answer, atol=1e-5)
    more = torch.cat([normals, normals], dim=1)
    for wrong in (more, normals[:, :50], normals.mT, normals[:1], (100 * normals).long()):
        with pytest.raises(InputError, match="normals must be a floating tensor of the clouds'"):
            model(clouds, normals=wrong)
    unknown = normals.clone()
    unknown[0, 5] = torch.nan
    with pytest.raises(InputError, match="1 of 600 normals are NaN"):
        model(clouds, normals=unknown)
