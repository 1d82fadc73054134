"""From a published state dict to one of ours, by a table of prefixes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from torch import Tensor, nn

from partialbench.errors import InputError
from partialbench.registry import close_matches


def chosen_quirks(names: str, known: Iterable[str]) -> frozenset[str]:
    """What a model is to do as its published implementation does, though it cannot be meant.

    Args:
        names: joined by "+", e.g. "start+ring"; empty for none.

    Raises:
        InputError: for a name that is not known.
    """
    known = tuple(known)
    chosen = frozenset(names.split("+")) if names else frozenset()
    for name in sorted(chosen.difference(known)):
        raise InputError(f"there is no quirk {name!r}{close_matches(name, known)}")
    return chosen


def tensors(
    state: Mapping[str, Tensor],
    model: nn.Module,
    prefixes: Mapping[str, str],
    ignored: tuple[str, ...] = (),
) -> dict[str, Tensor]:
    """Renames a published state and brings every tensor into our shape.

    Args:
        state: published names → tensors, as ``registry.load_published`` reads them.
        model: ours, whose ``state_dict`` says the names and shapes wanted. A 1×1 convolution's
            trailing ones are dropped where ours is a linear layer.
        prefixes: published prefix → ours, for whole layers (``conv1.0`` → ``convs.0.linear``).
        ignored: prefixes of published entries that have no counterpart.

    Raises:
        InputError: naming the entry that is unknown, missing or of another shape.
    """
    wanted = model.state_dict()
    converted: dict[str, Tensor] = {}
    for name, tensor in state.items():
        if name.startswith(ignored or ("\0",)):
            continue
        layer, _, leaf = name.rpartition(".")
        ours = f"{prefixes.get(layer, layer)}.{leaf}"
        if ours not in wanted:
            raise InputError(f"the published state has {name!r}, which this model has no place for")
        shape = wanted[ours].shape
        if tensor.numel() != shape.numel() or tensor.shape[: len(shape)] != shape:
            raise InputError(
                f"the published {name!r} is {tuple(tensor.shape)}, {ours!r} is {tuple(shape)}; "
                f"was it trained for another number of classes?"
            )
        converted[ours] = tensor.reshape(shape)
    missing = sorted(n for n in wanted if n not in converted and "num_batches" not in n)
    if missing:
        raise InputError(f"the published state lacks the weights of {', '.join(missing)}")
    counters = {n: t for n, t in wanted.items() if n not in converted}
    return converted | counters
