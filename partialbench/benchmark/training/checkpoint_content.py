"""What the fields of a checkpoint must be, so that nothing after its loading meets a surprise."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

from partialbench.benchmark.protocol import protocol as protocols
from partialbench.benchmark.protocol import recipe as recipes
from partialbench.benchmark.records.results import DataRecord
from partialbench.errors import InputError
from partialbench.options import is_plain
from partialbench.registry import Recipe

_DEEPEST = 12
_MOST = 5_000_000
"""Values a checkpoint may hold; a few bytes of a pickle can stand for any number of them."""


def check(content: Mapping[str, Any]) -> None:
    """Raises ``InputError`` for a field that is missing or is not what it should be."""
    for name in content:
        if not isinstance(name, str):
            raise InputError(f"a field is called {name!r}")
    _count(content, 0, [0])
    for name, (what, fits) in _FIELDS.items():
        if name not in content:
            raise InputError(f"it lacks {name}")
        if not fits(content[name]):
            raise InputError(f"its {name} is not {what}")
    for name, (what, fits) in _OPTIONAL.items():
        if name in content and not fits(content[name]):
            raise InputError(f"its {name} is not {what}")
    if len(set(content["class_names"])) != len(content["class_names"]):
        raise InputError("a class is named twice")
    try:
        followed = protocols.from_dict(dict(content["protocol"]))
        known = {f.name for f in fields(Recipe)}
        if set(content["recipe"]) | set(recipes.LATER) != known:
            raise InputError(f"a recipe has the fields {', '.join(sorted(known))}")
        recipes.override(Recipe(), content["recipe"])
        DataRecord(**content["train_data"])
    except (InputError, TypeError, ValueError, KeyError) as error:
        raise InputError(f"what it says of its training is broken: {error}") from error
    if followed.digest != content["protocol_digest"]:
        raise InputError("its protocol is not the one of its protocol_digest")


def _count(value: Any, depth: int, counted: list[int]) -> None:
    counted[0] += 1
    if depth > _DEEPEST or counted[0] > _MOST:
        raise InputError("its data are nested deeper, or are more, than any training's")
    if isinstance(value, Tensor):
        size = value.numel() * value.element_size()
        if value.layout is not torch.strided or value.is_quantized or value.device.type != "cpu":
            raise InputError("it holds a tensor that is not a plain one")
        if size > value.untyped_storage().nbytes():
            raise InputError("it holds a tensor that is larger than its data")
        return
    if isinstance(value, Mapping):
        for key, item in value.items():
            _count(key, depth + 1, counted)
            _count(item, depth + 1, counted)
    elif isinstance(value, list | tuple):
        for item in value:
            _count(item, depth + 1, counted)
    elif not (value is None or isinstance(value, bool | int | float | str)):
        raise InputError(f"it holds a {type(value).__name__}; expected tensors and plain data")


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, str) for item in value)


def _is_state(value: Any) -> bool:
    return isinstance(value, Mapping) and all(
        isinstance(name, str) and isinstance(tensor, Tensor) for name, tensor in value.items()
    )


def _is_summary(value: Any) -> bool:
    """With what tests and later trainings ask of a finished one."""
    if not isinstance(value, Mapping) or not _is_whole(value.get("clouds_seen")):
        return False
    environment, start = value.get("environment"), value.get("start")
    return (
        isinstance(environment, Mapping)
        and isinstance(environment.get("precision"), str)
        and (start is None or _is_start(start))
        and isinstance(value.get("seconds"), int | float)
    )


def _is_start(value: Any) -> bool:
    if not isinstance(value, Mapping) or not isinstance(value.get("name"), str):
        return False
    data, before = value.get("train_data"), value.get("start")
    return (
        _is_whole(value.get("clouds_seen"))
        and isinstance(data, Mapping)
        and {"id", "points"} <= set(data)
        and (before is None or _is_start(before))
    )


_Field = tuple[str, Callable[[Any], bool]]
_TEXT: _Field = ("text", lambda v: isinstance(v, str))
_NUMBER: _Field = (
    "a number", lambda v: isinstance(v, int | float) and not isinstance(v, bool)
)  # fmt: skip
_COUNT: _Field = ("a whole number, not negative", lambda v: _is_whole(v) and v >= 0)
_TEXTS: _Field = ("a list of texts", _is_texts)
_MAPPING: _Field = ("a mapping", lambda v: isinstance(v, dict))

_FIELDS: dict[str, _Field] = {
    "model": _TEXT,
    "model_code": _TEXT,
    "variant": _TEXT,
    "options": ("a mapping of plain data", lambda v: isinstance(v, dict) and is_plain(v)),
    "class_names": ("two names or more", lambda v: _is_texts(v) and len(v) >= 2),
    "num_points": ("a positive whole number", lambda v: _is_whole(v) and v >= 1),
    "recipe": _MAPPING,
    "protocol": _MAPPING,
    "protocol_digest": _TEXT,
    "train_data": _MAPPING,
    "seed": ("a whole number", _is_whole),
    "state": ("names with tensors", _is_state),
    "weights_sha256": _TEXT,
    "content_sha256": _TEXT,
}
_OPTIONAL: dict[str, _Field] = {
    "epoch": _COUNT,
    "batch": _COUNT,
    "loss_sum": _NUMBER,
    "seconds": _NUMBER,
    "history": ("a list", lambda v: isinstance(v, list)),
    "environments": ("a list", lambda v: isinstance(v, list)),
    "train_sources": _TEXTS,
    "average": ("names with tensors", _is_state),
    "averaged": _COUNT,
    "deviations": _TEXTS,
    "summary": ("a finished training's summary", _is_summary),
}
