"""Checkpoints: one file that resumes a training exactly, and that ``predict`` needs alone.

Written under a temporary name and renamed, so the file under its final name is always whole.
A stranger's checkpoint is data: it loads as tensors and plain values, it is held against its own
digests, and it makes no model but a registered one or the one that the user names themselves.
"""

from __future__ import annotations

import hashlib
import io
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from partialbench import registry, user_code
from partialbench.benchmark import models
from partialbench.benchmark.training import checkpoint_content
from partialbench.dataset.shards import write_atomically
from partialbench.errors import InputError

FORMAT = "partialbench-checkpoint"
FORMAT_VERSION = 3

IDENTITY = (
    "model", "model_code", "variant", "options", "class_names", "num_points", "recipe", "protocol",
    "protocol_digest", "train_data", "seed",
)  # fmt: skip
"""What makes a training the one it is. Beside these a checkpoint has the weights (``state``)."""


def save(path: Path, identity: Mapping[str, Any], state: Mapping[str, Any]) -> None:
    """Writes identity and state atomically. Values are tensors and plain JSON-like data."""
    missing = [name for name in IDENTITY if name not in identity]
    assert not missing, f"a checkpoint needs {missing}"
    content = {"format": FORMAT, "format_version": FORMAT_VERSION, **identity, **state}
    content["weights_sha256"] = weights_digest(state["state"])
    content["content_sha256"] = content_digest(content)
    buffer = io.BytesIO()
    torch.save(content, buffer)
    write_atomically(path, buffer.getvalue())


def load(path: Path | str) -> dict[str, Any]:
    """The checkpoint's contents on the CPU.

    Raises:
        InputError: no such file, not a checkpoint of ours or of another version, or not as it was
            written: a bit of it is another, or a field is missing or not of its type.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"no checkpoint at {path}")
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    _require_whole(raw, path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            content = torch.load(io.BytesIO(raw), map_location="cpu", weights_only=True)
    except Exception as error:  # a broken pickle fails in any way there is
        reason = str(error).strip().partition("\n")[0][:200]
        raise InputError(
            f"{path} is not a checkpoint that loads safely (weights only): "
            f"{type(error).__name__}: {reason}"
        ) from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(
            f"{path} was not written by partialbench eval. Weights of a published implementation "
            f"are converted with partialbench.registry.load_published"
        )
    if content.get("format_version") != FORMAT_VERSION:
        raise InputError(
            f"{path} is a checkpoint of format {content.get('format_version')!r}, this version "
            f"reads {FORMAT_VERSION}: train again, or use the release that wrote it"
        )
    try:
        checkpoint_content.check(content)
        whole = content_digest(content) == content["content_sha256"]
        whole = whole and weights_digest(content["state"]) == content["weights_sha256"]
    except InputError as error:
        raise InputError(f"{path} is not a checkpoint as eval writes it: {error}") from error
    if not whole:
        raise InputError(
            f"{path} was changed after it was written: its digest does not fit. Copy it again from "
            f"where it was made, or train again"
        )
    return content


def _require_whole(raw: bytes, path: Path) -> None:
    """Raises ``InputError`` for what is no archive of torch, or one with a wrong checksum or size.

    Before it is unpickled: torch looks at no checksum and believes a header's sizes.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            entries = archive.infolist()
            packed = any(entry.compress_type != zipfile.ZIP_STORED for entry in entries)
            if packed or sum(entry.file_size for entry in entries) > len(raw):
                raise InputError(
                    f"{path} is no checkpoint: torch stores its parts as they are, this one says "
                    f"they are larger than the file"
                )
            damaged = archive.testzip()
    except InputError:
        raise
    except Exception as error:  # no archive, a cut one, or one with nonsense in its directory
        raise InputError(
            f"{path} is no checkpoint, or it is damaged ({error}): copy it again from where it was "
            f"made, or train again"
        ) from error
    if damaged is not None:
        raise InputError(
            f"{path} is damaged: the checksum of its part {damaged} is wrong. Copy it again from "
            f"where it was made, or train again"
        )


def weights_digest(state: Mapping[str, Tensor]) -> str:
    """SHA-256 (hex) over the name, dtype, shape and bytes of every tensor, sorted by name."""
    digest = hashlib.sha256()
    for name in sorted(state):
        digest.update(f"{name}\0".encode("utf-8", "surrogatepass"))
        _digest_tensor(digest, state[name])
    return digest.hexdigest()


