"""The command that makes a row again, from what its record says."""

from __future__ import annotations

import re
import shlex
from typing import Any

from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.protocol.protocol import PRESETS
from partialbench.benchmark.records.results import Result
from partialbench.benchmark.variant import pairs_text

_RECIPE = re.compile(r"(?:^|; )recipe (.*?)(?=; start |; precision |$)")
_PRECISION = re.compile(r"(?:^|; )precision (\S+)$")


def reproduce(seeds: tuple[Result, ...]) -> str:
    """``partialbench eval …`` for the seeds of one row.

    Data folders are called as their data sets are. A row that began from the weights of another
    training says so by a placeholder, for a record names those by digest alone.
    """
    first = seeds[0]
    words = [
        "partialbench",
        "eval",
        "--model",
        first.model,
        "--data",
        f"data/{first.train_data.id}",
    ]
    if first.test_data.digest != first.train_data.digest and (
        first.test_data.id != first.train_data.id
        or first.test_data.setting != first.train_data.setting
    ):
        words += ["--test-data", f"data/{first.test_data.id}"]
    words += ["--preset", str(first.protocol["preset"]).removesuffix("+")]
    for text in _changed_protocol(first.protocol):
        words += ["--protocol", text]
    words += ["--clouds", milestones.name(first.clouds)]
    for name, value in sorted(first.options.items()):
        words += ["--option", pairs_text({name: value})]
    if recipe := _RECIPE.search(first.variant):
        for text in recipe[1].split(" "):
            words += ["--recipe", text]
    if precision := _PRECISION.search(first.variant):
        words += ["--precision", precision[1]]
    if first.training.get("start"):
        words += ["--start-from", "CHECKPOINT"]
    numbers = [result.seed for result in seeds]
    if len(numbers) > 1:
        words += ["--seeds", str(numbers[-1] - numbers[0] + 1)]
    if numbers[0]:
        words += ["--first-seed", str(numbers[0])]
    return shlex.join(words)


def _changed_protocol(used: dict[str, Any]) -> list[str]:
    """ "field=value" of each field that is not the preset's."""
    preset = PRESETS.get(str(used["preset"]).removesuffix("+"))
    if preset is None or preset.version != used["version"]:
        return []
    own = preset.as_dict()
    return [
        pairs_text({name: value})
        for name, value in used.items()
        if name != "preset" and own.get(name) != value
    ]
