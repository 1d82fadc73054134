"""What was changed about a model, as text of a row and as part of a file's name. One of each.

Options of the factory and fields of the recipe are told apart, whatever they are called: a row is
``papnet [grid=16; recipe lr=0.002; precision bf16-mixed]``. No two different changes have one text,
nor one file name.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
from collections.abc import Mapping
from typing import Any

from partialbench.benchmark.preflight import FULL_PRECISION
from partialbench.errors import InputError
from partialbench.options import plain

LONGEST = 60
"""Characters of a part of a file name; a longer one is cut, with a hash of the whole."""

_SAFE = re.compile(r"[a-z0-9=+][a-z0-9.=+-]*")
_BARE = re.compile(r"[^\s;=,\[\]{}\"'\\]+")


def with_changes(name: str, changes: str) -> str:
    """A name and, in brackets, what was changed about it: "papnet [grid=16]"."""
    return f"{name} [{changes}]" if changes else name


def describe_changes(
    recipe: Mapping[str, Any],
    options: Mapping[str, Any],
    origin: Mapping[str, Any] | None = None,
    precision: str = FULL_PRECISION,
) -> str:
    """What was changed about a model, its recipe, start or precision, as a row has it in brackets.

    A model's answers depend on the precision it was trained in, so it is told where it is not full.
    """
    parts = [pairs_text(options)]
    if recipe:
        parts.append(f"recipe {pairs_text(recipe)}")
    if origin is not None:
        parts.append(f"start {origin['name']}")
    if precision != FULL_PRECISION:
        parts.append(f"precision {precision}")
    return "; ".join(part for part in parts if part)


def pairs_text(changed: Mapping[str, Any]) -> str:
    """ "k=v k=v", sorted; as the command line takes them, but for text that would need quotes."""
    return " ".join(f"{name}={_value(value)}" for name, value in sorted(changed.items()))


def _value(value: Any) -> str:
    """JSON, and bare text where that cannot be taken for anything else."""
    if isinstance(value, str) and _BARE.fullmatch(value) and value.isprintable():
        with contextlib.suppress(InputError):  # "NaN"
            if plain(value) == value:
                return value
    return json.dumps(value, ensure_ascii=False, sort_keys=True, separators=(",", ":"))


def file_name(*parts: str) -> str:
    """The parts that are not empty, joined by "_".

    A part with more than lower-case ASCII letters, digits and ".=+-", or a long one, is cleaned and
    cut, and ends with eight digits of its SHA-256: two parts never come to one name, not on a file
    system that does not tell capitals either.
    """
    return "_".join(_file_part(part) for part in parts if part)


def _file_part(part: str) -> str:
    if _SAFE.fullmatch(part) and len(part) <= LONGEST:
        return part
    cleaned = re.sub(r"[^A-Za-z0-9.=+-]+", "-", part).strip("-.")[:LONGEST].strip("-.")
    short = hashlib.sha256(part.encode("utf-8", "surrogatepass")).hexdigest()[:8]
    return f"{cleaned}-{short}" if cleaned else short
