"""Operations on batches of point clouds in plain torch: the same on CPU and GPU.

Shapes are written with B clouds, N points, M or S centres, n or k neighbours, C channels. Geometry
is computed in full precision whatever the autocast state, and carries no gradient: neighbours are
chosen, not differentiated. Nothing here makes a (B,N,N,C) tensor.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor, nn

from partialbench.errors import InputError

RADIUS = 0.9999
"""Largest norm after ``normalise``: just inside the unit ball, so that no coordinate reaches 1 and
with it a cell beyond the end of a grid over [−1, 1]."""

P = ParamSpec("P")
T = TypeVar("T")


def geometric(function: Callable[P, T]) -> Callable[P, T]:
    """No gradient and no autocast: a bfloat16 distance would choose other neighbours."""

    @wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> T:
        device = next(a for a in args if isinstance(a, Tensor)).device.type
        with torch.no_grad(), torch.autocast(device, enabled=False):
            return function(*args, **kwargs)

    return wrapped


def full_precision(values: Tensor) -> Tensor:
    """The values in float32, or float64 if they are: never in a half precision."""
    return values.to(torch.promote_types(values.dtype, torch.float32))


def autocast_dtype(values: Tensor) -> torch.dtype:
    """What a product of these values has: autocast's dtype where it is on, else their own."""
    device = values.device.type
    on = torch.is_autocast_enabled(device)
    return torch.get_autocast_dtype(device) if on else values.dtype


SMALLEST = 1e-12
"""Extent below which a cloud is none: what is left of coordinates then is their rounding."""


def normalise(points: Tensor, radius: float = RADIUS, dtype: torch.dtype | None = None) -> Tensor:
    """Subtracts each cloud's mean point and scales its largest norm to ``radius``.

    Args:
        points: (B,N,3) floating, any frame and unit.
        dtype: in which it is done and returned; by default in that of the points, or float32 if
            they are of a half precision.

    Returns:
        (B,N,3). Points that all coincide become zeros.

    Raises:
        InputError: for another shape or dtype, or a cloud with NaN, infinite or overflowing
            coordinates or of an extent that is nothing but rounding. On other devices than the CPU
            torch's own error, when the device finds it.
    """
    if not isinstance(points, Tensor):
        raise InputError(
            f"clouds must be a floating (B,N,3) tensor, got a {type(points).__name__}; "
            f"torch.as_tensor makes one"
        )
    if points.ndim != 3 or points.shape[-1] != 3 or not points.is_floating_point():
        raise InputError(
            f"clouds must be a floating (B,N,3) tensor, got {tuple(points.shape)} {points.dtype}"
        )
    if not points.numel():
        raise InputError(f"clouds must have points, got an empty tensor {tuple(points.shape)}")
    # In double precision the mean does not depend on the order of the points, so neither does
    # anything computed from the centred cloud.
    points = full_precision(points) if dtype is None else points.to(dtype)
    centred = (points.double() - points.double().mean(dim=1, keepdim=True)).to(points.dtype)
    largest = torch.linalg.vector_norm(centred, dim=-1).amax(dim=1)
    _require_extent(largest)
    return centred * (radius / largest.clamp_min(SMALLEST))[:, None, None]


def require_sound(sound: Tensor, what: str, words: Callable[[int], str]) -> None:
    """Raises ``InputError`` with ``words`` of the first of (n,) that is not sound.

    On other devices than the CPU torch's own error with ``what``, when the device finds it: there
    nothing waits for the host.
    """
    if sound.device.type != "cpu":
        torch._assert_async(sound.all(), what)
    elif not bool(sound.all()):
        raise InputError(words(int((~sound).nonzero()[0, 0])))


@torch.no_grad()
def _require_extent(largest: Tensor) -> None:
    """Raises for clouds whose largest norm (B,) about their mean says that they are none."""

    def words(which: int) -> str:
        found = float(largest[which])
        if found < SMALLEST:
            return (
                f"cloud {which} of the batch reaches {found:.1e} from its mean, expected at least "
                f"{SMALLEST} or points that coincide; give it in a smaller unit"
            )
        return (
            f"cloud {which} of the batch has coordinates that are NaN, infinite or too large for "
            f"{str(largest.dtype).removeprefix('torch.')} (its largest distance from its mean is "
            f"{found}); leave such points out, or give it in a larger unit"
        )

    # NaN fails every comparison: what holds of a sound cloud is asked for.
    sound = (largest == 0) | ((largest >= SMALLEST) & (largest < torch.inf))
    require_sound(sound, "a cloud has no finite coordinates or no extent", words)


