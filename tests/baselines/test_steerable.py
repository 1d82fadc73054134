"""The steerable layers: kernel constraint, equivariance, formulations, published weights."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from e3nn import o3
from scipy.spatial.transform import Rotation

from baselines.steerable import Fields, GatedBlock, SteerableConvolution
from baselines.steerable.basis import kernel_basis
from baselines.steerable.fields import wigner_matrix
from baselines.steerable.published import (
    change_of_basis,
    field_from_published,
    field_to_published,
    gated_block_state,
)
from baselines.steerable.spectral import Plan, convolve, transform
from partialbench.errors import InputError

FORMULATIONS = ("assembled", "factorised", "spectral")

# models.md / se3cnn@546bc68: number of basis elements [l_out][l_in].
COUNTS = {
    3: [[2, 1, 1, 1], [1, 4, 3, 2], [1, 3, 5, 3], [1, 2, 3, 5]],
    5: [[3, 2, 2, 2], [2, 7, 6, 5], [2, 6, 10, 8], [2, 5, 8, 11]],
}
CUBE = np.round(Rotation.create_group("O").as_matrix())


def turn_volume(volume: torch.Tensor, R: np.ndarray) -> torch.Tensor:
    """(L f)(v) = f(R⁻¹v) on the last three axes (x, y, z), for a rotation of the cube, exactly."""
    edge = volume.shape[-1]
    v = np.stack(np.meshgrid(*[np.arange(edge)] * 3, indexing="ij"), -1) - (edge - 1) / 2
    source = np.rint(v @ R + (edge - 1) / 2).astype(int)  # rows: R⁻¹v = vᵀR
    return volume[..., source[..., 0], source[..., 1], source[..., 2]]


def turn(field: torch.Tensor, fields: Fields, R: np.ndarray) -> torch.Tensor:
    """The paper's eq. 2: ρ(R) f(R⁻¹v)."""
    rotation = torch.as_tensor(R, dtype=field.dtype)
    return fields.rotate_components(turn_volume(field, R), fields.wigner(rotation))


def some_state(block: GatedBlock, seed: int = 0) -> GatedBlock:
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in block.parameters():
            parameter.normal_(generator=generator)
        block.convolution.running_mean.normal_(generator=generator)
        block.convolution.running_var.uniform_(0.5, 2, generator=generator)
    return block


@pytest.mark.parametrize("size", [3, 5])
def test_basis_has_the_published_number_of_elements_each_of_unit_norm(size: int) -> None:
    for l_out, l_in in itertools.product(range(4), repeat=2):
        basis, labels = kernel_basis(l_in, l_out, size)
        assert len(basis) == len(labels) == COUNTS[size][l_out][l_in]
        assert basis.flatten(1).norm(dim=1).numpy() == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("size", [3, 5])
def test_basis_solves_the_kernel_constraint_for_every_turn_of_the_cube(size: int) -> None:
    for l_out, l_in in itertools.product(range(4), repeat=2):
        basis, _ = kernel_basis(l_in, l_out, size)
        for R in CUBE:
            rotation = torch.as_tensor(R)
            left = torch.einsum(
                "op,bpqxyz,iq->boixyz",
                wigner_matrix(l_out, rotation),
                turn_volume(basis, R),
                wigner_matrix(l_in, rotation),
            )
            assert (left - basis).abs().max() < 1e-12
    # The other direction of rotation is not a solution: the predicate can fail.
    basis, _ = kernel_basis(0, 1, size)
    quarter = CUBE[[np.trace(R) == 1 for R in CUBE]][0]
    wrong = torch.einsum(
        "op,bpqxyz->boqxyz",
        wigner_matrix(1, torch.as_tensor(quarter)),
        turn_volume(basis, quarter.T),
    )
    assert (wrong - basis).abs().max() > 0.1


