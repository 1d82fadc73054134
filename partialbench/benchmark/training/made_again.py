"""Whether a model is all in what is kept of it: a factory that makes fresh ones, and a checkpoint
that makes the trained one again.

A record is of one network: the one that was trained, whose weights are named by their digest, and
which ``predict``, ``eval --checkpoint`` and a continued training make from its checkpoint.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from partialbench.benchmark import models
from partialbench.benchmark.testing import evaluate
from partialbench.benchmark.training import checkpoint, seeds
from partialbench.benchmark.training.train import Task
from partialbench.errors import InputError

CLOUDS = 2
TOLERANCE = 1e-4
"""How far the logits may move, as a share of their size: on a GPU equal weights do not always give
equal bits."""


def require_fresh(name: str, num_classes: int, options: Mapping[str, Any]) -> nn.Module:
    """A model of a factory that makes a new one each time.

    Raises:
        InputError: two of them share a trainable parameter, so that a second seed would begin from
            what the first has learned.
    """
    one, other = (models.create(name, num_classes, options) for _ in range(2))
    held = {_memory(p): n for n, p in one.named_parameters() if _memory(p)}
    shared = [held[_memory(p)] for p in other.parameters() if _memory(p) in held]
    if shared:
        raise InputError(
            f"{name} called twice gives two models that share {len(shared)} of their parameters "
            f"({', '.join(shared[:3])}): the second training would begin from what the first has "
            f"learned. Make the layers inside the factory, and keep none of them between calls"
        )
    return other


def _memory(parameter: Tensor) -> int:
    """Where a trainable parameter lies; 0 for one that is not trained, is empty or has no shape."""
    if not parameter.requires_grad or nn.parameter.is_lazy(parameter) or not parameter.numel():
        return 0
    return parameter.untyped_storage().data_ptr()


def require_made_again(
    content: Mapping[str, Any], trained: nn.Module, task: Task, device: torch.device | str
) -> None:
    """Holds the answers of a trained model against those of the one its checkpoint makes.

    Args:
        content: the checkpoint's. trained: the module that was saved in it, on ``device``.

    Raises:
        InputError: the weights make no such model, or one that answers otherwise.
    """
    with seeds.kept():
        made = checkpoint.build_model(content, task.model).to(device)
    for what, before, after in zip(
        ("class logits", "pose logits"),
        _answers(trained, task, device),
        _answers(made, task, device),
        strict=True,
    ):
        if before is None or after is None:
            continue
        size = float(before.square().mean()) ** 0.5 or 1.0
        moved = float((after - before).square().mean()) ** 0.5 / size
        if moved > TOLERANCE:
            raise InputError(
                f"{task.model} made from its checkpoint answers otherwise than the one that was "
                f"trained, its {what} move by {100 * moved:.2g} % of their size. Something that "
                f"its answers depend on is not in its state_dict: layers in a plain list; a tensor "
                f"or number, kept as an attribute, that training changes or the factory draws; a "
                f"buffer with persistent=False. Register it (nn.ModuleList, nn.Parameter, "
                f"register_buffer)"
            )


def _answers(
    model: nn.Module, task: Task, device: torch.device | str
) -> tuple[Tensor, Tensor | None]:
    rows, classes = task.train_rows[:CLOUDS], len(task.dataset.class_names)
    ((_, answer),) = evaluate.run_model(model, task.dataset, rows, classes, device)
    poses = answer.pose_logits
    return _centred(answer.class_logits), None if poses is None else _centred(poses)


def _centred(logits: Tensor) -> Tensor:
    """Less each cloud's mean, which no answer depends on; what is −∞ in both is no difference."""
    finite = logits.double().nan_to_num(neginf=0.0)
    return finite - finite.mean(dim=1, keepdim=True)
