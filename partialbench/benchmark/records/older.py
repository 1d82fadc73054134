"""Records of earlier formats, read as today's: a record is never rewritten.

- Format 2 did not say of a split what ``results.DataRecord`` has a default for.
- Up to 3 no pose was given.
- Up to 4 a training's precision was no part of its row's name; a user's model had no digest of its
  code; deviations named the number of epochs of the recipe as used as the published one; and where
  several test sets were tested at once, the turned clouds were the first one's.
"""

from __future__ import annotations

from typing import Any

from partialbench.benchmark.environment import FULL_PRECISION
from partialbench.benchmark.protocol import protocol as protocols
from partialbench.benchmark.protocol import recipe as recipes
from partialbench.benchmark.records import origin
from partialbench.registry import Recipe

_ADDED = {"given_pose": (4, ""), "model_code": (5, "")}
"""Field → the format it came with, and what earlier records would have said."""


def lacking(version: int) -> dict[str, str]:
    """The fields that a format does not have, with what its records would have said."""
    return {name: value for name, (since, value) in _ADDED.items() if version < since}


def upgraded(record: dict[str, Any]) -> dict[str, Any]:
    """The fields of a record of an earlier format as today's has them."""
    training, card, used = record["training"], record["card"], record["recipe"]
    variant, precision = record["variant"], training["environment"]["precision"]
    if precision != FULL_PRECISION:
        variant = " ".join(sorted([*variant.split(), f"precision={precision}"]))
    train, test = record["train_data"], record["test_data"]
    return {
        **lacking(record["format_version"]),
        **record,
        "variant": variant,
        "deviations": [
            *recipes.deviations(
                Recipe(**card["recipe"]), Recipe(**used),
                protocols.from_dict(record["protocol"]), train["clouds"],
                training["clouds_seen"],
            ),
            *origin.deviations(training.get("start")),
        ],
        # Nothing says whether this test set was the first.
        "rotation_audit": record["rotation_audit"] if test["id"] == train["id"] else {},
    }  # fmt: skip
