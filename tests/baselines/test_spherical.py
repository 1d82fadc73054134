"""The spherical transform against independent quadrature, and the spherical CNN's symmetry."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import scipy.special
import torch
from scipy.spatial.transform import Rotation

from baselines.spherical_cnn import (
    AreaPool,
    Block,
    SphericalCNN,
    ZonalConvolution,
    cell_areas,
    extent,
)
from baselines.spherical_transform import (
    SphericalTransform,
    colatitudes,
    directions,
    legendre,
    longitudes,
    quadrature_weights,
)


def harmonic(degree: int, m: int, theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Y_lm by scipy, under either of its names."""
    if hasattr(scipy.special, "sph_harm_y"):
        return scipy.special.sph_harm_y(degree, m, theta, phi)
    return scipy.special.sph_harm(m, degree, phi, theta)


def gauss_legendre_coefficient(f, degree: int, m: int, order: int = 80) -> complex:
    """∫ f·conj(Y_lm) over the sphere by Gauss–Legendre in cos θ and the trapezoid rule in φ."""
    t, w = np.polynomial.legendre.leggauss(order)
    theta, phi = np.meshgrid(np.arccos(t), 2 * np.pi * np.arange(2 * order) / (2 * order))
    values = f(theta, phi) * harmonic(degree, m, theta, phi).conj()
    return (values * w).sum() * 2 * np.pi / (2 * order)


@pytest.mark.parametrize("n", [8, 16, 64])
def test_quadrature_is_exact_for_polynomials_below_n(n: int) -> None:
    t, w = np.cos(colatitudes(n)), quadrature_weights(n)
    for power in range(n):
        integral = 0.0 if power % 2 else 2 / (power + 1)
        assert (w * t**power).sum() == pytest.approx(integral, abs=1e-12)
    midpoint = np.pi / n * np.sin(colatitudes(n))  # what one would write without the theorem
    assert abs((midpoint * t**2).sum() - 2 / 3) > 1e-4


def test_legendre_table_is_scipys_harmonics_at_longitude_zero() -> None:
    theta = colatitudes(64)
    for degree, m in [(0, 0), (1, 1), (5, 3), (31, 0), (31, 31)]:
        expected = harmonic(degree, m, theta, np.zeros(64)).real
        assert np.abs(legendre(64)[m, degree] - expected).max() < 1e-11


def test_coefficients_agree_with_gauss_legendre_quadrature() -> None:
    def f(theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
        x, y, z = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)
        return 1 + 2 * x * y**2 * z - z**5 + 3 * x**7 * y

    theta, phi = np.meshgrid(colatitudes(32), longitudes(32), indexing="ij")
    grid = torch.tensor(f(theta, phi))
    coefficients = SphericalTransform(32).double()(grid).numpy()
    for degree in range(0, 16, 3):
        for m in range(0, degree + 1, 2):
            expected = gauss_legendre_coefficient(f, degree, m)
            assert coefficients[m, degree] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("n", [8, 16, 64])
def test_transform_of_an_inverse_is_the_identity(n: int) -> None:
    generator = torch.Generator().manual_seed(0)
    band = n // 2
    coefficients = torch.randn(band, band, 3, dtype=torch.complex128, generator=generator)
    m, degree = np.meshgrid(np.arange(band), np.arange(band), indexing="ij")
    coefficients[torch.tensor(m > degree)] = 0
    coefficients[0] = coefficients[0].real.to(coefficients.dtype)  # of a real function
    transform = SphericalTransform(n).double()
    back = transform(transform.inverse(coefficients))
    assert (back - coefficients).abs().max() < 1e-5 * coefficients.abs().max()