def as_weights(points: Tensor, module: nn.Module) -> Tensor:
    """Normalised clouds in the precision of the module's weights, full or double.

    Clouds come as they are stored, in NumPy's double precision as often as not; it is used up to
    their normalisation, where digits are lost, and not in layers of single precision.
    """
    dtype = next((p.dtype for p in module.parameters()), points.dtype)
    return points.to(torch.promote_types(dtype, torch.float32))


@geometric
def distances(a: Tensor, b: Tensor) -> Tensor:
    """Euclidean distances (B,M,N) between (B,M,C) and (B,N,C).

    Coordinates (C ≤ 4) are subtracted, which keeps all digits between near points; features go
    through a matrix product, |a|² + |b|² − 2a·b, which is faster and good to about 1e-3·|a|.
    """
    a, b = full_precision(a), full_precision(b)
    if a.shape[-1] > 4:
        return torch.cdist(a, b, compute_mode="use_mm_for_euclid_dist")
    if a.device.type == "cpu":
        return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")
    # On other devices cdist takes a block of threads for each pair.
    square = a.new_zeros(a.shape[0], a.shape[1], b.shape[1])
    for axis in range(a.shape[-1]):
        square += (a[..., axis, None] - b[:, None, :, axis]).square_()
    return square.sqrt_()


