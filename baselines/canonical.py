"""What the wrappers share that turn a cloud into a frame of its own before any classifier."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

from baselines.points import as_weights
from partialbench import registry
from partialbench.benchmark.inputs import needs_normals
from partialbench.benchmark.models import as_prediction
from partialbench.benchmark.prediction import Prediction
from partialbench.errors import InputError

RELEASED = "released"
"""The name of the network that a wrapper's publication has behind its frame."""


class Backbone(nn.Module):
    """A classifier of clouds that stand in a frame of their own.

    Args:
        num_classes: K.
        name: registered, or a user's "module:factory"; ``RELEASED`` for ``released``.
        options: of its factory.
        released: makes the publication's network, which takes clouds as they are.

    Raises:
        InputError: of the name or the options, see ``registry.create``, or a network that takes
            normals.
    """

    def __init__(
        self,
        num_classes: int,
        name: str,
        options: Mapping[str, Any],
        released: type[nn.Module],
    ) -> None:
        super().__init__()
        self.name, self.num_classes = name, num_classes
        if name == RELEASED:
            if options:
                raise InputError(f"backbone {name!r} has no options, got {dict(options)}")
            self.network = released(num_classes)
        else:
            self.network = registry.create(name, num_classes, **options)
            if needs_normals(self.network):
                raise InputError(
                    f"backbone {name!r} takes normals, which a frame does not hand on; take one of "
                    f"points alone"
                )

    def forward(self, points: Tensor) -> Prediction:
        """(B,N,3) in the frame → logits (B,K) and the network's own penalty.

        Raises:
            InputError: of a network that predicts a pose. It would be that of the frame.
        """
        output = as_prediction(
            self.network(as_weights(points, self)), len(points), self.num_classes
        )
        if output.pose_logits is not None:
            raise InputError(
                f"backbone {self.name!r} predicts a pose, which in a canonical frame is not the "
                f"camera's; take one that predicts classes alone"
            )
        return output
