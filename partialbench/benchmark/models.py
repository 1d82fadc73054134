"""Making a model by name, and meeting one that returns bare logits."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from partialbench import registry
from partialbench.benchmark.prediction import Prediction
from partialbench.dataset.shards import file_sha256
from partialbench.errors import InputError
from partialbench.geometry.bins import NUM_BINS
from partialbench.registry import ModelCard


def create(name: str, num_classes: int, options: Mapping[str, Any] | None = None) -> nn.Module:
    """A fresh model: a registered name, or a user's "module:factory" found from the current folder.

    Raises:
        InputError: no such model, or what the factory returned is no ``torch.nn.Module``.
    """
    if ":" in name and (here := str(Path.cwd())) not in sys.path:
        # An installed command does not look in the folder it is run from, as ``python -m`` does.
        sys.path.insert(0, here)
    model = registry.create(name, num_classes, **(options or {}))
    if not isinstance(model, nn.Module):
        raise InputError(
            f"{name} returned a {type(model).__name__}; expected a torch.nn.Module: the factory is "
            f"called as factory(num_classes) and returns the model"
        )
    return model


def code_digest(name: str) -> str:
    """SHA-256 of the file that a user's "module:factory" is in; "" for a registered name.

    Of that file alone: what it imports is not followed. Call it after ``create``, which finds it.
    """
    if ":" not in name:
        return ""
    file = getattr(importlib.import_module(name.partition(":")[0]), "__file__", None)
    return file_sha256(Path(file)) if file else ""


def card_of(name: str) -> ModelCard:
    """The registered card, or a bare one for a user's own model: default recipe, no claims."""
    if ":" in name:
        return ModelCard(name=name, entry=name, title=name, paper="")
    return registry.card(name)


def as_prediction(output: Any, num_clouds: int, num_classes: int) -> Prediction:
    """What a model returned, as a ``Prediction`` of the right shape.

    Args:
        output: a ``Prediction`` or a bare (B,K) tensor of logits.

    Raises:
        InputError: anything else, with what was got and what was expected.
    """
    prediction = Prediction(output) if isinstance(output, Tensor) else output
    if not isinstance(prediction, Prediction):
        raise InputError(
            f"the model returned a {type(output).__name__}; expected (B,K) class logits as a "
            f"tensor, or a partialbench.benchmark.prediction.Prediction"
        )
    shapes = [("class_logits", prediction.class_logits, (num_clouds, num_classes))]
    if prediction.pose_logits is not None:
        shapes.append(("pose_logits", prediction.pose_logits, (num_clouds, NUM_BINS)))
    if prediction.candidates is not None:
        logits, classes = prediction.candidates
        ensemble = (num_clouds, logits.shape[-1])
        shapes += [("candidate logits", logits, ensemble), ("candidate classes", classes, ensemble)]
    for field, tensor, expected in shapes:
        if tuple(tensor.shape) != expected:
            raise InputError(
                f"the model's {field} have shape {tuple(tensor.shape)}, expected {expected} for "
                f"{num_clouds} clouds"
            )
    return prediction


def num_parameters(model: nn.Module) -> int:
    """Trainable parameters."""
    return sum(p.numel() for p in model.parameters() if p.requires_grad)