def smallest(values: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The ``count`` smallest of the last axis of (…,N), ascending, and their indices, int64.

    Values of 32 bits on the CPU are sorted as whole numbers of 64 that hold value and index, for
    which NumPy's vectorised sort is several times as fast as topk; equal ones keep their order.
    """
    if values.device.type != "cpu" or values.dtype != torch.float32:
        return torch.topk(values, count, dim=-1, largest=False)
    # Zero is added for −0, whose bits are another number's.
    bits = (values + 0.0).view(torch.int32)
    # As whole numbers negative floats run backwards: all their bits but the sign turn round.
    keys = (bits ^ ((bits >> 31) & 0x7FFFFFFF)).long()
    keys = (keys << 32).bitwise_or_(torch.arange(values.shape[-1]))
    keys.numpy().sort(axis=-1)
    index = keys[..., :count] & 0xFFFFFFFF
    return values.gather(-1, index), index


@geometric
def knn(points: Tensor, k: int) -> Tensor:
    """Indices (B,N,k) of each point's k nearest, itself included, nearest first.

    Args:
        points: (B,N,C) coordinates or features.

    Raises:
        InputError: if a cloud has fewer than k points.
    """
    if points.shape[1] < k:
        raise InputError(
            f"{k} neighbours need clouds of at least {k} points, got {points.shape[1]}"
        )
    if points.shape[-1] <= 4:
        farness = distances(points, points)
    else:
        # |a|² is the same for a whole row: only |b|² − 2a·b orders the neighbours.
        points = full_precision(points)
        norms = points.square().sum(dim=-1)
        farness = torch.baddbmm(norms[:, None], points, points.mT, alpha=-2)
    return smallest(farness, k)[1]


@geometric
def farthest_points(
    points: Tensor,
    count: int,
    start: Tensor | None = None,
    repeat: bool = True,
    favour: Tensor | None = None,
) -> Tensor:
    """Farthest point sampling: indices (B,count) of points each farthest from those before it.

    The sampling of the first m picks, started at the first, picks them in the same order: a
    hierarchy of samplings needs one call and prefixes.

    Args:
        points: (B,N,3).
        count: how many; beyond the number of distinct points the start is repeated or index 0.
        start: (B,) first index of each cloud; by default 0, as the published implementations have
            it in evaluation.
        repeat: without, no index is chosen twice and points that coincide come last; ``count`` is
            then at most N.
        favour: (B,N) added to each point's squared distance: which of those that are as far is
            taken. By default rounding says.
    """
    batch, number, _ = points.shape
    planes = full_precision(points).mT.contiguous()
    nearest = planes.new_full((batch, number), torch.inf)
    chosen = torch.zeros(batch, count, dtype=torch.long, device=points.device)
    last = chosen[:, 0] if start is None else start
    chosen[:, 0] = last
    for step in range(1, count):
        pick = planes.gather(2, last[:, None, None].expand(-1, 3, 1))
        square = (planes - pick).square_().sum(dim=1)
        torch.minimum(nearest, square if favour is None else square.add_(favour), out=nearest)
        if not repeat:
            nearest.scatter_(1, last[:, None], -1)
        last = nearest.argmax(dim=1)
        chosen[:, step] = last
    return chosen


def farthest_from_centre(points: Tensor) -> Tensor:
    """Index (B,) of the point with the largest norm: a start that turns with a centred cloud."""
    return torch.linalg.vector_norm(points.detach(), dim=-1).argmax(dim=1)


@geometric
def ball_query(
    centres: Tensor, points: Tensor, radius: float, count: int, nearest: bool = False
) -> Tensor:
    """Indices (B,S,count) of points within ``radius`` of each centre, padded with its first hit.

    Args:
        centres: (B,S,3), each with at least one point in reach (they are points of the cloud).
        points: (B,N,3).
        nearest: keep the nearest points instead of the first in index order. The published
            networks keep the first; the nearest do not depend on the order of the points.

    Raises:
        InputError: if a ball is empty, which NaN coordinates also cause.
    """
    distance = distances(centres, points)
    number = points.shape[1]
    if nearest:
        near, index = smallest(distance, min(count, number))
        _require_hits(near[..., 0] <= radius, radius)
        index = torch.where(near <= radius, index, index[..., :1])
        missing = count - index.shape[-1]
        return torch.cat([index, index[..., :1].expand(-1, -1, missing)], dim=-1)
    inside = distance <= radius
    if points.device.type == "cpu":
        return _first_hits(inside.flatten(0, 1), count, radius).view(*distance.shape[:2], count)
    return _first_ranked(inside, count, radius)


def _require_hits(found: Tensor, radius: float) -> None:
    """Raises InputError for an empty ball; other devices raise torch's error when they find it."""
    message = f"a centre has no point within {radius}: it is not of the cloud"
    if found.device.type != "cpu":
        torch._assert_async(found.all(), message)
    elif not bool(found.all()):
        raise InputError(message)


def _first_hits(inside: Tensor, count: int, radius: float) -> Tensor:
    """The first ``count`` that are true of each row (R,N), padded with the first: (R,count)."""
    hits = inside.nonzero()[:, 1]
    found = inside.sum(dim=1)
    _require_hits(found > 0, radius)
    # Row i's hits lie at first[i] … first[i] + found[i] − 1; past its end, read the first again.
    first = found.cumsum(0) - found
    rank = torch.arange(count, device=inside.device)
    return hits[first[:, None] + torch.where(rank < found[:, None], rank, 0)]


def _first_ranked(inside: Tensor, count: int, radius: float) -> Tensor:
    """The same of (…,N), (…,count), by ranking all points: where the hits lie is not waited for."""
    number = inside.shape[-1]
    ranked = torch.where(inside, torch.arange(number, device=inside.device), number)
    index = ranked.topk(min(count, number), dim=-1, largest=False).values
    _require_hits(index[..., 0] < number, radius)
    index = torch.where(index < number, index, index[..., :1])
    missing = [*index.shape[:-1], count - index.shape[-1]]
    return torch.cat([index, index[..., :1].expand(missing)], dim=-1)


def flat_index(index: Tensor, number: int) -> Tensor:
    """Indices (B,…) into clouds of ``number`` points → into all clouds' points in one row."""
    offset = torch.arange(index.shape[0], device=index.device) * number
    return index + offset.view(-1, *[1] * (index.ndim - 1))


def gather(values: Tensor, index: Tensor) -> Tensor:
    """``values`` (B,N,C) at ``index`` (B,…) → (B,…,C). Differentiable in ``values``."""
    flat = flat_index(index, values.shape[1])
    return values.flatten(0, 1).index_select(0, flat.flatten()).view(*index.shape, -1)