def test_wigner_matrices_are_e3nns_and_stay_exact_near_the_identity() -> None:
    R = torch.as_tensor(Rotation.random(50, random_state=0).as_matrix())
    for degree in range(4):
        expected = o3.Irreps(f"1x{degree}e").D_from_matrix(R)
        # e3nn 0.6 keeps its constants in float32.
        assert (wigner_matrix(degree, R) - expected).abs().max() < 5e-6
    small = torch.as_tensor(Rotation.from_rotvec([1e-7, 2e-7, 0]).as_matrix()).float()
    for degree in range(4):
        D = wigner_matrix(degree, small)
        assert (D - torch.eye(2 * degree + 1)).abs().max() < 3e-6
    a, b = R[:25], R[25:]
    product = wigner_matrix(3, a) @ wigner_matrix(3, b)
    assert (product - wigner_matrix(3, a @ b)).abs().max() < 1e-12


def test_degree_one_components_are_x_y_z() -> None:
    R = torch.as_tensor(Rotation.random(random_state=1).as_matrix())
    assert torch.allclose(wigner_matrix(1, R), R, atol=1e-12)
    cycle = change_of_basis(1) @ torch.tensor([1.0, 2, 3], dtype=torch.float64)
    assert cycle.tolist() == pytest.approx([2, 3, 1])


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize(("size", "stride"), [(3, 1), (5, 2)])
def test_gated_block_is_equivariant_to_quarter_turns(
    formulation: str, size: int, stride: int
) -> None:
    fields_in, fields_out = Fields((2, 1, 1, 1)), Fields((3, 2, 1, 1))
    block = GatedBlock(
        fields_in, fields_out, size, padding=size // 2, stride=stride, formulation=formulation
    )
    block = some_state(block).double().eval()
    x = torch.randn(2, fields_in.channels, 9, 9, 9, dtype=torch.float64)
    with torch.no_grad():
        y = block(x)
        for R in CUBE:
            moved = block(turn(x, fields_in, R))
            assert (moved - turn(y, fields_out, R)).abs().max() < 1e-6 * y.abs().max()
        quarter = CUBE[[np.trace(R) == 1 for R in CUBE]][0]
        unmoved = turn_volume(y, quarter)  # the volume turned, the components left
        assert (block(turn(x, fields_in, quarter)) - unmoved).abs().max() > 0.1


@pytest.mark.parametrize(
    ("fields_in", "fields_out", "size", "stride", "padding"),
    [
        ((2, 1, 1, 1), (3, 2, 2, 1), 3, 1, 1),
        ((1, 2, 1), (2, 1, 1), 5, 2, 4),
        ((1,), (2, 2), 3, 1, 1),
        ((0, 2), (2, 0, 1), 3, 1, 0),
        ((2, 1), (20,), 5, 2, 4),  # spectral, mixed later
    ],
)
@pytest.mark.parametrize("volume", [(8, 7, 9), (7, 7, 7), (8, 8, 8)])
def test_all_formulations_are_one_map_with_one_gradient(
    volume: tuple, fields_in: tuple, fields_out: tuple, size: int, stride: int, padding: int
) -> None:
    torch.manual_seed(0)
    results = []
    cube = len(set(volume)) == 1
    layers = [
        SteerableConvolution(
            Fields(fields_in),
            Fields(fields_out),
            size,
            padding=padding,
            stride=stride,
            formulation=formulation,
        ).double()
        for formulation in FORMULATIONS[: 3 if cube else 2]
    ]
    x = torch.randn(3, layers[0].fields_in.channels, *volume, dtype=torch.float64)
    for layer in layers[1:]:
        layer.load_state_dict(layers[0].state_dict())
    for layer in layers:
        leaf = x.clone().requires_grad_()
        y = layer(leaf)
        weight = torch.linspace(-1, 1, y.numel(), dtype=y.dtype).view(y.shape).sin()
        (y * weight).sum().backward()
        gradients = [leaf.grad, *(p.grad for p in layer.parameters())]
        results.append([y.detach(), *gradients, layer.running_mean, layer.running_var])
    for one, *others in zip(*results, strict=True):
        for other in others:
            assert torch.allclose(one, other, rtol=1e-9, atol=1e-8)


