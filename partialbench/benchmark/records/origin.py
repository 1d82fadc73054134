"""What a training began from, as a record has it: plain data, see ``finetune.Start.origin``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def clouds_before(origin: Mapping[str, Any] | None) -> int:
    """Clouds seen by all trainings before one that began from ``origin``; None: random weights."""
    return 0 if origin is None else origin["clouds_seen"] + clouds_before(origin["start"])


def deviations(origin: Mapping[str, Any] | None) -> list[str]:
    """What a start changes about the published recipe, in a sentence."""
    if origin is None:
        return []
    data = origin["train_data"]
    return [
        f"begun from weights ({origin['name']}) trained on {clouds_before(origin):,} clouds, last "
        f"on {data['id']} with {data['points']} points, instead of from random ones"
    ]
