"""The command that makes a row again, from what its record says."""

from __future__ import annotations

import re
import shlex
from typing import Any

from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.protocol.protocol import PRESETS
from partialbench.benchmark.records.results import DataRecord, Result
from partialbench.benchmark.variant import pairs_text

_RECIPE = re.compile(r"^(?:; )?recipe (.*?)(?=; start |; precision |$)")
_PRECISION = re.compile(r"(?:^|; )precision (\S+)$")


def reproduce(seeds: tuple[Result, ...]) -> str:
    """``partialbench eval …`` for the seeds of one row; a line for each run of seeds in a row.

    Data folders are called as their data sets are, and as their settings where those tell them
    apart. A row that began from the weights of another training says so by a placeholder, for a
    record names those by digest alone.
    """
    first = seeds[0]
    train, test = first.train_data, first.test_data
    words = ["partialbench", "eval", "--model", first.model, "--data"]
    if test.id != train.id:
        words += [f"data/{train.id}", "--test-data", f"data/{test.id}"]
    elif test.setting != train.setting:
        words += [_folder(train), "--test-data", _folder(test)]
    else:
        words.append(f"data/{train.id}")
    words += ["--preset", str(first.protocol["preset"]).removesuffix("+")]
    for text in _changed_protocol(first.protocol):
        words += ["--protocol", text]
    words += ["--clouds", milestones.name(first.clouds)]
    for name, value in sorted(first.options.items()):
        words += ["--option", pairs_text({name: value})]
    # An option's text may hold the very words.
    rest = first.variant.removeprefix(pairs_text(first.options))
    if recipe := _RECIPE.search(rest):
        for text in recipe[1].split(" "):
            words += ["--recipe", text]
    if precision := _PRECISION.search(rest):
        words += ["--precision", precision[1]]
    if first.training.get("start"):
        words += ["--start-from", "CHECKPOINT"]
    return "\n".join(shlex.join([*words, *run]) for run in _runs([r.seed for r in seeds]))


def _folder(data: DataRecord) -> str:
    return f"data/{data.id}-{data.setting}"


def _runs(seeds: list[int]) -> list[list[str]]:
    """The arguments for each stretch of consecutive seeds, of rising ones."""
    stretches: list[list[int]] = []
    for seed in seeds:
        if stretches and seed == stretches[-1][-1] + 1:
            stretches[-1].append(seed)
        else:
            stretches.append([seed])
    return [
        (["--seeds", str(len(each))] if len(each) > 1 else [])
        + (["--first-seed", str(each[0])] if each[0] else [])
        for each in stretches
    ]


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