def content_digest(content: Mapping[str, Any]) -> str:
    """SHA-256 (hex) over all that a checkpoint holds but this digest, in its order."""
    digest = hashlib.sha256()
    _digest(digest, {name: value for name, value in content.items() if name != "content_sha256"})
    return digest.hexdigest()


def _digest(digest: Any, value: Any) -> None:
    if isinstance(value, Tensor):
        _digest_tensor(digest, value)
    elif isinstance(value, dict):
        digest.update(f"dict {len(value)}\0".encode())
        for key, item in value.items():
            _digest(digest, key)
            _digest(digest, item)
    elif isinstance(value, list | tuple):
        digest.update(f"{type(value).__name__} {len(value)}\0".encode())
        for item in value:
            _digest(digest, item)
    else:
        assert value is None or isinstance(value, bool | int | float | str), type(value)
        text = f"{type(value).__name__} {value!r}\0"
        digest.update(text.encode("utf-8", "surrogatepass"))


def _digest_tensor(digest: Any, tensor: Tensor) -> None:
    flat = tensor.detach().cpu().contiguous()
    digest.update(f"{flat.dtype} {tuple(flat.shape)}\0".encode())
    digest.update(flat.reshape(-1).view(torch.uint8).numpy().data)


def changed_code(content: Mapping[str, Any], model: str | None = None) -> str:
    """In what the file of a user's own model is not the one that was trained, "" where it is.

    Args:
        model: as the user named it, see ``build_model``.
    """
    now = models.code_digest(model_of(content, model))
    if content["model_code"] == now:
        return ""
    return (
        f"the file of {model or content['model']} has changed since the training (SHA-256 "
        f"{content['model_code'][:12] or 'unknown'} then, {now[:12]} now)"
    )


def model_of(content: Mapping[str, Any], model: str | None = None) -> str:
    """The name of the model to make: never one of the user's own because a file says so.

    Args:
        model: what the user named, None for nothing.

    Raises:
        InputError: the checkpoint is of a model that is not registered and none was named, or of
            another one than was.
    """
    stored = content["model"]
    if user_code.is_own(stored):
        if model is None or not user_code.is_own(model):
            raise InputError(
                f"the checkpoint is of a model that is not one of ours, {stored!r}. Code is "
                f"imported only if you name it: give --model with the module:factory that you know "
                f"it is of"
            )
        return model
    if model not in (None, stored):
        raise InputError(f"the checkpoint holds a {stored!r}, not a {model!r}")
    return registry.card(stored).name


def build_model(content: Mapping[str, Any], model: str | None = None) -> nn.Module:
    """The checkpoint's model in evaluation mode, on the CPU.

    Args:
        model: a user's own "module:factory", as the user named it: what the checkpoint says is not
            imported. Not needed for a registered model.

    Raises:
        InputError: see ``model_of``; or the weights are not those of such a model.
    """
    name = model_of(content, model)
    built = models.create(name, len(content["class_names"]), content["options"])
    wanted, given = built.state_dict(), content["state"]
    wrong = [
        key
        for key in dict.fromkeys([*wanted, *given])
        if key not in wanted
        or key not in given
        or wanted[key].shape != given[key].shape
        or wanted[key].dtype != given[key].dtype
    ]
    if wrong:
        raise InputError(
            f"the checkpoint's weights do not fit the model {name!r} as it is now: "
            + ", ".join(
                f"{key} is {_shape(given.get(key))}, expected {_shape(wanted.get(key))}"
                for key in wrong[:3]
            )
            + (f" and {len(wrong) - 3} more" if len(wrong) > 3 else "")
        )
    try:
        built.load_state_dict(given)
    except Exception as error:  # a module may have a way of its own
        raise InputError(
            f"the checkpoint's weights do not fit the model {name!r} as it is now: {error}"
        ) from error
    return built.eval()


def require_finished(content: Mapping[str, Any], path: Path | str, purpose: str) -> None:
    """Raises InputError for the state of a training that is not done, saying what it is.

    Args:
        purpose: what a finished one is asked for: "be tested".
    """
    if "summary" in content:
        return
    seen = f"{content['clouds_seen']:,} clouds"
    if content["kind"] == "trunk":
        what = f"the trunk of a training at {seen}, from which its milestones branch"
    else:
        what = f"an interrupted branch at {seen} of its {content['clouds']:,}"
    raise InputError(
        f"{path} is {what}; it is not a finished training and cannot {purpose}. Run the same eval "
        f"again, and take the checkpoint.pt of one of its branches"
    )


def _shape(tensor: Tensor | None) -> str:
    if tensor is None:
        return "absent"
    return f"{str(tensor.dtype).removeprefix('torch.')} {tuple(tensor.shape)}"
