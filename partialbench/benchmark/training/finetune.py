"""Fine-tuning: a training that begins from the weights of an earlier one.

What the earlier one was belongs to the new one's record, and its weights to the row's name: a start
is worth the clouds that went into it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from partialbench.benchmark.protocol.protocol import Protocol
from partialbench.benchmark.training import checkpoint, packed
from partialbench.benchmark.training.find import find_checkpoint
from partialbench.errors import InputError


@dataclass(frozen=True)
class Start:
    """Weights to begin from.

    Attributes:
        state: name → tensor, as of ``state_dict``.
        class_names: of the earlier training.
        train_sources: of the objects it had, see ``duplicates.source_keys``.
        origin: what a record says of it, plain data: ``name`` (its data set and eight digits of the
            weights' digest), variant, protocol and digest of its training data, seed, clouds seen,
            and the ``start`` it had itself, or None.
    """

    state: dict[str, Tensor]
    class_names: list[str]
    train_sources: list[str]
    origin: dict[str, Any]


def load(given: Path | str, model: str) -> Start:
    """The weights of a finished training, found by ``find_checkpoint``.

    Raises:
        InputError: no checkpoint, of another model, or of an unfinished training.
    """
    path = find_checkpoint(given)
    content = packed.load(path)
    if content["model"] != model:
        raise InputError(f"{path} holds a {content['model']!r}, not a {model!r}: it is no start")
    checkpoint.require_finished(content, path, "be the start of another")
    train_data, summary = content["train_data"], content["summary"]
    origin = {
        "name": f"{train_data['id']}:{_digest(content['state'])[:8]}",
        "variant": content["variant"],
        "train_data": {name: train_data[name] for name in ("id", "digest", "clouds", "points")},
        "protocol": content["protocol"],
        "seed": content["seed"],
        "clouds_seen": summary["clouds_seen"],
        "start": summary.get("start"),
    }
    return Start(content["state"], content["class_names"], content["train_sources"], origin)


def check_split(start: Start, dataset_id: str, protocol: Protocol) -> None:
    """Raises ``InputError`` where the start was trained on objects that are to validate now."""
    before = start.origin["protocol"]
    names = ("validation_fraction", "split_seed")
    differing = [name for name in names if before[name] != getattr(protocol, name)]
    if start.origin["train_data"]["id"] == dataset_id and differing:
        details = ", ".join(
            f"{n}: {before[n]} there, {getattr(protocol, n)} now" for n in differing
        )
        raise InputError(
            f"the starting weights saw some of the objects that would validate ({details}); keep "
            f"both as they were"
        )


def begin(
    model: nn.Module, start: Start, class_names: list[str], create: Callable[[int], nn.Module]
) -> list[str]:
    """Gives the model the weights of the start.

    Between the same classes, in the same order, every weight is taken. Between others, also as many
    others, what depends on the classes (the last layer) stays as it was initialised.

    Args:
        create: the same model, fresh, for so many classes: what has another shape for one class
            more depends on the classes.

    Returns:
        the names that stayed.

    Raises:
        InputError: the weights are of another architecture.
    """
    own = model.state_dict()
    left: set[str] = set()
    if class_names != start.class_names:
        more = create(len(class_names) + 1).state_dict()
        left = {name for name in own if name not in more or own[name].shape != more[name].shape}
    wrong = [
        name
        for name in dict.fromkeys([*start.state, *own])
        if (name in own) != (name in start.state)
        or (name not in left and own[name].shape != start.state[name].shape)
    ]
    if wrong:
        raise InputError(
            f"the starting weights are of another architecture, they do not fit "
            f"{', '.join(wrong[:5])}; give the options they were trained with"
        )
    model.load_state_dict(
        {name: tensor for name, tensor in start.state.items() if name not in left}, strict=False
    )
    return [name for name in own if name in left]


def _digest(state: dict[str, Tensor]) -> str:
    digest = hashlib.sha256()
    for name, tensor in sorted(state.items()):
        digest.update(name.encode() + bytes(tensor.contiguous().cpu().numpy()))
    return digest.hexdigest()
