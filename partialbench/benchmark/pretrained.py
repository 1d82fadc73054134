"""Models by name, fresh or with the weights of a finished training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch import nn

from partialbench.benchmark import models
from partialbench.benchmark.records import weights
from partialbench.benchmark.training import finetune
from partialbench.errors import InputError


def create_model(
    name: str,
    num_classes: int | None = None,
    pretrained: bool | Path | str = False,
    **options: Any,
) -> nn.Module:
    """A model to train or to look at.

    Args:
        name: a registered name (``list_models``), or your "module:factory".
        num_classes: K ≥ 2; as many as the weights have where it is not given.
        pretrained: True for the weights that come with this release
            (``list_models(pretrained=True)``), or the checkpoint, or the run's folder, of a
            finished training of this model. Its last layer is taken if it has as many classes, and
            stays fresh if not.
        options: for the model's factory (``k=5``).

    Returns:
        A module that takes (B,N,3) float32 camera-frame clouds and returns a ``Prediction`` with
        ``class_logits`` (B,K), and ``pose_logits`` (B,60) where it has a pose head.

    Raises:
        InputError: no such model, option or checkpoint, or weights of another architecture.

    >>> import torch
    >>> model = create_model("pointnet", num_classes=5).eval()
    >>> model(torch.randn(2, 128, 3)).class_logits.shape
    torch.Size([2, 5])
    """
    if pretrained is False:
        if num_classes is None:
            raise InputError(f"how many classes {name} is to tell apart is missing: num_classes=40")
        return models.create(name, num_classes, options)
    start = finetune.load(weights.file_of(name) if pretrained is True else pretrained, name)
    if num_classes is None:
        num_classes = len(start.class_names)
    model = models.create(name, num_classes, options)
    # As many classes count as the same: a user who asked for them by number knows which they are.
    same = num_classes == len(start.class_names)
    names = start.class_names if same else [str(label) for label in range(num_classes)]
    finetune.begin(model, start, names, lambda count: models.create(name, count, options))
    return model
