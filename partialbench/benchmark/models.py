"""Making a model by name, and meeting one that returns bare logits.

torch is loaded by what makes or meets a model: its card and its options are read without.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from partialbench import registry, user_code
from partialbench.benchmark.prediction import Prediction
from partialbench.errors import InputError
from partialbench.geometry.bins import NUM_BINS
from partialbench.options import without_defaults
from partialbench.registry import ModelCard

if TYPE_CHECKING:
    from torch import nn


def create(name: str, num_classes: int, options: Mapping[str, Any] | None = None) -> nn.Module:
    """A fresh model: a registered name, or a user's "module:factory" found from the current folder.

    Raises:
        InputError: no such model, or what the factory returned is no ``torch.nn.Module``.
    """
    model = registry.create(name, num_classes, **(options or {}))
    from torch import nn

    if not isinstance(model, nn.Module):
        raise InputError(
            f"{name} returned a {type(model).__name__}; expected a torch.nn.Module: the factory is "
            f"called as factory(num_classes) and returns the model"
        )
    return model


def chosen_options(name: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Options as rows are told apart by: typed, and without those that are the defaults anyway."""
    return without_defaults(registry.factory_of(name), registry.options_of(name, given))


def code_digest(name: str) -> str:
    """SHA-256 of the file that a user's "module:factory" is in, as it was imported; "" for a
    registered name.

    Of that file alone: what it imports is not followed.
    """
    return user_code.digest(name) if user_code.is_own(name) else ""


def card_of(name: str) -> ModelCard:
    """The registered card, or a bare one for a user's own model: default recipe, no claims."""
    if user_code.is_own(name):
        return ModelCard(name=name, entry=name, title=name, paper="")
    return registry.card(name)


def as_prediction(output: Any, num_clouds: int, num_classes: int) -> Prediction:
    """What a model returned, as a ``Prediction`` of the right shape.

    Args:
        output: a ``Prediction`` or a bare (B,K) tensor of logits.

    Raises:
        InputError: anything else, with what was got and what was expected.
    """
    from torch import Tensor

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
