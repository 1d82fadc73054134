"""Whether what a ``manifest.json`` holds is of the kinds that a manifest's fields are.

A digest proves that a configuration is the recorded one. What it does not cover (counts, names of
files) comes from a file that anybody may have edited, and is trusted by every reader of the data.
"""

from __future__ import annotations

from typing import Any

from partialbench.errors import InputError

_WHOLE = {
    "dataset_id": str, "configuration": dict, "class_names": list, "state": str, "shards": list,
    "listing": str, "listing_failures": list, "digests": dict, "versions": dict,
    "card_sha256": str, "format_version": int,
}  # fmt: skip
_ENTRY = {
    "file": str, "split": str, "index": int, "rows": int, "objects": int, "bytes": int,
    "sha256": str, "failures": list, "objects_sha256": str,
}  # fmt: skip
_CONFIGURATION = {
    "source": dict, "occluder": dict, "setting": str, "views": dict, "points": int, "seed": int,
}  # fmt: skip
_STATES = ("building", "complete")


def require_sound(data: Any, where: str) -> None:
    """Raise ``InputError`` naming the first field that is not what it should be.

    Args:
        data: the parsed JSON.
        where: what the error calls the file.
    """
    if not isinstance(data, dict):
        raise InputError(f"{where} is damaged: it holds a {type(data).__name__}, no manifest")
    _require(data, _WHOLE, where, "")
    _require(data.get("configuration"), _CONFIGURATION, where, "configuration.")
    if absent := [name for name in _CONFIGURATION if name not in data["configuration"]]:
        raise InputError(f"{where} was edited: its configuration lacks {', '.join(absent)}")
    if data.get("state") not in _STATES:
        raise InputError(f"{where} is damaged: state is {data.get('state')!r}, expected {_STATES}")
    for name in ("class_names", "digests", "versions"):
        held = data[name]
        values = held.values() if isinstance(held, dict) else held
        if not all(isinstance(value, str) for value in values):
            raise InputError(f"{where} is damaged: {name} holds something that is no text")
    seen: set[str] = set()
    for n, entry in enumerate(data["shards"]):
        if not isinstance(entry, dict):
            raise InputError(f"{where} is damaged: shards[{n}] is {entry!r}")
        _require(entry, _ENTRY, where, f"shards[{n}].")
        file = entry["file"]
        if "/" in file or "\\" in file or file.startswith(".") or file in seen:
            raise InputError(
                f"{where} was edited: shards[{n}].file is {file!r}, expected the name of a file in "
                f"the folder, once"
            )
        if bool(file) != (entry["rows"] > 0):
            raise InputError(
                f"{where} was edited: shards[{n}] has {entry['rows']} rows in the file {file!r}"
            )
        seen |= {file} - {""}
    for failure in [*data["listing_failures"], *(f for e in data["shards"] for f in e["failures"])]:
        if not (isinstance(failure, dict) and isinstance(failure.get("kind"), str)):
            raise InputError(f"{where} is damaged: a failure is {failure!r}")


def _require(data: Any, kinds: dict[str, type], where: str, prefix: str) -> None:
    if not isinstance(data, dict):
        raise InputError(f"{where} is damaged: {prefix.rstrip('.')} is {data!r}")
    for name, kind in kinds.items():
        value = data.get(name)
        if name not in data:
            continue  # what must be there is missed where it is taken
        if not isinstance(value, kind) or isinstance(value, bool):
            raise InputError(
                f"{where} is damaged: {prefix}{name} is {value!r:.80}, expected {kind.__name__}"
            )
        if isinstance(value, int) and value < 0:
            raise InputError(f"{where} is damaged: {prefix}{name} is {value}, below 0")
