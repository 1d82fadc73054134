"""Layers with norms of their own: two processes, half a batch each, against one with all of it."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist
from torch import Tensor, multiprocessing, nn

from baselines.dgcnn import EdgeConv
from baselines.pointnet2 import Scale, SetAbstraction
from baselines.processes import pooled
from baselines.shared_mlp import NormLinear, SharedMLP
from baselines.steerable import Fields, SteerableConvolution
from papnet.steered.descriptor import DegreeNorm
from papnet.steered.edge_layer import EdgeLayer, collect_edges

LAYERS = (
    "linear", "mlp", "edge convolution", "set abstraction", "edge layer", "steerable",
    "wide linear",
    "steerable without scalars", "degree 0", "degree 2",
)  # fmt: skip
"""Every way that moments are taken in."""


def outcome(name: str, share: slice, processes: int) -> dict[str, Tensor]:
    """Outputs, gradients and statistics of a layer on samples of a batch of 4.

    The loss is the mean over the samples, each with weights of its own.
    """
    torch.manual_seed(0)
    sizes = torch.arange(1, 5).double()
    x = torch.randn(4, 40, 3).double() * sizes.view(4, 1, 1)
    volume = torch.randn(4, 8, 5, 5, 5).double() * sizes.view(4, 1, 1, 1, 1)
    layer: Any
    call: Any = None
    if name == "linear":
        layer = NormLinear(3, 5)
    elif name == "wide linear":
        layer = NormLinear(16, 5)
        x = torch.randn(4, 40, 16).double() * sizes.view(4, 1, 1) + sizes.view(4, 1, 1)
        call = partial(layer, slope=0.2)
    elif name == "mlp":
        layer = SharedMLP(3, 6, 5)
        call = layer.max
    elif name == "edge convolution":
        layer = EdgeConv(3, 5)
        call = partial(layer, k=8)
    elif name == "set abstraction":
        layer = SetAbstraction(0, [Scale(1.5, 16, (4, 5))])

        def call(part: Tensor) -> Tensor:
            return layer(part, None, part[:, :10])

    elif name == "edge layer":
        layer = EdgeLayer(3, 4, 5)
        index = torch.randint(40, (4, 40, 6))
        features, penalty = torch.randn(4, 40, 6, 4).double(), torch.rand(4, 40, 6).double()
        edges = collect_edges(index[share], features[share], penalty[share], moments=True)
        call = partial(layer, edges=edges)
    elif name.startswith("steerable"):
        fields = Fields((0, 1, 1) if name.endswith("scalars") else (5, 1))
        layer, x = SteerableConvolution(fields, Fields((3, 2)), 3, padding=1), volume
    else:
        layer, x = DegreeNorm(8, int(name[-1])), volume.flatten(2)[:, :, : 2 * int(name[-1]) + 1]
    layer = layer.double().train()
    if processes > 1:
        # As training does on GPUs: it changes the class of the norms whose parameters are used.
        assert nn.SyncBatchNorm.convert_sync_batchnorm(layer) is layer
    leaf = x[share].clone().requires_grad_()
    y = (call or layer)(leaf)
    weight = torch.linspace(-1, 1, 4 * y[0].numel()).double().sin().view(4, *y.shape[1:])[share]
    (y * weight).flatten(1).sum(1).mean().backward()
    gradients = {n: p.grad for n, p in layer.named_parameters()}
    for gradient in gradients.values() if processes > 1 else ():
        dist.all_reduce(gradient)
        gradient /= processes
    buffers = {n: b for n, b in layer.named_buffers() if "basis" not in n}
    return {"y": y.detach(), "x": leaf.grad / processes, **gradients, **buffers}


def work(rank: int, folder: str) -> None:
    torch.set_num_threads(1)
    store = f"file://{folder}/store"
    dist.init_process_group("gloo", store, rank=rank, world_size=2)
    share = slice(2 * rank, 2 * rank + 2)
    found: dict[str, Any] = {name: outcome(name, share, 2) for name in LAYERS}
    # Shares of different sizes: a sum a channel, and its gradient.
    values = torch.arange(5.0).double()[:2] if rank else torch.arange(5.0).double()[2:]
    values.requires_grad_()
    var, mean = torch.var_mean(values, 0, correction=0, keepdim=True)
    mean, var, count = pooled(mean, var, len(values))
    (mean + 3 * var).sum().backward()
    found["uneven"] = mean.item(), var.item(), float(count), values.grad
    torch.save(found, f"{folder}/{rank}.pt")
    dist.destroy_process_group()


@pytest.fixture(scope="module")
def shares(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    folder: Path = tmp_path_factory.mktemp("processes")
    multiprocessing.spawn(work, (str(folder),), nprocs=2)
    return [torch.load(folder / f"{rank}.pt") for rank in range(2)]


@pytest.mark.parametrize("name", LAYERS)
def test_two_shares_are_normalised_as_one_batch(shares: list[dict[str, Any]], name: str) -> None:
    """Outputs, gradients as data parallelism averages them, and running statistics."""
    whole = outcome(name, slice(None), 1)
    for entry, expected in whole.items():
        found = [share[name][entry] for share in shares]
        if entry in ("y", "x"):
            found = [torch.cat(found)]
        for one in found:
            assert torch.allclose(one, expected, rtol=1e-8, atol=1e-9), entry


def test_shares_of_different_sizes_count_by_their_size(shares: list[dict[str, Any]]) -> None:
    for rank, share in enumerate(shares):
        mean, var, count, gradient = share["uneven"]
        assert (mean, var, count) == pytest.approx((2, 2, 5))
        # Both processes add the same loss: twice 1/5 + 3·2·(x − 2)/5.
        values = torch.arange(5.0).double()[:2] if rank else torch.arange(5.0).double()[2:]
        assert torch.allclose(gradient, 2 * (1 + 6 * (values - 2)) / 5)


def test_one_process_gets_back_what_it_gave() -> None:
    mean, var = torch.randn(3), torch.rand(3)
    assert pooled(mean, var, 7) == (mean, var, 7)
