"""Checkpoints: one file that resumes a training exactly, and that ``predict`` needs alone.

Written under a temporary name and renamed, so the file under its final name is always whole.
It loads with ``torch.load(weights_only=True)``: a stranger's checkpoint runs no code of its own.
"""

from __future__ import annotations

import io
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from partialbench.benchmark import models
from partialbench.dataset.shards import write_atomically
from partialbench.errors import InputError

FORMAT = "partialbench-checkpoint"
FORMAT_VERSION = 2

IDENTITY = (
    "model", "model_code", "variant", "options", "class_names", "num_points", "recipe", "protocol",
    "protocol_digest", "train_data", "seed",
)  # fmt: skip
"""What makes a training the one it is. Beside these a checkpoint has the weights (``state``)."""


def save(path: Path, identity: Mapping[str, Any], state: Mapping[str, Any]) -> None:
    """Writes identity and state atomically. Values are tensors and plain JSON-like data."""
    missing = [name for name in IDENTITY if name not in identity]
    assert not missing, f"a checkpoint needs {missing}"
    buffer = io.BytesIO()
    torch.save({"format": FORMAT, "format_version": FORMAT_VERSION, **identity, **state}, buffer)
    write_atomically(path, buffer.getvalue())


def load(path: Path | str) -> dict[str, Any]:
    """The checkpoint's contents on the CPU.

    Raises:
        InputError: no such file, not a checkpoint of ours, or of a later version.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"no checkpoint at {path}")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, pickle.UnpicklingError, EOFError, ValueError, OSError) as error:
        raise InputError(
            f"{path} is not a checkpoint that loads safely (weights only): {error}"
        ) from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(
            f"{path} was not written by partialbench eval. Weights of a published implementation "
            f"are converted with partialbench.registry.load_published"
        )
    if content["format_version"] != FORMAT_VERSION:
        raise InputError(
            f"{path} is a checkpoint of format {content['format_version']}, this version reads "
            f"{FORMAT_VERSION}"
        )
    content.setdefault("model_code", "")  # checkpoints have not always said it
    return content


def changed_code(content: Mapping[str, Any]) -> str:
    """In what the file of a user's own model is not the one that was trained, "" where it is."""
    now = models.code_digest(content["model"])
    if content["model_code"] == now:
        return ""
    return (
        f"the file of {content['model']} has changed since the training (SHA-256 "
        f"{content['model_code'][:12] or 'unknown'} then, {now[:12]} now)"
    )


def build_model(content: Mapping[str, Any]) -> nn.Module:
    """The checkpoint's model in evaluation mode, on the CPU."""
    model = models.create(content["model"], len(content["class_names"]), content["options"])
    try:
        model.load_state_dict(content["state"])
    except RuntimeError as error:
        raise InputError(
            f"the checkpoint's weights do not fit the model {content['model']!r} as it is now: "
            f"{error}"
        ) from error
    return model.eval()


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