def test_spectral_needs_a_cube_and_auto_takes_it_where_it_is_cheaper() -> None:
    layer = SteerableConvolution(Fields((1,)), Fields((1,)), 5, padding=4, formulation="spectral")
    with pytest.raises(ValueError, match="needs a cube"):
        layer(torch.zeros(1, 1, 8, 8, 9))
    wide = Fields((16, 16))
    auto = SteerableConvolution(wide, wide, 5, padding=4)
    x = torch.zeros(8, wide.channels, 9, 9, 9)
    assert auto._plan(x) == Plan(9, 5, 4, 1)
    assert auto._plan(x[..., :-1]) is None
    small = SteerableConvolution(wide, wide, 3, padding=1)
    assert small._plan(x[:1]) is None
    with torch.no_grad():  # a dense convolution alone is fast, its gradients are not
        assert small._plan(x) is None


@pytest.mark.parametrize(("size", "padding", "stride", "edge"), [(5, 4, 1, 9), (3, 1, 2, 6)])
def test_frequencies_are_no_more_than_it_takes(
    size: int, padding: int, stride: int, edge: int
) -> None:
    """One voxel less in the period, and an output reads what is a period off."""
    plan = Plan(edge, size, padding, stride)
    x = torch.randn(2, 3, edge, edge, edge, dtype=torch.float64)
    kernel = torch.randn(4, 3, size, size, size, dtype=torch.float64)
    expected = torch.nn.functional.conv3d(x, kernel, stride=stride, padding=padding)
    assert torch.allclose(convolve(x, transform(kernel, plan), plan), expected)

    class Shorter(Plan):
        period = plan.period - 1

    short = Shorter(edge, size, padding, stride)
    assert not torch.allclose(convolve(x, transform(kernel, short), short), expected)


def test_slabs_do_not_change_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    from baselines.steerable import factorised

    layer = SteerableConvolution(
        Fields((2, 2)), Fields((2, 2)), 5, padding=2, stride=2, formulation="factorised"
    ).double()
    x = torch.randn(3, 8, 9, 8, 7, dtype=torch.float64, requires_grad=True)
    whole = layer(x)
    whole.square().sum().backward()
    gradient, x.grad = x.grad, None
    monkeypatch.setitem(factorised._SLAB_BYTES, "cpu", 1)  # one plane of one sample at a time
    pieces = layer(x)
    pieces.square().sum().backward()
    assert torch.allclose(whole, pieces, atol=1e-12)
    assert torch.allclose(gradient, x.grad, atol=1e-10)


@pytest.mark.parametrize("formulation", ["assembled", "spectral"])
def test_kernel_is_kept_in_evaluation_until_a_weight_changes(formulation: str) -> None:
    layer = SteerableConvolution(Fields((1,)), Fields((1, 1)), 3, formulation=formulation).eval()
    x = torch.randn(1, 1, 5, 5, 5)
    with torch.no_grad():
        first = layer(x)
        kept = layer._cache
        assert torch.equal(layer(x), first)
        assert layer._cache is kept
        layer.weights["0"].mul_(2)
        assert torch.allclose(layer(x)[:, :1], 2 * first[:, :1], atol=1e-6)
        layer.load_state_dict({k: torch.zeros_like(v) for k, v in layer.state_dict().items()})
        assert layer(x).abs().max() == 0
    layer.train()
    assert layer._cache is None


