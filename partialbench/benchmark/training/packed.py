"""Packed weights: a finished training's, in 16 bits, for a release to carry.

Parameters are rounded to float16, buffers (running means and variances, counters) stay as they are:
they are few, and a small variance would round to nothing. The tensors lie in a safetensors file
under the model's own names; the card beside it (``records.weights``) says all that a checkpoint
says of its training. Read back, the two are a checkpoint again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as tensors_from
from safetensors.torch import save as bytes_of
from torch import Tensor

from partialbench.benchmark.records import weights
from partialbench.benchmark.testing.duplicates import KEY_DIGITS
from partialbench.benchmark.training import checkpoint, checkpoint_content
from partialbench.dataset.descriptions import terms
from partialbench.errors import InputError

PACKED = "weights rounded to 16 bits"
"""What a record of a test of packed weights says under its deviations."""


def load(path: Path) -> dict[str, Any]:
    """What a file of weights holds, a checkpoint or packed, as ``checkpoint.load`` gives it.

    Raises:
        InputError: see there; or packed weights, or their card, that are not as they were packed.
    """
    if path.suffix != weights.SUFFIX:
        return checkpoint.load(path)
    card = weights.read_card(path)
    state = _tensors(path, card)
    content = {
        **_named(card),
        "state": widened(state),
        "train_sources": _keys(path.parent, card["train_objects"]),
    }
    content["weights_sha256"] = checkpoint.weights_digest(content["state"])
    content["content_sha256"] = checkpoint.content_digest(content)
    try:
        checkpoint_content.check(content)
    except InputError as error:
        raise InputError(f"{path.with_suffix('.json')} is damaged: {error}") from error
    return content


def _named(card: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a checkpoint that a card has as they are."""
    return {
        "format": checkpoint.FORMAT,
        "format_version": checkpoint.FORMAT_VERSION,
        **card["identity"],
        "kind": "branch",
        "clouds": card["clouds"],
        "clouds_seen": card["clouds_seen"],
        "summary": card["summary"],
        "deviations": [PACKED],
    }


def rounded(content: Mapping[str, Any]) -> dict[str, Tensor]:
    """A checkpoint's weights as they are packed: every parameter in float16.

    Raises:
        InputError: a parameter that float16 cannot hold.
    """
    parameters = {name for name, _ in checkpoint.build_model(content).named_parameters()}
    packed = {}
    for name, tensor in sorted(content["state"].items()):
        half = tensor.half() if name in parameters else tensor
        if not bool(torch.isfinite(half).all()):
            raise InputError(
                f"{name} has a value of {float(tensor.abs().max()):g}, more than 16 bits hold "
                f"({torch.finfo(torch.float16).max:g}): these weights cannot be packed"
            )
        packed[name] = half.contiguous()
    return packed


def widened(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Packed weights as a model takes them: in 32 bits."""
    return {name: t.float() if t.dtype == torch.float16 else t for name, t in state.items()}


def packed_files(content: Mapping[str, Any], name: str) -> tuple[dict[str, bytes], dict[str, Any]]:
    """The files of a finished checkpoint but its card, and what the card says of them.

    Args:
        content: of a registered model: nobody else's code comes with a release.
        name: of the files.

    Returns:
        file name → bytes; the card's fields, without those of the tests.
    """
    state = rounded(content)
    keys = b"".join(bytes.fromhex(key) for key in content["train_sources"])
    listed = f"objects-{hashlib.sha256(keys).hexdigest()[:12]}.bin"
    files = {f"{name}{weights.SUFFIX}": bytes_of(state, {"format": "pt"}), listed: keys}
    first, second = (
        {"name": one, "bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        for one, data in files.items()
    )
    return files, {
        "format": weights.FORMAT,
        "format_version": weights.VERSION,
        "licence": terms(content["train_data"]["id"]),
        "file": first,
        "tensors_sha256": checkpoint.weights_digest(state),
        "checkpoint_sha256": content["weights_sha256"],
        "train_objects": second,
        "identity": {field: content[field] for field in checkpoint.IDENTITY},
        "clouds": content["clouds"],
        "clouds_seen": content["clouds_seen"],
        "summary": content["summary"],
    }


def _tensors(path: Path, card: Mapping[str, Any]) -> dict[str, Tensor]:
    data = _as_listed(path, card["file"])
    try:
        state = tensors_from(data)
    except (SafetensorError, ValueError, KeyError) as error:
        raise InputError(f"{path} is no safetensors file: {error}") from error
    if checkpoint.weights_digest(state) != card["tensors_sha256"]:
        raise InputError(f"{path}: its tensors are not those of its card; {weights.AGAIN}")
    return state


def _keys(folder: Path, listed: Mapping[str, Any]) -> list[str]:
    """See ``duplicates.source_keys``."""
    text = _as_listed(folder / listed["name"], listed).hex()
    return [text[i : i + KEY_DIGITS] for i in range(0, len(text), KEY_DIGITS)]


def _as_listed(path: Path, listed: Mapping[str, Any]) -> bytes:
    """A file's bytes.

    Raises:
        InputError: they are not those that the card lists.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}; {weights.AGAIN}") from error
    found = hashlib.sha256(data).hexdigest()
    if path.name != listed["name"] or found != listed["sha256"]:
        raise InputError(
            f"{path} is not the file its card lists (SHA-256 {found[:12]} of {len(data):,} bytes, "
            f"expected {listed['sha256'][:12]} of {listed['bytes']:,}): damaged, cut short or "
            f"edited; {weights.AGAIN}"
        )
    return data
