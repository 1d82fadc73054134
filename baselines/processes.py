"""Statistics of a batch that several processes share, for norms that are no ``nn.BatchNorm``.

``nn.SyncBatchNorm`` takes the place of ``nn.BatchNorm`` layers alone; a layer that computes its own
moments asks here. One process, or none of a group, gets back what it gave.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor
from torch.autograd.function import once_differentiable


class _Gather(torch.autograd.Function):
    """(C,) of each of W processes → (W,C); the gradient is that of the sum of all their losses."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        shares = [torch.empty_like(values) for _ in range(dist.get_world_size())]
        dist.all_gather(shares, values)
        return torch.stack(shares)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_shares: Tensor) -> Tensor:
        d_shares = d_shares.contiguous().clone()
        dist.all_reduce(d_shares)
        return d_shares[dist.get_rank()]


def world_size() -> int:
    """How many processes share a batch."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def pooled(mean: Tensor, var: Tensor, count: int) -> tuple[Tensor, Tensor, int | Tensor]:
    """Moments of the values of all processes from those of this one's, with gradient.

    Every process of ``torch.distributed``'s default group has to call it, in the same order.

    Args:
        mean: (C,), or fewer: of channels beyond these the mean is taken to be zero.
        var: (C,) mean squared distances from it.
        count: how many values a channel the moments are of.

    Returns:
        the mean, shaped as given, the variance and the count, a tensor if there are others.
    """
    if world_size() == 1:
        return mean, var, count
    shares = _Gather.apply(torch.cat([mean, var, var.new_tensor([count])]))
    means, variances, counts = shares.split([len(mean), len(var), 1], dim=1)
    total = counts.sum()
    weights = counts / total
    whole = (weights * means).sum(dim=0)
    # The variance of the whole is the mean of the variances and the variance of the means.
    between = torch.nn.functional.pad((means - whole).square(), (0, len(var) - len(mean)))
    return whole, (weights * (variances + between)).sum(dim=0), total
