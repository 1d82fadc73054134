"""Balls of points without their padding.

A ball query pads every ball to one length with its first point, and the published networks compute
a row for each entry. Where balls are sparse most rows are such copies: of 256-point clouds about
half. A copy changes no maximum, and in batch norm's statistics it is a weight. So each ball keeps
its distinct points, rounded up to one of a few lengths; balls of one length form a block, which is
dense. How many that leaves only the data say, which a device would have to be waited for: on those
the padding stays, its rows without weight.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from baselines.points import flat_index

LENGTHS = 16
"""How many lengths there are, up to the padded one: the more, the less padding is left."""


@dataclass(frozen=True)
class Balls:
    """Q balls of all clouds of a batch, R rows in all, sorted by length.

    Attributes:
        index: (B,S,n) as queried, padded; Q = B·S.
        point: (R,) each row's point, an index into all clouds' points in one row.
        centre: (R,) the ball it belongs to, in the order of the query.
        weight: (R,) float32, how many of the ball's n entries the row stands for; they sum to Q·n.
        blocks: (balls, length) of each block.
        place: (Q,) where each ball of the query is in the sorted order.
    """

    index: Tensor
    point: Tensor
    centre: Tensor
    weight: Tensor
    blocks: tuple[tuple[int, int], ...]
    place: Tensor


def without_padding(index: Tensor, number: int) -> Balls:
    """The balls of ``points.ball_query``.

    Args:
        index: (B,S,n) into clouds of ``number`` points, each ball padded with its first entry.
    """
    flat = flat_index(index, number).flatten(0, 1)
    n = flat.shape[1]
    if index.device.type != "cpu":
        return _padded(index, flat)
    found = 1 + (flat[:, 1:] != flat[:, :1]).sum(dim=1)
    step = -(-n // LENGTHS)
    units = -(-found // step)
    order = units.argsort(stable=True)
    blocks, points, centres, weights = [], [], [], []
    start = 0
    for unit, balls in enumerate(torch.bincount(units).tolist()):
        if not balls:
            continue
        length, which = min(unit * step, n), order[start : start + balls]
        start += balls
        rank = torch.arange(length, device=flat.device)
        weight = (rank < found[which, None]).float()
        weight[:, 0] += n - found[which]
        blocks.append((balls, length))
        points.append(flat[which, :length].flatten())
        centres.append(which.repeat_interleave(length))
        weights.append(weight.flatten())
    return Balls(
        index,
        torch.cat(points),
        torch.cat(centres),
        torch.cat(weights),
        tuple(blocks),
        order.argsort(),
    )


def _padded(index: Tensor, flat: Tensor) -> Balls:
    """All entries of balls (B,S,n), (Q,n), in one block."""
    balls, n = flat.shape
    place = torch.arange(balls, device=flat.device)
    own = (flat != flat[:, :1]).float()
    own[:, 0] = n - own[:, 1:].sum(dim=1)
    centre = place[:, None].expand(balls, n).flatten()
    return Balls(index, flat.flatten(), centre, own.flatten(), ((balls, n),), place)