def test_autocast_runs_in_low_precision_and_stays_close() -> None:
    torch.manual_seed(0)
    fields = Fields((4, 4, 4))
    for formulation in ("assembled", "factorised"):
        block = GatedBlock(fields, fields, 3, padding=1, formulation=formulation)
        x = torch.randn(2, fields.channels, 6, 6, 6, requires_grad=True)
        full = block(x)
        with torch.autocast("cpu", torch.bfloat16):
            low = block(x)
        assert low.dtype == torch.bfloat16
        assert 0 < (low.float() - full).abs().max() < 0.05 * full.abs().max()
        low.float().sum().backward()
        assert all(p.grad is not None and p.grad.isfinite().all() for p in block.parameters())


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize(
    ("name", "fields_in", "fields_out", "size", "padding", "stride"),
    [
        ("gated_3", (2, 2, 2, 2), (3, 2, 2, 1), 3, 1, 1),
        ("gated_5", (1, 2, 1), (2, 1, 1, 1), 5, 2, 2),
    ],
)
def test_published_gated_block(
    shared, name, fields_in, fields_out, size, padding, stride, formulation
) -> None:
    fixture = np.load(shared / "parity" / f"{name}.npz")
    published = {
        key.removeprefix("state/"): fixture[key] for key in fixture if key.startswith("state/")
    }
    block = GatedBlock(
        Fields(fields_in),
        Fields(fields_out),
        size,
        padding=padding,
        stride=stride,
        formulation=formulation,
    )
    block.load_state_dict(gated_block_state(published, block))
    x = field_from_published(torch.as_tensor(fixture["input"]), block.fields_in)
    with torch.no_grad():
        for mode, expected in (("eval", "eval_output"), ("train", "train_output")):
            y = field_to_published(block.train(mode == "train")(x), block.fields_out)
            assert np.abs(y.numpy() - fixture[expected]).max() < 1e-5
    del published["conv.kernel.kernel_1_1"]
    with pytest.raises(InputError, match="kernel_1_1"):
        gated_block_state(published, block)


def test_published_kernel_is_ours_after_the_change_of_basis(shared) -> None:
    fixture = np.load(shared / "parity" / "gated_3.npz")
    for l_out, l_in in itertools.product(range(4), repeat=2):
        theirs = torch.as_tensor(fixture[f"state/conv.kernel.kernel_{l_out}_{l_in}"]).double()
        basis, labels = kernel_basis(l_in, l_out, 3)
        ours = (
            torch.einsum(
                "op,bpqxyz,iq->boixyz", change_of_basis(l_out), basis, change_of_basis(l_in)
            )
            * ((2 * l_out + 1) / (len(labels) * 8)) ** 0.5
        )
        product = (ours * theirs).flatten(1).sum(1) / theirs.flatten(1).square().sum(1)
        assert torch.allclose(product.abs(), torch.ones(len(labels), dtype=torch.float64))
        assert (theirs - product.sign().view(-1, 1, 1, 1, 1, 1) * ours).abs().max() < 1e-5


def test_published_basis_of_another_width_is_refused(shared) -> None:
    fixture = np.load(shared / "parity" / "gated_3.npz")
    published = {key.removeprefix("state/"): fixture[key] for key in fixture}
    bent = published["conv.kernel.kernel_1_0"] * 1.0
    bent[..., 0, 0, 0] += 0.01
    published["conv.kernel.kernel_1_0"] = bent
    block = GatedBlock(Fields((2, 2, 2, 2)), Fields((3, 2, 2, 1)), 3, padding=1)
    with pytest.raises(InputError, match="kernel basis from degree 0 to 1"):
        gated_block_state(published, block)


@pytest.mark.parametrize("formulation", ["assembled", "factorised"])
def test_autocast_survives_fields_that_are_nearly_constant(formulation: str) -> None:
    """Most of a sparse volume is background: its mean is many times its deviation."""
    torch.manual_seed(0)
    layer = SteerableConvolution(
        Fields((4, 2)), Fields((4, 2)), 3, padding=1, formulation=formulation
    )
    x = torch.randn(2, layer.fields_in.channels, 8, 8, 8)
    x[:, :4] = 3 + 0.03 * x[:, :4]
    inner = (..., slice(1, -1), slice(1, -1), slice(1, -1))  # the zero padding is no constant
    with torch.no_grad():
        full = layer(x)[inner]
        with torch.autocast("cpu", torch.bfloat16):
            low = layer(x)[inner].float()
        rounded = x.bfloat16().float()
        uncentred = layer(rounded)[inner]
    assert (low - full).norm() < 0.02 * full.norm()
    assert (uncentred - full).norm() > 0.05 * full.norm()