def test_zonal_convolution_commutes_with_rotation() -> None:
    """A band-limited function turned by any rotation, then convolved: the convolved one, turned."""
    torch.manual_seed(0)
    n = 16
    layer = ZonalConvolution(1, 2, n).double()
    R = Rotation.random(random_state=3).as_matrix()
    generator = np.random.default_rng(0)
    coefficients = [generator.standard_normal(2 * degree + 1) for degree in range(n // 2)]

    def evaluate(at: np.ndarray, scale: np.ndarray) -> torch.Tensor:
        theta, phi = np.arccos(np.clip(at[..., 2], -1, 1)), np.arctan2(at[..., 1], at[..., 0])
        total = np.zeros(at.shape[:-1])
        for degree, c in enumerate(coefficients):
            for m in range(degree + 1):
                Y = harmonic(degree, m, theta, phi)
                total += scale[degree] * (c[m] * Y.real + (c[-m] * Y.imag if m else 0))
        return torch.tensor(total)

    filters = torch.einsum("ioa,al->lio", layer.anchors, layer.interpolation)[:, 0]
    omega = directions(n)
    with torch.no_grad():
        for turn in (np.eye(3), R):
            out = layer(evaluate(omega @ turn, np.ones(n // 2))[None, None])[0]
            for channel in range(2):
                expected = evaluate(omega @ turn, filters[:, channel].detach().numpy())
                assert (out[channel] - expected).abs().max() < 1e-5
    assert (out[0] - evaluate(omega, filters[:, 0].detach().numpy())).abs().max() > 0.1


@pytest.mark.parametrize("training", [True, False])
def test_a_block_is_its_layers_one_after_the_other(training: bool) -> None:
    torch.manual_seed(0)
    block = Block(3, 4, 16).double().train(training)
    with torch.no_grad():
        block.shift.normal_()
        block.activation.weight.uniform_(-0.5, 1.5)
    x = torch.randn(2, 3, 16, 16, dtype=torch.double, requires_grad=True)
    plain = copy.deepcopy(block)
    found = block(x)
    expected = plain.activation(plain.norm(plain.convolution(x)) + plain.shift)
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(block.norm.state_dict(), plain.norm.state_dict())
    weight = torch.randn_like(found)
    for a, b in zip(
        torch.autograd.grad((found * weight).sum(), [x, *block.parameters()]),
        torch.autograd.grad((expected * weight).sum(), [x, *plain.parameters()]),
        strict=True,
    ):
        torch.testing.assert_close(a, b)


def test_pooled_cells_are_means_weighted_by_area() -> None:
    x, areas = torch.randn(2, 3, 8, 8), cell_areas(8)
    expected = torch.nn.functional.avg_pool2d(x * areas, 2) / cell_areas(4)
    torch.testing.assert_close(AreaPool(8)(x), expected)


def test_extent_is_the_distance_towards_a_point_and_turns_with_the_cloud() -> None:
    on_axis = extent(torch.tensor([[[0.0, 0.0, 0.7]]]))[0]
    assert on_axis[0].tolist() == pytest.approx([0.7] * 64, abs=1e-5)
    assert float(on_axis[2, 0]) == pytest.approx(0.35, abs=1e-4)  # two cells off: half
    assert float(on_axis[32:].max()) < 1e-6

    generator = torch.Generator().manual_seed(0)
    points = torch.randn(1, 50, 3, generator=generator) / 3
    eighth = torch.tensor(Rotation.from_euler("z", 45, degrees=True).as_matrix()).float()
    turned = extent(points @ eighth.T)
    assert torch.allclose(turned, extent(points).roll(8, dims=2), atol=1e-5)
    assert not torch.allclose(turned, extent(points), atol=1e-2)


def test_logits_move_little_under_rotation_and_not_at_all_about_z_by_a_pooled_cell() -> None:
    torch.manual_seed(0)
    model = SphericalCNN(10).eval()
    points = torch.randn(2, 200, 3)
    points[..., 0] *= 2
    turn = torch.tensor(Rotation.from_euler("z", 45, degrees=True).as_matrix()).float()
    with torch.no_grad():
        logits = model(points).class_logits
        assert torch.allclose(model(points @ turn.T).class_logits, logits, atol=1e-4)
        other = model(torch.randn(2, 200, 3)).class_logits
    assert (other - logits).abs().max() > 1e-3


@pytest.mark.parametrize(("classes", "count"), [(40, 200_808), (15, 197_583)])
def test_parameter_count(classes: int, count: int) -> None:
    assert sum(p.numel() for p in SphericalCNN(classes).parameters()) == count


def test_a_shape_and_its_mirror_image_get_one_answer(rng: np.random.Generator) -> None:
    """As its card says; a stretched one gets another."""
    model = SphericalCNN(5).train()
    cloud = torch.from_numpy(rng.normal(size=(4, 300, 3)) * (0.5, 0.3, 0.2)).float()
    cloud[..., 0] = cloud[..., 0].abs()
    for module in model.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.momentum = 1.0
    with torch.no_grad():
        model(cloud)
        before = model.eval()(cloud).class_logits
        mirrored = model(cloud * torch.tensor([1.0, -1, 1])).class_logits
        other = model(cloud * torch.tensor([1.0, 2, 1])).class_logits
    scale = before.abs().max()
    assert (mirrored - before).abs().max() < 1e-2 * scale
    assert (other - before).abs().max() > scale
