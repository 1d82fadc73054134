"""The authors' checkpoints (TerenceHsu666/PAPNet@878adcc, on se3cnn@546bc68) → our state."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor, nn

from baselines.steerable import GatedBlock
from baselines.steerable.published import gated_block_state, linear_from_published
from papnet.model import PAPNet
from papnet.parts import ClassHead
from partialbench.errors import InputError

_BLOCKS = {
    **{
        name: f"backbone.{name}"
        for name in (
            *("conv1", "conv21", "conv22", "conv23", "conv24"),
            *("conv31", "conv32", "conv41", "conv42", "convp1"),
        )
    },
    "conv51": "pose_head.conv51",
    "conv52": "pose_head.conv52",
    "conv0_c": "class_head.conv0",
    "conv1_c": "class_head.conv1",
    "conv2_c": "class_head.conv2",
}

_DENSE = {
    **{"fc1": "pose_head.fc.0", "bn1": "pose_head.fc.1", "fc2": "pose_head.fc.3"},
    **{"bn2": "pose_head.fc.4", "fc3": "pose_head.fc.6"},
    **{"fc1_c": "class_head.fc.0", "bn1_c": "class_head.fc.1", "fc2_c": "class_head.fc.3"},
    **{"bn2_c": "class_head.fc.4", "fc3_c": "class_head.fc.6"},
}


def from_published(state: Mapping[str, Tensor], model: nn.Module) -> dict[str, Tensor]:
    """The released model's state dict in our names and basis.

    Kernels change their basis (``baselines.steerable.published``); the first linear layer of each
    head reads pooled vectors, so its columns do too. The rest keeps its numbers.

    Raises:
        InputError: an entry is unknown, missing or of another shape.
    """
    if not isinstance(model, PAPNet):
        raise InputError(f"expected a PAPNet, got {type(model).__name__}")
    for name in state:
        if name.partition(".")[0] not in _BLOCKS | _DENSE:
            raise InputError(f"the published state has {name!r}, which this model has no place for")
    ours: dict[str, Tensor] = {}
    for theirs, name in _BLOCKS.items():
        block = model.get_submodule(name)
        assert isinstance(block, GatedBlock)
        for key, value in gated_block_state(state, block, f"{theirs}.").items():
            ours[f"{name}.{key}"] = value
    for theirs, name in _DENSE.items():
        for key, target in model.get_submodule(name).state_dict().items():
            if f"{theirs}.{key}" not in state:
                if key == "num_batches_tracked":  # of no use but to training that goes on
                    ours[f"{name}.{key}"] = target
                    continue
                raise InputError(f"the published state has no '{theirs}.{key}'")
            value = state[f"{theirs}.{key}"]
            if value.shape != target.shape:
                raise InputError(
                    f"the published '{theirs}.{key}' is {tuple(value.shape)}, expected "
                    f"{tuple(target.shape)}; was it trained for another number of classes?"
                )
            ours[f"{name}.{key}"] = value
    for name, fields in (
        ("pose_head.fc.0.weight", model.pose_head.descriptor),
        ("class_head.fc.0.weight", ClassHead.descriptor),
    ):
        ours[name] = linear_from_published(ours[name], fields)
    return ours
